"""The ``.spz`` file of Niantic: 65 bytes a splat, 12 to 25 after gzip. Version 3 is written, versions 1 to 3 are read.

A gzip stream of a header and six arrays, each of all splats; integers are little-endian.

===========  =================  =============================================================================
array        bytes a splat      content
===========  =================  =============================================================================
header       16 in all          ``NGSP``, version (4), N (4), SH degree, bits after the point, flags, 0
positions    9                  3 fixed-point numbers of 24 bits; version 1: 3 float16
opacities    1                  255ths
colours      3                  127.5 + 255 · 0.15 · sh0
scales       3                  16 (ln s + 10)
rotations    4                  smallest three: 2 bits say which component of xyzw is the largest, then sign and
                                9 bits of each other one, 511 being 1/√2; versions 1 and 2: 3 bytes xyz
SH           3 (d² + 2d)        128 + 128 x, coefficient by coefficient, three colours each
===========  =================  =============================================================================

Niantic's writer rounds spherical harmonics to 5 and 4 bits before, for gzip's sake; that took a trained scene down to
31 dB, so all 8 bits are used here.

Axes are right, up, back; ours are right, down, forward, so y and z change their signs, and with them the coefficients
of odd functions of either.
"""

from __future__ import annotations

import gzip
import math
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.arrays import SplatArrays
from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.clamping import Clamped
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.opacity import logits_of_bytes, opacity_of
from nsvq_lightning.io.rotation import from_smallest_three, smallest_three, unit
from nsvq_lightning.io.splat_order import spatial_order
from nsvq_lightning.sh_degree import sh_coefficients

__all__ = ["SPZ_MAGICS", "SpzHeader", "read_spz", "read_spz_header", "write_spz"]

_MAGIC = b"NGSP"
SPZ_MAGICS = (b"\x1f\x8b", _MAGIC)
"""First bytes: of gzip up to version 3, of the plain header from version 4 on."""

_HEADER = struct.Struct("<4sIIBBBB")
_MOST_A_BYTE = 1032
"""Bytes that one byte of a deflate stream can become."""
_POSITION = 24
_USUAL_FRACTION, _MOST_FRACTION = 12, 30
_POSITION_ERROR = 0.05
"""Largest error of a coordinate as a share of the splat's size, of all but the thousandth with the smallest splats."""
_COLOR = 0.15
_BLOCK = 1 << 16
"""Rows of spherical harmonics rounded at a time."""
_ORDER = ("quats", "scales", "sh0", "shN")
"""Attributes whose codes order the splats, the most important last."""
_FLIPPED_AXES = np.array([1.0, -1.0, -1.0])
_FLIPPED_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)[:, None]
"""Signs of the real spherical harmonics of degree 1 to 3 when y and z change theirs, ``[15, 1]``."""


@dataclass(frozen=True)
class SpzHeader:
    """What the first bytes of the stream say.

    Attributes:
        version: 1 to 3.
        count: Number of splats N.
        sh_degree: Degree of the spherical harmonics, 0 to 3.
        fraction_bits: Bits of the positions after the point.
    """

    version: int
    count: int
    sh_degree: int
    fraction_bits: int

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes a splat of each array, in file order."""
        means, quats = (6 if self.version == 1 else 9), (4 if self.version == 3 else 3)
        sh = 3 * sh_coefficients(self.sh_degree)
        return {"means": means, "opacities": 1, "sh0": 3, "scales": 3, "quats": quats, "shN": sh}

    @property
    def stream_bytes(self) -> int:
        """Bytes of header and arrays."""
        return _HEADER.size + self.count * sum(self.sizes.values())


def write_spz(path: str | os.PathLike[str], scene: CompressedScene) -> int:
    """Write a scene as ``.spz``, version 3.

    Positions get as many bits after the point as the smallest splats need. Splats are in the order of their codes,
    those of the spherical harmonics first, because gzip finds equal rows only where they are near, and then of their
    place. Splats with a non-finite value are left out and values out of the format's range are clamped, each with a
    warning.

    Returns:
        Bytes of the file.
    """
    scene = scene.finite()
    scene = scene.take(spatial_order(scene.means))
    codes = [scene.codes[name] for name in _ORDER if name in scene.codes]
    scene = scene.take(np.lexsort([np.arange(len(scene)), *codes]))
    clamped = Clamped()
    fraction = _fraction_bits(scene)
    header = _HEADER.pack(_MAGIC, 3, len(scene), scene.sh_degree, fraction, 0, 0)
    arrays = (
        _packed_means(scene, fraction, clamped),
        np.rint(255 * opacity_of(scene.opacities)).astype(np.uint8),
        _packed(scene, "sh0", _COLOR * 255, 127.5, clamped),
        _packed(scene, "scales", 16, 160, clamped),
        scene.spread("quats", lambda rows, _: _packed_quats(rows)),
        scene.spread("shN", lambda rows, uses: _packed_sh(rows, uses, scene.sh_degree, clamped)),
    )
    clamped.warn(path, len(scene))
    with atomic_write(path) as file:
        # No name and no time: the same scene gives the same bytes.
        with gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as stream:
            stream.write(header)
            for array in arrays:
                stream.write(np.ascontiguousarray(array).data)
        return file.tell()


def _fraction_bits(scene: CompressedScene) -> int:
    """Bits after the point: what the smallest splats need, unless the farthest then lie out of range.

    A few splats far away do not make positions coarser than the format's usual 12 bits; they are moved to its end.
    """
    if len(scene) == 0:
        return _USUAL_FRACTION
    sizes = scene.spread("scales", lambda rows, _: rows.mean(1))
    needed = math.ceil(-(math.log2(2 * _POSITION_ERROR) + float(np.quantile(sizes, 0.001)) / math.log(2)))
    farthest, far = np.abs(scene.means).max(), np.quantile(np.abs(scene.means).max(1), 0.999)
    fits, mostly_fits = (_POSITION - 1 - math.frexp(float(reach))[1] for reach in (farthest, far))
    return min(max(min(needed, fits), min(_USUAL_FRACTION, mostly_fits), 0), _MOST_FRACTION)


def _packed_means(scene: CompressedScene, fraction: int, clamped: Clamped) -> NDArray[np.uint8]:
    end = 1 << _POSITION - 1
    fixed = clamped.nearest("means", scene.means * (_FLIPPED_AXES * (1 << fraction)), (-end, end - 1))
    return fixed.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3]


def _packed(scene: CompressedScene, name: str, factor: float, zero: float, clamped: Clamped) -> NDArray[np.uint8]:
    return scene.spread(
        name, lambda rows, uses: clamped.nearest(name, factor * rows + zero, (0, 255), uses=uses).astype(np.uint8)
    )


def _packed_quats(rows: NDArray[np.float32]) -> NDArray[np.uint32]:
    largest, others = smallest_three((unit(rows) * [1, *_FLIPPED_AXES])[:, [1, 2, 3, 0]])
    packed = largest.astype(np.uint32)
    for part in others.T:
        magnitude = np.minimum(np.rint(511 * math.sqrt(2) * np.abs(part)), 511).astype(np.uint32)
        packed = (packed << np.uint32(10)) | ((part < 0).astype(np.uint32) << np.uint32(9)) | magnitude
    return packed.astype("<u4")


def _packed_sh(
    rows: NDArray[np.float32], uses: NDArray[np.int64] | None, sh_degree: int, clamped: Clamped
) -> NDArray[np.uint8]:
    coefficients = sh_coefficients(sh_degree)
    values = rows.reshape(len(rows), coefficients, 3)
    packed = np.empty(values.shape, np.uint8)
    for start in range(0, len(rows), _BLOCK):
        block = slice(start, start + _BLOCK)
        flipped = 128 * _FLIPPED_SH[:coefficients] * values[block]
        packed[block] = clamped.nearest("shN", flipped + 128, (0, 255), None if uses is None else uses[block])
    return packed


def read_spz(path: str | os.PathLike[str]) -> CompressedScene:
    """Read a ``.spz`` file of version 1 to 3; its extensions are left out.

    Raises:
        FormatError: The file is truncated, altered, of another version, or no ``.spz`` file.
    """
    data = Path(path).read_bytes()
    with naming_file(path):
        header, stream = _unzip(data)
        arrays: dict[str, NDArray[np.uint8]] = {}
        start = _HEADER.size
        for name, size in header.sizes.items():
            end = start + header.count * size
            arrays[name] = np.frombuffer(stream, np.uint8, header.count * size, start).reshape(header.count, size)
            start = end
        return CompressedScene.from_arrays(_unpacked(header, arrays))


def read_spz_header(path: str | os.PathLike[str]) -> SpzHeader:
    """Header of a ``.spz`` file; the arrays are not looked at.

    Raises:
        FormatError: The file is of another version, or no ``.spz`` file.
    """
    with naming_file(path), open(path, "rb") as file:
        return _parse(_start(zlib.decompressobj(wbits=31), file.read(1 << 12)), os.path.getsize(path))


def _unzip(data: bytes) -> tuple[SpzHeader, bytes]:
    gunzip = zlib.decompressobj(wbits=31)
    start = _start(gunzip, data)
    header = _parse(start, len(data))
    # What follows the arrays are extensions; reading on to the end of the stream checks its sum.
    stream = start + _inflate(gunzip, gunzip.unconsumed_tail, header.stream_bytes - len(start))
    if len(stream) < header.stream_bytes:
        raise FormatError(f"truncated: {header.count} splats need {header.stream_bytes} bytes, got {len(stream)}")
    while not gunzip.eof:
        if not _inflate(gunzip, gunzip.unconsumed_tail, 1 << 16) and not gunzip.eof:
            raise FormatError("truncated: the gzip stream has no end")
    return header, stream


def _start(gunzip: zlib._Decompress, data: bytes) -> bytes:
    if data.startswith(_MAGIC):
        raise FormatError(
            "version 4 or later of the format; this release reads 1 to 3", "save it as version 3 or as .ply"
        )
    return _inflate(gunzip, data, _HEADER.size)


def _inflate(gunzip: zlib._Decompress, data: bytes, most: int) -> bytes:
    """At most so many bytes of the stream; 0 must not reach zlib, which takes it for no limit."""
    try:
        return gunzip.decompress(data, most) if most else b""
    except zlib.error as error:
        raise FormatError(f"damaged, or not a .spz file: no valid gzip stream ({error})") from None


def _parse(start: bytes, file_bytes: int) -> SpzHeader:
    if len(start) < _HEADER.size or start[:4] != _MAGIC:
        raise FormatError("not a .spz file: the gzip stream does not start with a header 'NGSP'")
    _, version, count, sh_degree, fraction_bits, _, _ = _HEADER.unpack(start)
    if not 1 <= version <= 3:
        raise FormatError(
            f"version {version} of the format; this release reads 1 to 3", "save it as version 3 or as .ply"
        )
    if sh_degree > 3:
        raise FormatError(f"damaged, or of a degree that this release does not read: SH degree {sh_degree}, not 0 to 3")
    if fraction_bits > _MOST_FRACTION:
        raise FormatError(f"damaged: {fraction_bits} bits after the point, more than {_MOST_FRACTION}")
    header = SpzHeader(version, count, sh_degree, fraction_bits)
    if header.stream_bytes > _MOST_A_BYTE * file_bytes:
        raise FormatError(f"truncated or damaged: {count} splats cannot be in {file_bytes} bytes")
    return header


def _unpacked(header: SpzHeader, arrays: dict[str, NDArray[np.uint8]]) -> SplatArrays:
    coefficients = sh_coefficients(header.sh_degree)
    sh = (arrays["shN"].reshape(header.count, coefficients, 3).astype(np.float32) - 128) / 128
    return SplatArrays(
        means=(_unpacked_means(header, arrays["means"]) * _FLIPPED_AXES).astype(np.float32),
        quats=_unpacked_quats(header, arrays["quats"]),
        scales=(arrays["scales"] / 16 - 10).astype(np.float32),
        opacities=logits_of_bytes(arrays["opacities"][:, 0]),
        sh0=((arrays["sh0"][:, None] / 255 - 0.5) / _COLOR).astype(np.float32),
        shN=(sh * _FLIPPED_SH[:coefficients]).astype(np.float32),
    )


def _unpacked_means(header: SpzHeader, data: NDArray[np.uint8]) -> NDArray[np.floating[Any]]:
    if header.version == 1:
        return np.ascontiguousarray(data).view("<f2").astype(np.float64)
    # Three bytes at the top of four, shifted down with their sign.
    wide = np.zeros((header.count, 3, 4), np.uint8)
    wide[:, :, 1:] = data.reshape(header.count, 3, 3)
    fixed = wide.view("<i4")[:, :, 0] >> 8
    return np.ldexp(fixed.astype(np.float64), -header.fraction_bits)


def _unpacked_quats(header: SpzHeader, data: NDArray[np.uint8]) -> NDArray[np.float32]:
    if header.version < 3:
        xyz = data.astype(np.float64) / 127.5 - 1
        xyzw = from_smallest_three(np.full(header.count, 3), xyz)
    else:
        packed = np.ascontiguousarray(data).view("<u4")[:, 0]
        parts = np.stack([packed >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)], axis=1)
        others = (parts & 511) / (511 * math.sqrt(2)) * np.where(parts & 512, -1, 1)
        xyzw = from_smallest_three((packed >> np.uint32(30)).astype(np.intp), others)
    return xyzw[:, [3, 0, 1, 2]] * np.array([1, *_FLIPPED_AXES], np.float32)
