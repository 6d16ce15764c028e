"""The ``.spz`` file of Niantic: 65 bytes per splat, 12 to 25 compressed. Versions 3 and 4 are written, 1 to 4 read.

Six arrays, each over all splats; :mod:`~nsvq_lightning.io.spz_frame` describes the container. Integers are
little-endian.

===========  =================  =============================================================================
array        bytes per splat    content
===========  =================  =============================================================================
positions    9                  3 fixed-point numbers of 24 bits; version 1: 3 float16
opacities    1                  255ths
colours      3                  127.5 + 255 · 0.15 · sh0
scales       3                  16 (ln s + 10)
rotations    4                  smallest three: 2 bits say which component of xyzw is the largest, then sign and
                                9 bits of each other one, 511 being 1/√2; versions 1 and 2: 3 bytes xyz
SH           3 (d² + 2d)        128 + 128 x, coefficient by coefficient, three colours each
===========  =================  =============================================================================

Niantic's writer first rounds spherical harmonics to 5 and 4 bits, for a smaller file; that reduced a trained scene to
31 dB, so all 8 bits are used here.

Axes: the text of the format says right, up, back (RUB), but viewers and converters take those of ``.ply``, which are
ours: right, down, front (RDF). So these are the default, also of a file that does not say. Where others have the
opposite direction, coordinates change sign, and with them the coefficients of odd functions.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.clamping import Clamped
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.opacity import logits_of_bytes, opacity_of
from nsvq_lightning.io.placing import UP_AXES, rotated
from nsvq_lightning.io.spz_frame import ANTIALIASED, MOST_FRACTION, SPZ_VERSIONS, SpzHeader, read_frame, write_frame
from nsvq_lightning.splats.arrays import SplatArrays
from nsvq_lightning.splats.conventions import from_smallest_three, sh_coefficients, smallest_three, unit

__all__ = ["DEFAULT_AXES", "DEFAULT_VERSION", "SPZ_AXES", "in_spz_order", "read_spz", "write_spz"]

logger = logging.getLogger(__name__)

DEFAULT_VERSION = 3
"""The version that every reader of the format supports."""
SPZ_AXES = ("rdf", "rub")
"""Axes that are written."""
DEFAULT_AXES = "rdf"
"""The axes that viewers take a file to have, whatever it says."""
_POSITION = 24
_USUAL_FRACTION = 12
_POSITION_ERROR = 0.05
"""Largest error of a coordinate as a share of the splat's size, for all but the smallest thousandth of the splats."""
_COLOR = 0.15
_BLOCK = 1 << 16
"""Rows of spherical harmonics rounded at a time."""
_ORDER = ("quats", "scales", "sh0", "shN")
"""Attributes by whose codes the splats are sorted, the most important last."""
_ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Coordinates that the real spherical harmonics of degree 1 to 3 are odd functions of."""


@dataclass(frozen=True)
class _Signs:
    """What changes sign between right, down, front and other axes: coordinates ``[3]``, and what follows from them."""

    axes: NDArray[np.float32]

    @classmethod
    def of(cls, axes: str) -> _Signs:
        return cls(np.array([1 if a == b else -1 for a, b in zip(axes, "RDF", strict=True)], np.float32))

    @property
    def quats(self) -> NDArray[np.float32]:
        """Of quaternions wxyz ``[4]``; a rotation's axis does not mirror as positions do."""
        return np.array([1, *(self.axes.prod() * self.axes)], np.float32)

    def harmonics(self, sh_degree: int) -> NDArray[np.float32]:
        """Of the spherical harmonics ``[coefficients, 1]``."""
        signs = [math.prod(self.axes["xyz".index(axis)] for axis in odd) for odd in _ODD[: sh_coefficients(sh_degree)]]
        return np.array(signs, np.float32)[:, None]


def in_spz_order(scene: CompressedScene) -> CompressedScene:
    """The splats that a file holds, in its order: by their codes, then by position.

    The codes of the spherical harmonics come first: in both versions, equal rows compress best when close together.
    """
    from nsvq_lightning.io.morton import spatial_order  # imports Numba, which readers do without

    scene = scene.take(spatial_order(scene.means))
    codes = [scene.codes[name] for name in _ORDER if name in scene.codes]
    return scene.take(np.lexsort([np.arange(len(scene)), *codes]))


def write_spz(
    path: str | os.PathLike[str], scene: CompressedScene, *, version: int = DEFAULT_VERSION, axes: str = DEFAULT_AXES
) -> int:
    """Write a scene as ``.spz``.

    Positions get as many fractional bits as the smallest splats need. Splats with a non-finite value are left out
    and values out of the format's range are clamped, each with a warning.

    Args:
        path: File to write, replaced atomically.
        scene: The scene.
        version: 3, or 4, which uses Zstandard.
        axes: One of :data:`SPZ_AXES`: ``rdf`` (right, down, front), or ``rub`` (right, up, back).

    Returns:
        Bytes of the file.

    Raises:
        ValueError: Another version, or other axes.
        FormatError: Version 4 needs Zstandard, and it is not installed.
    """
    if version not in SPZ_VERSIONS:
        raise ValueError(f"version of .spz must be {' or '.join(map(str, SPZ_VERSIONS))}, got {version}")
    if axes not in SPZ_AXES:
        raise ValueError(f"axes of .spz must be {' or '.join(SPZ_AXES)}, got {axes!r}")
    scene = in_spz_order(scene)
    clamped, signs = Clamped(), _Signs.of(axes.upper())
    flags, fraction = ANTIALIASED * scene.antialiased, _fraction_bits(scene)
    # Viewers expect version 3 to be silent, in the default axes; Babylon.js turns a scene that says so upside down.
    stated = axes.upper() if version == 4 or axes != DEFAULT_AXES else ""
    header = SpzHeader(version, len(scene), scene.sh_degree, fraction, flags, stated)
    arrays: dict[str, NDArray[Any]] = {
        "means": _packed_means(scene.means * signs.axes, fraction, clamped),
        "opacities": np.rint(255 * opacity_of(scene.opacities)).astype(np.uint8),
        "sh0": _packed(scene, "sh0", _COLOR * 255, 127.5, clamped),
        "scales": _packed(scene, "scales", 16, 160, clamped),
        "quats": scene.spread("quats", lambda rows, _: _packed_quats(rows * signs.quats)),
        "shN": scene.spread(
            "shN", lambda rows, uses: _packed_sh(rows, uses, signs.harmonics(scene.sh_degree), clamped)
        ),
    }
    clamped.warn(path, len(scene))
    return write_frame(path, header, arrays)


def _fraction_bits(scene: CompressedScene) -> int:
    """Fractional bits: what the smallest splats need, unless that puts the farthest out of range.

    A few distant splats do not make positions coarser than the format's usual 12 bits; they are clamped.
    """
    if len(scene) == 0:
        return _USUAL_FRACTION
    sizes = scene.spread("scales", lambda rows, _: rows.mean(1))
    needed = math.ceil(-(math.log2(2 * _POSITION_ERROR) + float(np.quantile(sizes, 0.001)) / math.log(2)))
    farthest, far = np.abs(scene.means).max(), np.quantile(np.abs(scene.means).max(1), 0.999)
    fits, mostly_fits = (_POSITION - 1 - math.frexp(float(reach))[1] for reach in (farthest, far))
    return min(max(min(needed, fits), min(_USUAL_FRACTION, mostly_fits), 0), MOST_FRACTION)


def _packed_means(means: NDArray[np.float32], fraction: int, clamped: Clamped) -> NDArray[np.uint8]:
    end = 1 << _POSITION - 1
    fixed = clamped.nearest("means", means * (1 << fraction), (-end, end - 1))
    return fixed.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3]


def _packed(scene: CompressedScene, name: str, factor: float, zero: float, clamped: Clamped) -> NDArray[np.uint8]:
    return scene.spread(
        name, lambda rows, uses: clamped.nearest(name, factor * rows + zero, (0, 255), uses=uses).astype(np.uint8)
    )


def _packed_quats(rows: NDArray[np.float32]) -> NDArray[np.uint32]:
    largest, others = smallest_three(unit(rows)[:, [1, 2, 3, 0]])
    packed = largest.astype(np.uint32)
    for part in others.T:
        magnitude = np.minimum(np.rint(511 * math.sqrt(2) * np.abs(part)), 511).astype(np.uint32)
        packed = (packed << np.uint32(10)) | ((part < 0).astype(np.uint32) << np.uint32(9)) | magnitude
    return packed.astype("<u4")


def _packed_sh(
    rows: NDArray[np.float32], uses: NDArray[np.int64] | None, signs: NDArray[np.float32], clamped: Clamped
) -> NDArray[np.uint8]:
    values = rows.reshape(len(rows), len(signs), 3)
    packed = np.empty(values.shape, np.uint8)
    for start in range(0, len(rows), _BLOCK):
        block = slice(start, start + _BLOCK)
        packed[block] = clamped.nearest(
            "shN", 128 * signs * values[block] + 128, (0, 255), None if uses is None else uses[block]
        )
    return packed


def read_spz(path: str | os.PathLike[str]) -> CompressedScene:
    """Read a ``.spz`` file of version 1 to 4, with any axes; other extensions are ignored.

    Raises:
        FormatError: The file is truncated, altered, of another version, or not a ``.spz`` file; or version 4 needs
            Zstandard, and it is not installed.
    """
    header, arrays = read_frame(path)
    config = {"antialiased": True} if header.flags & ANTIALIASED else {}
    if not header.axes:
        logger.info(
            "%s: the file does not say where its axes point; taken as right, down, front, as in .ply. If it is upside "
            "down: nsvq convert --up minus-y --up-from 0 1 0", path,
        )  # fmt: skip
    axes = header.axes or DEFAULT_AXES.upper()
    turn = axes[1] in "FB"
    if turn:  # z is up or down: signs first, then a quarter turn, as Niantic's library does it, which writes such files
        axes = axes[0] + axes[2] + {"F": "B", "B": "F"}[axes[1]]
    scene = CompressedScene.from_arrays(_unpacked(header, arrays, _Signs.of(axes)), config=config)
    return rotated(scene, UP_AXES["z"]) if turn else scene


def _unpacked(header: SpzHeader, arrays: dict[str, NDArray[np.uint8]], signs: _Signs) -> SplatArrays:
    harmonics = signs.harmonics(header.sh_degree)
    sh = (arrays["shN"].reshape(header.count, len(harmonics), 3).astype(np.float32) - 128) / 128
    return SplatArrays(
        means=(_unpacked_means(header, arrays["means"]) * signs.axes).astype(np.float32),
        quats=_unpacked_quats(header, arrays["quats"]) * signs.quats,
        scales=(arrays["scales"] / 16 - 10).astype(np.float32),
        opacities=logits_of_bytes(arrays["opacities"][:, 0]),
        sh0=((arrays["sh0"][:, None] / 255 - 0.5) / _COLOR).astype(np.float32),
        shN=(sh * harmonics).astype(np.float32),
    )


def _unpacked_means(header: SpzHeader, data: NDArray[np.uint8]) -> NDArray[np.floating[Any]]:
    if header.version == 1:
        return np.ascontiguousarray(data).view("<f2").astype(np.float64)
    # Put three bytes at the top of four, then shift down with the sign.
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
    return xyzw[:, [3, 0, 1, 2]]
