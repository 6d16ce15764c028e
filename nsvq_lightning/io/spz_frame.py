"""The container of a ``.spz`` file: one gzip stream up to version 3, one Zstandard stream per array in version 4.

Integers are little-endian. Up to version 3 the gzip stream holds the first 16 bytes below, the arrays, and perhaps
extensions, of which only that of the axes is read and written. Version 4:

============  ==================  ==================================================================================
offset        bytes               content
============  ==================  ==================================================================================
0             16                  header: ``NGSP``, version (4), N (4), SH degree, fractional bits, flags, and S:
                                  number of streams (0 up to version 3)
16            4                   offset T of the table
20            12                  0
32            T - 32              extensions, each type (4), length (4), content
T             16 S                table: compressed and uncompressed bytes of each stream, 8 bytes each
T + 16 S      rest                streams: the arrays that are not empty
============  ==================  ==================================================================================
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io import zstd
from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.limits import check_room
from nsvq_lightning.splats.conventions import sh_coefficients

__all__ = [
    "ANTIALIASED",
    "MOST_FRACTION",
    "SPZ_MAGICS",
    "SPZ_VERSIONS",
    "SpzHeader",
    "read_frame",
    "read_spz_header",
    "write_frame",
]

_MAGIC = b"NGSP"
SPZ_MAGICS = (b"\x1f\x8b", _MAGIC)
"""First bytes: those of gzip up to version 3, those of the plain header from version 4 on."""
SPZ_VERSIONS = (3, 4)
"""Versions that are written."""
MOST_FRACTION = 30
"""Largest number of fractional bits of a position."""

_HEADER = struct.Struct("<4sIIBBBB")
_TABLE_OFFSET = struct.Struct("<I12x")
_HEAD = _HEADER.size + _TABLE_OFFSET.size
_ENTRY = struct.Struct("<QQ")
_MOST_EXTENDED = 1 << 20
"""Bytes of extensions that are read; those in use have less than a hundred."""
ANTIALIASED = 1
"""The flag of a scene that was trained with anti-aliasing."""
_EXTENDED = 2
"""The flag of extensions."""
_EXTENSION = struct.Struct("<III")
"""Type and length, then the number of the axes."""
_AXES = 0xADBE0003
"""The extension that states the axes."""
_SYSTEMS = (
    *("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""Axes by the number that the extension holds; 0 says nothing."""


@dataclass(frozen=True)
class SpzHeader:
    """The contents of the first bytes.

    Attributes:
        version: 1 to 4.
        count: Number of splats N.
        sh_degree: Degree of the spherical harmonics, 0 to 3.
        fraction_bits: Fractional bits of the positions.
        flags: :data:`ANTIALIASED`, and 2 where extensions follow.
        axes: Where x, y and z point: right or left, down or up, front or back, by their first letters; empty if the
            file does not say.
    """

    version: int
    count: int
    sh_degree: int
    fraction_bits: int
    flags: int = 0
    axes: str = ""

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes per splat of each array, in file order."""
        means, quats = (6 if self.version == 1 else 9), (4 if self.version >= 3 else 3)
        sh = 3 * sh_coefficients(self.sh_degree)
        return {"means": means, "opacities": 1, "sh0": 3, "scales": 3, "quats": quats, "shN": sh}

    @property
    def streams(self) -> dict[str, int]:
        """Bytes of each array that is not empty, in file order: the streams of version 4."""
        return {name: self.count * size for name, size in self.sizes.items() if self.count * size}

    def pack(self) -> bytes:
        """The 16 bytes that all versions have."""
        streams, flags = len(self.streams) if self.version == 4 else 0, self.flags | (_EXTENDED if self.axes else 0)
        return _HEADER.pack(_MAGIC, self.version, self.count, self.sh_degree, self.fraction_bits, flags, streams)


def write_frame(path: str | os.PathLike[str], header: SpzHeader, arrays: Mapping[str, NDArray[Any]]) -> int:
    """Write the file, replaced atomically; the same content gives the same bytes.

    Args:
        path: File to write.
        header: Of one of :data:`SPZ_VERSIONS`.
        arrays: By the names of :attr:`SpzHeader.sizes`, ``[N, ...]`` with that many bytes per splat.

    Returns:
        Bytes of the file.

    Raises:
        FormatError: Version 4 needs Zstandard, and it is not installed.
    """
    contents = [np.ascontiguousarray(arrays[name]).data.cast("B") for name in header.streams]
    axes = _EXTENSION.pack(_AXES, 4, _SYSTEMS.index(header.axes)) if header.axes else b""
    with atomic_write(path) as file:
        if header.version == 4:
            with naming_file(path):
                streams = [zstd.compress(content) for content in contents]
            table = (_ENTRY.pack(len(s), len(c)) for s, c in zip(streams, contents, strict=True))
            file.writelines([header.pack(), _TABLE_OFFSET.pack(_HEAD + len(axes)), axes, *table, *streams])
        else:
            # No file name and no time stamp: the same scene gives the same bytes.
            with gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as stream:
                stream.writelines([header.pack(), *contents, axes])
        return file.tell()


def read_frame(path: str | os.PathLike[str]) -> tuple[SpzHeader, dict[str, NDArray[np.uint8]]]:
    """Header and arrays ``[N, bytes per splat]`` by name; extensions other than that of the axes are ignored.

    Raises:
        FormatError: The file is truncated, altered, of another version, or not a ``.spz`` file; or version 4 needs
            Zstandard, and it is not installed.
    """
    data = Path(path).read_bytes()
    with naming_file(path):
        header, contents = _unpack(data) if data.startswith(_MAGIC) else _unzip(data)
        shapes = {name: (header.count, size) for name, size in header.sizes.items()}
        return header, {
            name: np.frombuffer(contents.get(name, b""), np.uint8).reshape(shape) for name, shape in shapes.items()
        }


def read_spz_header(path: str | os.PathLike[str]) -> tuple[SpzHeader, dict[str, int]]:
    """Header, and the size in bytes of each part of the file.

    The arrays are not decoded; up to version 3 they are unpacked where extensions follow them.

    Raises:
        FormatError: The file is truncated, of another version, or not a ``.spz`` file.
    """
    total = os.path.getsize(path)
    with naming_file(path), open(path, "rb") as file:
        start = file.read(1 << 12)
        if not start.startswith(_MAGIC):
            header = _parse_stream(zlib.decompressobj(wbits=31), start, total)
            return _unzip(start + file.read())[0] if header.flags & _EXTENDED else header, {"all": total}
        header, offset = _parse_head(start, total)
        file.seek(_HEAD)
        header = _with_axes(header, file.read(offset - _HEAD))
        lengths = _lengths(header, file.read(_ENTRY.size * len(header.streams)), total - offset)
    return header, {"header": total - sum(lengths.values()), **lengths}


def _unpack(data: bytes) -> tuple[SpzHeader, dict[str, bytes]]:
    """Header and arrays of version 4."""
    header, offset = _parse_head(data, len(data))
    header = _with_axes(header, data[_HEAD:offset])
    start = offset + _ENTRY.size * len(header.streams)
    contents = {}
    for name, length in _lengths(header, data[offset:start], len(data) - offset).items():
        contents[name] = zstd.decompress(memoryview(data)[start : start + length], header.streams[name])
        start += length
    return header, contents


def _parse_head(start: bytes, file_bytes: int) -> tuple[SpzHeader, int]:
    """Header of version 4 and offset of its table, which must be entirely in the file."""
    header = _parse(start[: _HEADER.size])
    if header.version < 4 or len(start) < _HEAD:
        raise FormatError(f"truncated or damaged: version {header.version} in {file_bytes} bytes without gzip")
    check_room("splats", header.count, file_bytes)
    streams, (offset,) = start[_HEADER.size - 1], _TABLE_OFFSET.unpack_from(start, _HEADER.size)
    if streams != len(header.streams):
        raise FormatError(f"damaged: {streams} streams where there must be {len(header.streams)}")
    if not _HEAD <= offset <= file_bytes - _ENTRY.size * streams:
        raise FormatError(f"truncated or damaged: a table of {streams} streams at {offset}, of {file_bytes} bytes")
    return header, offset


def _lengths(header: SpzHeader, table: bytes, rest: int) -> dict[str, int]:
    """Compressed bytes of each stream; table and streams must fill the ``rest`` of the file."""
    entries = dict(zip(header.streams, _ENTRY.iter_unpack(table), strict=True))
    for name, (length, size) in entries.items():
        if size != header.streams[name] or size > length * zstd.MOST_A_BYTE:
            raise FormatError(f"damaged: {name} of {header.count} splats cannot be {size} bytes in {length}")
    lengths = {name: length for name, (length, _) in entries.items()}
    if len(table) + sum(lengths.values()) != rest:
        raise FormatError(f"truncated or damaged: streams of {sum(lengths.values())} bytes in {rest - len(table)}")
    return lengths


def _with_axes(header: SpzHeader, extensions: bytes) -> SpzHeader:
    """The header with the axes that the extensions state."""
    start = 0
    while header.flags & _EXTENDED and start + _EXTENSION.size <= len(extensions):
        kind, length, system = _EXTENSION.unpack_from(extensions, start)
        if (kind, length) == (_AXES, 4):
            if system >= len(_SYSTEMS):
                raise FormatError(f"damaged, or newer than this release: coordinate system {system}, not 0 to 16")
            return replace(header, axes=_SYSTEMS[system])
        start += 8 + length
    return header


def _unzip(data: bytes) -> tuple[SpzHeader, dict[str, bytes]]:
    """Header and arrays of versions 1 to 3."""
    gunzip = zlib.decompressobj(wbits=31)
    header = _parse_stream(gunzip, data, len(data))
    contents = {}
    for name, size in header.streams.items():
        contents[name] = _inflate(gunzip, gunzip.unconsumed_tail, size)
        if len(contents[name]) < size:
            raise FormatError(f"truncated: {name} of {header.count} splats has {len(contents[name])} of {size} bytes")
    # Extensions follow the arrays; reading to the end of the stream verifies its checksum.
    extensions = _inflate(gunzip, gunzip.unconsumed_tail, _MOST_EXTENDED)
    if not gunzip.eof:
        raise FormatError(f"truncated, or more than {_MOST_EXTENDED} bytes of extensions: the gzip stream has no end")
    return _with_axes(header, extensions), contents


def _parse_stream(gunzip: zlib._Decompress, data: bytes, file_bytes: int) -> SpzHeader:
    """Header of versions 1 to 3; refuses more splats than the file can hold."""
    header = _parse(_inflate(gunzip, data, _HEADER.size))
    if header.version > 3:
        raise FormatError(f"damaged: version {header.version} in a gzip stream, which only versions 1 to 3 are")
    check_room("splats", header.count, file_bytes)
    return header


def _inflate(gunzip: zlib._Decompress, data: bytes, most: int) -> bytes:
    """At most ``most`` bytes of the stream; ``most`` must be above 0, which zlib takes as no limit."""
    try:
        return gunzip.decompress(data, most)
    except zlib.error as error:
        raise FormatError(f"damaged, or not a .spz file: no valid gzip stream ({error})") from None


def _parse(start: bytes) -> SpzHeader:
    if len(start) < _HEADER.size or start[:4] != _MAGIC:
        raise FormatError("not a .spz file: it does not start with a whole header 'NGSP'")
    _, version, count, sh_degree, fraction_bits, flags, _ = _HEADER.unpack(start)
    if not 1 <= version <= 4:
        raise FormatError(
            f"version {version} of the format; this release reads 1 to 4", "save it as version 3 or as .ply"
        )
    if sh_degree > 3:
        raise FormatError(f"damaged, or of a degree that this release does not read: SH degree {sh_degree}, not 0 to 3")
    if fraction_bits > MOST_FRACTION:
        raise FormatError(f"damaged: {fraction_bits} fractional bits, more than {MOST_FRACTION}")
    return SpzHeader(version, count, sh_degree, fraction_bits, flags)
