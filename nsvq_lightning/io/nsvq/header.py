r"""The frame of a ``.nsvq`` file, readable without knowing the compression level: prefix, JSON header, streams.

============  =====  ==========================================================================================
offset        bytes  content
============  =====  ==========================================================================================
0             8      magic ``\x89NSVQ\r\n\x1a``; its line ends and high bit expose transfers that treat it as text
8             16     BLAKE2b digest (16 bytes) of everything after it
24            4      format version, uint32 little-endian
28            4      length J of the JSON header, uint32 little-endian
32            J      header: UTF-8 JSON, keys sorted, no spaces; it says what the streams hold
32 + J        rest   streams, back to back in the order of the stream table
============  =====  ==========================================================================================

Nothing in the file is executable, and every length is checked against the available bytes before it is used. New levels
add storage kinds of attributes, stream names and stream encodings; the frame stays the same.
"""

from __future__ import annotations

import json
import math
import os
import struct
import sys
from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass, field, fields, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, TypeVar

from nsvq_lightning.io.errors import FormatError, naming_file

PREFIX_BYTES = 32
"""Bytes before the JSON, see :mod:`nsvq_lightning.io.nsvq.header`."""

_T = TypeVar("_T")


@dataclass(frozen=True)
class AttributeEntry:
    """How one attribute of the splats is stored.

    Attributes:
        name: Attribute, for example ``quats``.
        dim: Values per splat, D.
        storage: ``raw`` (float32, one row per splat), ``codes`` (rows of a codebook), ``steps`` (integers, one row per
            splat), ``levels`` (equal steps of [0, 1]), or ``grid`` (cells of a grid).
        codes: Rows of the codebook K, or number of levels; 0 where there are none.
        step: Step of which the integers of this attribute, or of its codebook, are multiples; 0 for float32.
    """

    name: str
    dim: int
    storage: str
    codes: int = 0
    step: float = 0.0

    @property
    def bits(self) -> int:
        """Bits of one code before entropy coding; 0 without codes."""
        return max(0, self.codes - 1).bit_length()


@dataclass(frozen=True)
class StreamEntry:
    """One run of bytes.

    Attributes:
        name: What it holds.
        length: Number of bytes.
        encoding: How to read it, for example ``float32`` or ``bits``.
    """

    name: str
    length: int
    encoding: str


@dataclass(frozen=True)
class Header:
    """All that a ``.nsvq`` file says about its streams.

    Attributes:
        level: Compression level, which fixes the attribute and stream tables.
        splats: Number of splats N.
        sh_degree: Degree of the spherical harmonics, 0 to 3.
        origin: World coordinates of the point (0, 0, 0) of the stored positions, float64.
        attributes: Attribute table.
        streams: Stream table; the streams follow each other without gaps.
        config: Settings of the run; JSON values.
        metrics: Quality measured on the decoded file; None stands for NaN or infinity.
    """

    level: str
    splats: int
    sh_degree: int
    origin: tuple[float, float, float]
    attributes: tuple[AttributeEntry, ...]
    streams: tuple[StreamEntry, ...]
    config: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, float | None] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes before the first stream: prefix and JSON."""
        return PREFIX_BYTES + len(self.to_json())

    @property
    def file_bytes(self) -> int:
        """Bytes of the whole file."""
        return self.size + sum(stream.length for stream in self.streams)

    def to_json(self) -> bytes:
        """The JSON text as stored; equal headers give equal bytes.

        Raises:
            ValueError: ``config`` holds something that is not a JSON value (tensor, object, NaN).
        """
        try:
            table = asdict(self)
            table["attributes"] = [astuple(entry) for entry in self.attributes]
            table["streams"] = [astuple(stream) for stream in self.streams]
            table["metrics"] = {name: _finite_or_none(value) for name, value in self.metrics.items()}
            text = json.dumps(table, sort_keys=True, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
            return text.encode()
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"config and metrics must hold plain JSON values only: {error}") from None

    @classmethod
    def from_json(cls, text: bytes) -> Header:
        """Header from its JSON text.

        Raises:
            FormatError: An entry is missing or has the wrong type.
        """
        try:
            table = json.loads(text.decode(), parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            raise FormatError(f"damaged: the header is not JSON ({error})") from None
        header = cls(
            level=_entry(table, "level", str),
            splats=_size(table, "splats"),
            sh_degree=_size(table, "sh_degree"),
            origin=_origin(table),
            attributes=tuple(_attribute(row) for row in _rows(table, "attributes", AttributeEntry)),
            streams=tuple(_stream(row) for row in _rows(table, "streams", StreamEntry)),
            config=_entry(table, "config", dict),
            metrics=_metrics(table),
        )
        if header.sh_degree > 3:
            raise FormatError(f"damaged: SH degree {header.sh_degree}, the highest is 3")
        if len({stream.name for stream in header.streams}) != len(header.streams):
            raise FormatError("damaged: two streams have the same name")
        return header


def _no_number(name: str) -> None:
    raise ValueError(f"it holds {name}, which JSON does not have")


def _rows(table: object, key: str, kind: type[AttributeEntry | StreamEntry]) -> list[dict[str, Any]]:
    """The entries of a table; version 1 of the format wrote dictionaries, which hold more than what is used."""
    rows, columns = _items(table, key, (dict, list)), [column.name for column in fields(kind)]
    if any(isinstance(row, list) and len(row) != len(columns) for row in rows):
        raise FormatError(f"damaged: a row of header entry {key!r} does not hold {', '.join(columns)}")
    return [row if isinstance(row, dict) else dict(zip(columns, row, strict=True)) for row in rows]


def _attribute(row: dict[str, Any]) -> AttributeEntry:
    return AttributeEntry(
        name=_entry(row, "name", str),
        dim=_size(row, "dim"),
        storage=_entry(row, "storage", str),
        codes=_size(row, "codes"),
        step=_finite(row, "step"),
    )


def _stream(row: dict[str, Any]) -> StreamEntry:
    return StreamEntry(_entry(row, "name", str), _size(row, "length"), _entry(row, "encoding", str))


def _entry(table: object, key: str, kind: type[_T]) -> _T:
    value = table.get(key) if isinstance(table, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise FormatError(f"damaged: header entry {key!r} must be of type {kind.__name__}, got {str(value)[:60]!r}")
    return value


def _size(table: object, key: str) -> int:
    value = _entry(table, key, int)
    if value < 0:
        raise FormatError(f"damaged: header entry {key!r} must not be negative, got {value}")
    return value


def _items(table: object, key: str, kinds: tuple[type, ...]) -> list[Any]:
    values = _entry(table, key, list)
    if any(not isinstance(value, kinds) or isinstance(value, bool) for value in values):
        raise FormatError(f"damaged: header entry {key!r} has a member of the wrong type")
    return values


def _finite(table: object, key: str) -> float:
    value = table.get(key, 0.0) if isinstance(table, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= sys.float_info.max:
        raise FormatError(
            f"damaged: header entry {key!r} must be a finite number, not negative, got {str(value)[:60]!r}"
        )
    return float(value)


def _origin(table: object) -> tuple[float, float, float]:
    values = _items(table, "origin", (int, float))
    # Comparing is safe; float() of a huge integer would overflow.
    if len(values) != 3 or not all(abs(value) <= sys.float_info.max for value in values):
        raise FormatError("damaged: header entry 'origin' must be three finite numbers")
    return float(values[0]), float(values[1]), float(values[2])


def _metrics(table: object) -> dict[str, float | None]:
    metrics = _entry(table, "metrics", dict)
    if any(isinstance(value, bool) or not isinstance(value, int | float | None) for value in metrics.values()):
        raise FormatError("damaged: header entry 'metrics' must hold numbers only")
    return metrics


def _finite_or_none(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


MAGIC = b"\x89NSVQ\r\n\x1a"
VERSION = 2
READABLE = (1, 2)
"""Versions that are read; the header of version 1 spells out the columns of its tables in every row."""
_PREFIX = struct.Struct("<8s16sII")
_DIGEST_START, _DIGEST_END = 8, 24


def frame(header: Header, streams: Mapping[str, bytes]) -> list[bytes]:
    """The parts of the file, in order.

    Raises:
        ValueError: ``streams`` do not fit the header's stream table.
    """
    lengths = {name: len(data) for name, data in streams.items()}
    if lengths != {stream.name: stream.length for stream in header.streams}:
        raise ValueError(f"streams {lengths} do not fit the stream table {header.streams}")
    text = header.to_json()
    parts = [struct.pack("<II", VERSION, len(text)), text, *(streams[stream.name] for stream in header.streams)]
    digest = blake2b(digest_size=_DIGEST_END - _DIGEST_START)
    for part in parts:
        digest.update(part)
    return [MAGIC, digest.digest(), *parts]


def with_origin(data: bytes, origin: tuple[float, float, float]) -> bytes:
    """A whole file with another origin for its positions; all else is unchanged.

    Raises:
        FormatError: As for :func:`unframe`.
    """
    header, streams = unframe(data)
    return b"".join(frame(replace(header, origin=origin), {name: bytes(part) for name, part in streams.items()}))


def unframe(data: bytes) -> tuple[Header, dict[str, memoryview]]:
    """Header and streams of a whole file; the streams share the memory of ``data``.

    Raises:
        FormatError: Not a ``.nsvq`` file, truncated, altered, or of another version.
    """
    if data[: len(MAGIC)] != MAGIC:
        raise FormatError("not a .nsvq file: it does not start with the magic bytes")
    if len(data) < _PREFIX.size:
        raise FormatError(f"truncated: {len(data)} bytes, the prefix alone has {_PREFIX.size}")
    _, digest, version, json_bytes = _PREFIX.unpack_from(data)
    if blake2b(memoryview(data)[_DIGEST_END:], digest_size=len(digest)).digest() != digest:
        raise FormatError("truncated or altered: the checksum does not fit the content")
    if version not in READABLE:
        raise FormatError(
            f"version {version} of the format; this release reads {' and '.join(map(str, READABLE))}",
            "update nsvq-lightning",
        )
    payload = memoryview(data)[_PREFIX.size + json_bytes :]
    if _PREFIX.size + json_bytes > len(data):
        raise FormatError(f"damaged: a header of {json_bytes} bytes in a file of {len(data)}")
    header = Header.from_json(data[_PREFIX.size : _PREFIX.size + json_bytes])
    streams: dict[str, memoryview] = {}
    end = 0
    for stream in header.streams:
        streams[stream.name] = payload[end : end + stream.length]
        end += stream.length
    if end != len(payload):
        raise FormatError(f"damaged: the streams have {end} bytes, the file holds {len(payload)}")
    return header, streams


def read_frame(path: str | os.PathLike[str]) -> tuple[Header, dict[str, memoryview]]:
    """:func:`unframe` for a file, with its name in every error."""
    with naming_file(path):
        return unframe(Path(path).read_bytes())


def read_header(path: str | os.PathLike[str]) -> Header:
    """Header of a ``.nsvq`` file, after verifying the checksum of the whole file."""
    return read_frame(path)[0]
