"""The frame of a ``.nsvq`` file, readable without knowing the compression level: prefix, JSON header, streams.

docs/nsvq_format.md lists every byte.

Nothing in the file is executable, and every length is checked against the available bytes before it is used. New levels
add storage kinds of attributes, stream names and stream encodings; the frame stays the same.
"""

import json
import math
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_type_hints

import numpy as np

from nsvq_lightning.io.atomic import StrPath
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, Json, check_start, json_object, naming_file
from nsvq_lightning.rendering.sampling import MAX_CAMERAS
from nsvq_lightning.splats.attributes import attribute_dims
from nsvq_lightning.splats.conventions import Float64s, Place

# Magic, BLAKE2b digest of everything after it, version, and bytes of the JSON, whose keys are sorted, without spaces.
_PREFIX = struct.Struct("<8s16sII")
_T = TypeVar("_T")
# A position and a focal length for each.
_Cameras = tuple[tuple[float, ...], ...]
# Types of the numbers of JSON; a bool is none.
_NUMBERS = (int, float)
# Its line ends and high bit expose transfers that treat it as text.
MAGIC = b"\x89NSVQ\r\n\x1a"
# Versions that are read; the last is written. Before it, decisions of paths had one context, and columns of integers no
# differences from each other; the first has no basis.
VERSIONS = 2, 3, 4


class AttributeEntry(NamedTuple):
    """How one attribute of the splats is stored.

    Attributes:
        name: Attribute, for example ``quats``.
        dim: Values per splat, D.
        storage: ``raw`` (float32, one row per splat), ``codes`` (rows of a codebook), ``steps`` (integers, one row per
            splat), ``components`` (integers, times a basis), ``levels`` (equal steps of [0, 1]), or ``cells`` (of a
            grid).
        codes: Rows of the codebook K or of the basis C, or number of levels; 0 where there are none.
        step: Step of which the integers of this attribute, its codebook or basis are multiples; 0 for float32.
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


class StreamEntry(NamedTuple):
    """One run of bytes.

    Attributes:
        name: What it holds.
        length: Number of bytes.
        encoding: How to read it, for example ``float32`` or ``bits``.
    """

    name: str
    length: int
    encoding: str


_DIGEST_END = 24


class Header(NamedTuple):
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
        cameras: Positions, relative to ``origin``, and focal lengths in pixels of the cameras of training, rounded.
        version: Of the format, which is not in the JSON.
    """

    level: str
    splats: int
    sh_degree: int
    origin: Place
    attributes: tuple[AttributeEntry, ...]
    streams: tuple[StreamEntry, ...]
    config: Json
    metrics: dict[str, float | None]
    cameras: _Cameras = ()
    version: int = VERSIONS[-1]

    @classmethod
    def of(
        cls, scene: CompressedScene, level: str, entries: tuple[AttributeEntry, ...], streams: tuple[StreamEntry, ...]
    ) -> "Header":
        """Header of the file of a scene."""
        x, y, z = map(float, scene.origin)
        config, metrics = dict(scene.config), dict(scene.metrics)
        cameras = _rounded(scene.cameras)
        return cls(level, len(scene), scene.sh_degree, (x, y, z), entries, streams, config, metrics, cameras)

    @property
    def of_scene(self) -> Json:
        """What a scene has from its header."""
        same = {name: getattr(self, name) for name in ("sh_degree", "config", "metrics", "origin")}
        return same | {"cameras": np.array(self.cameras, np.float64).reshape(-1, 4)}

    @property
    def size(self) -> int:
        """Bytes before the first stream: prefix and JSON."""
        return _PREFIX.size + len(self.to_json())

    @property
    def file_bytes(self) -> int:
        """Bytes of the whole file."""
        return self.size + sum(stream.length for stream in self.streams)

    def check_attributes(self, names: Sequence[str], possible: Callable[[AttributeEntry], bool]) -> None:
        """Compare the attribute table with that of a level, before anything is allocated from its sizes.

        Args:
            names: The attributes in the order of the level.
            possible: Whether an entry is one of the level.

        Raises:
            FormatError: It is another table.
        """
        dims = attribute_dims(self.sh_degree)
        if [(entry.name, entry.dim) for entry in self.attributes] != [(name, dims[name]) for name in names]:
            raise FormatError(f"damaged: the attribute table must list {', '.join(names)}, got {self.attributes}")
        for entry in self.attributes:
            if not possible(entry):
                raise FormatError(f"damaged: impossible attribute {entry}")

    def to_json(self) -> bytes:
        """The JSON text as stored; equal headers give equal bytes.

        Raises:
            ValueError: ``config`` holds something that is not a JSON value (tensor, object, NaN).
        """
        try:
            table = self._asdict()
            del table["version"]
            if not self.cameras:
                del table["cameras"]
            finite = {name: value for name, value in self.metrics.items() if value is not None and math.isfinite(value)}
            table["metrics"] = dict.fromkeys(self.metrics) | finite
            text = json.dumps(table, sort_keys=True, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
            return text.encode()
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"config and metrics must hold plain JSON values only: {error}") from None

    @classmethod
    def from_json(cls, text: bytes) -> "Header":
        """Header from its JSON text.

        Raises:
            FormatError: An entry is missing or has the wrong type.
        """
        table = json_object(text, "the header")
        origin = _entry(table, "origin", list)
        if not _are_numbers(origin, 3):
            raise FormatError("damaged: header entry 'origin' must be three finite numbers")
        header = cls(
            level=_entry(table, "level", str),
            splats=_entry(table, "splats", int),
            sh_degree=_entry(table, "sh_degree", int),
            origin=tuple(map(float, origin)),  # type: ignore[arg-type]  # they are three
            attributes=tuple(_row(AttributeEntry, row) for row in _entry(table, "attributes", list)),
            streams=tuple(_row(StreamEntry, row) for row in _entry(table, "streams", list)),
            config=_entry(table, "config", dict),
            metrics=_entry(table, "metrics", dict),
            cameras=_cameras(_entry({"cameras": [], **table}, "cameras", list)),
        )
        if header.sh_degree > 3:
            raise FormatError(f"damaged: SH degree {header.sh_degree}, the highest is 3")
        if len({stream.name for stream in header.streams}) != len(header.streams):
            raise FormatError("damaged: two streams have the same name")
        if any(type(each) not in _NUMBERS for each in header.metrics.values() if each is not None):
            raise FormatError("damaged: header entry 'metrics' must hold numbers only")
        return header


def _entry(table: Json, key: str, kind: type[_T]) -> _T:
    """An entry of a type; numbers must be finite and not negative."""
    value: Any = table.get(key)
    number = kind in _NUMBERS
    fits = type(value) in _NUMBERS if kind is float else type(value) is kind
    if not fits or (number and not 0 <= value <= sys.float_info.max):
        expected = f"{kind.__name__}, finite and not negative" if number else kind.__name__
        raise FormatError(f"damaged: header entry {key!r} must be of type {expected}, got {str(value)[:60]!r}")
    return float(value) if kind is float else value  # type: ignore[return-value]


def _row(kind: type[_T], row: object) -> _T:
    columns = get_type_hints(kind)
    if not isinstance(row, list) or len(row) != len(columns):
        raise FormatError(f"damaged: a row of the header's tables does not hold {', '.join(columns)}")
    named = dict(zip(columns, row, strict=True))
    return kind(**{name: _entry(named, name, column) for name, column in columns.items()})


def _cameras(rows: list[Any]) -> _Cameras:
    if len(rows) > MAX_CAMERAS or not all(_are_numbers(row, 4) and row[3] > 0 for row in rows):
        raise FormatError(f"damaged: header entry 'cameras' must be at most {MAX_CAMERAS} positions and focal lengths")
    return tuple(tuple(map(float, row)) for row in rows)


def _are_numbers(values: Any, count: int) -> bool:
    if not isinstance(values, list) or len(values) != count:
        return False
    # Comparing is safe; float() of a huge integer would overflow.
    return all(type(value) in _NUMBERS and abs(value) <= sys.float_info.max for value in values)


def _rounded(cameras: Float64s) -> _Cameras:
    """Cameras ``[C, 4]`` with the digits that count: positions to about a hundredth of their spread."""
    if len(cameras) == 0:
        return ()
    decimals = 2 - math.floor(math.log10(np.ptp(cameras[:, :3], axis=0).max() or 1e-6))
    return tuple((*(round(x, decimals) for x in place), float(f"{focal:.4g}")) for *place, focal in cameras.tolist())


def frame(header: Header, streams: Mapping[str, bytes]) -> list[bytes]:
    """The parts of the file, in order; the header's stream table has the names and lengths of ``streams``."""
    text = header.to_json()
    parts = [struct.pack("<II", header.version, len(text)), text, *(streams[stream.name] for stream in header.streams)]
    digest = blake2b(digest_size=16)
    for part in parts:
        digest.update(part)
    return [MAGIC, digest.digest(), *parts]


def unframe(data: bytes) -> tuple[Header, dict[str, memoryview]]:
    """Header and streams of a whole file; the streams share the memory of ``data``.

    Raises:
        FormatError: Not a ``.nsvq`` file, truncated, altered, or of another version.
    """
    check_start(".nsvq", data, MAGIC, _PREFIX.size)
    _, digest, version, json_bytes = _PREFIX.unpack_from(data)
    if blake2b(memoryview(data)[_DIGEST_END:], digest_size=len(digest)).digest() != digest:
        raise FormatError("truncated or altered: the checksum does not fit the content")
    if version not in VERSIONS:
        raise FormatError(f"version {version} of the format, which this release cannot read", "update nsvq-lightning")
    start = _PREFIX.size + json_bytes
    if start > len(data):
        raise FormatError(f"damaged: a header of {json_bytes} bytes in a file of {len(data)}")
    header = Header.from_json(data[_PREFIX.size : start])._replace(version=version)
    payload = memoryview(data)[start:]
    streams = {}
    end = 0
    for stream in header.streams:
        streams[stream.name] = payload[end : end + stream.length]
        end += stream.length
    if end != len(payload):
        raise FormatError(f"damaged: the streams have {end} bytes, the file holds {len(payload)}")
    return header, streams


def read_header(path: StrPath) -> Header:
    """Header of a ``.nsvq`` file, after verifying the checksum of the whole file."""
    with naming_file(path):
        return unframe(Path(path).read_bytes())[0]


def describe_nsvq(path: StrPath) -> Json:
    """Facts about a file, as JSON values; errors are those of :func:`read_header`."""
    header = read_header(path)
    total = Path(path).stat().st_size
    start = StreamEntry("header", total - sum(stream.length for stream in header.streams), "json")
    return {
        "format": f"nsvq, level {header.level}",
        "splats": header.splats,
        "sh_degree": header.sh_degree,
        "origin": list(header.origin),
        "cameras": len(header.cameras),
        "attributes": [{**entry._asdict(), "bits": entry.bits} for entry in header.attributes],
        "streams": [
            {"name": stream.name, "encoding": stream.encoding, "bytes": stream.length}
            for stream in (start, *header.streams)
        ],
        "bytes": total,
        "config": header.config,
        "metrics": header.metrics,
    }
