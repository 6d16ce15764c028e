r"""The frame of a ``.nsvq`` file: fixed prefix, JSON header, streams; readable without knowing the compression level.

============  =====  ==========================================================================================
offset        bytes  content
============  =====  ==========================================================================================
0             8      magic ``\x89NSVQ\r\n\x1a``; its line ends and high bit expose transfers that treat it as text
8             16     BLAKE2b digest (16 bytes) of everything after it
24            4      format version, uint32 little-endian
28            4      length J of the JSON header, uint32 little-endian
32            J      header: UTF-8 JSON, keys sorted, no spaces
32 + J        rest   streams, back to back in the order of the stream table
============  =====  ==========================================================================================

Nothing in the file is executable, and every length is checked against the available bytes before it is used. New levels
add storage kinds of attributes, stream names and stream encodings; the frame stays the same.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path

from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.nsvq.header import Header

__all__ = ["MAGIC", "VERSION", "frame", "read_frame", "read_header", "unframe", "with_origin"]

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
