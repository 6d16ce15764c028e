"""Positions as integers on a grid, in Morton order, each only as fine as necessary."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange, uint64
from numpy.typing import NDArray

from nsvq_lightning.compute.jit import kernel, thread_count
from nsvq_lightning.compute.memory import INT64, check_array
from nsvq_lightning.io.powers import power_above, power_below

__all__ = ["AXIS_BITS", "Grid", "morton_keys", "nearest_before", "spatial_order", "unmorton"]

AXIS_BITS = 21
"""Bits per coordinate: three coordinates make a key of 63 bits."""

_WINDOW = 16
"""Rows before a row that are searched for neighbours. 64 instead of 16 would save another 0.05 of 8 bits of codes."""

_EXTENT_BITS = AXIS_BITS - 1
"""No step is finer than the extent times ½ to this power: the scene takes up to half of each side of the grid."""

_BASE_BITS = AXIS_BITS - 2
"""The first cell of a grid is a multiple of 2 to this power, so cells up to that wide lie on multiples of their own
width, whichever scene the grid was made for."""


@dataclass(frozen=True)
class Grid:
    """A cube with 2^21 cells per side, in which position ``x`` is in cell ``floor(x / step) - base``.

    A position in the middle of its cell stays there on every grid that gives its splat a cell of the same width.

    Attributes:
        step: Side of the finest cell, scene units; a power of two.
        base: First cell along each axis, in cells from the scene's origin.
    """

    step: float
    base: tuple[int, int, int]

    @classmethod
    def around(cls, means: NDArray[np.float32], widest: NDArray[np.float64]) -> Grid:
        """The grid for positions ``[N, 3]`` whose cells may be at most ``widest [N]`` wide.

        Its cells are small enough for all but the smallest thousandth of splats, yet not below 2⁻²⁰ of the extent of
        all but the outermost thousandth at either end of each axis; so the cube holds all but a few far splats.
        """
        if len(means) == 0:
            return cls(1.0, (0, 0, 0))
        low, high = np.quantile(means.astype(np.float64), (0.001, 0.999), axis=0)
        extent = max(float((high - low).max()), float(np.abs(means).max()) * 2.0**-40, 1e-30)
        finest = power_above(extent * 2.0**-_EXTENT_BITS)
        step = power_below(max(float(np.quantile(widest, 0.001)), finest))
        first = np.rint(((low + high) / 2 / step - (1 << AXIS_BITS - 1)) / (1 << _BASE_BITS))
        return cls(step, tuple(int(cell) << _BASE_BITS for cell in first))  # type: ignore[arg-type]

    def cells(self, means: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Cell of each position ``[N, 3]``, 0 for those outside; and which ``[N]`` are inside."""
        cells = np.floor(means.astype(np.float64) / self.step) - np.array(self.base, np.float64)
        inside = np.logical_and.reduce((cells >= 0) & (cells < 1 << AXIS_BITS), axis=1)
        return np.where(inside[:, None], cells, 0).astype(np.int64), inside

    def depths(self, doublings: NDArray[np.float64]) -> NDArray[np.int64]:
        """Bits per axis ``[N]``, 0 to 21, of cells that are at most 2 to the power of ``doublings [N]`` steps wide."""
        return AXIS_BITS - np.clip(np.floor(doublings), 0, AXIS_BITS).astype(np.int64)

    def centers(self, cells: NDArray[np.int64], depths: NDArray[np.int64]) -> NDArray[np.float32]:
        """Centre of the cell of ``depths [N]`` bits that holds each cell ``[N, 3]``, scene units."""
        width = np.int64(1) << (AXIS_BITS - depths)[:, None]
        middle = (cells // width) * width + 0.5 * width + np.array(self.base, np.float64)
        centers: NDArray[np.float32] = (middle * self.step).astype(np.float32)
        return centers


def morton_keys(cells: NDArray[np.int64], depths: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Interleaved bits of coordinates ``[N, 3]``, highest first, x before y before z; those below ``depths`` are 0."""
    shift = AXIS_BITS - depths
    keys = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        keys |= _spread((cells[:, axis] >> shift << shift).astype(np.uint64)) << np.uint64(2 - axis)
    return keys


def unmorton(keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Coordinates ``[N, 3]`` of keys ``[N]``."""
    return np.stack([_gather(keys >> np.uint64(2 - axis)) for axis in range(3)], axis=1).astype(np.int64)


_MASKS = tuple(
    map(
        np.uint64,
        (0x1249249249249249, 0x10C30C30C30C30C3, 0x100F00F00F00F00F, 0x1F0000FF0000FF, 0x1F00000000FFFF, 0x1FFFFF),
    )
)
"""Masks of groups of 1, 2, 4, 8, 16 and 21 adjacent bits, with gaps of twice that length between."""

_SHIFTS = tuple(map(np.uint64, (2, 4, 8, 16, 32)))


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zeros between adjacent bits of the 21."""
    for mask, shift in zip(_MASKS[4::-1], _SHIFTS[::-1], strict=True):
        values = (values | (values << shift)) & mask
    return values


def _gather(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Collect every third bit, the inverse of :func:`_spread`."""
    values = values & _MASKS[0]
    for mask, shift in zip(_MASKS[1:], _SHIFTS, strict=True):
        values = (values | (values >> shift)) & mask
    return values


def nearest_before(cells: NDArray[np.int64]) -> NDArray[np.int32]:
    """The two nearest ``[N, 2]`` of the 16 rows before each row of ``cells [N, 3]``, nearest first; -1 where none is.

    Distances are integers, and the earlier of two equally near rows is taken: every machine finds the same rows.

    Raises:
        ValueError: ``cells`` is not ``[N, 3]``, or not contiguous.
        TypeError: It is not int64.
    """
    check_array("cells", cells, (len(cells), 3), INT64)
    found = np.empty((len(cells), 2), np.int32)
    thread_count()
    _search_before(cells, found)
    return found


@kernel
def _search_before(cells, found):  # type: ignore[no-untyped-def]
    farthest = uint64(0xFFFFFFFFFFFFFFFF)
    for i in prange(len(cells)):
        first, second = farthest, farthest
        best, next_best = -1, -1
        for j in range(max(0, i - _WINDOW), i):
            x, y, z = cells[i, 0] - cells[j, 0], cells[i, 1] - cells[j, 1], cells[i, 2] - cells[j, 2]
            distance = uint64(x * x + y * y + z * z)
            if distance < first:
                second, next_best = first, best
                first, best = distance, j
            elif distance < second:
                second, next_best = distance, j
        found[i, 0], found[i, 1] = best, next_best


def spatial_order(means: NDArray[np.float32]) -> NDArray[np.intp]:
    """Indices ``[N]`` of splats in Morton order of their positions ``[N, 3]``; equal ones keep their order."""
    cells, _ = Grid.around(means, np.zeros(len(means))).cells(means)
    return morton_keys(cells, np.full(len(means), AXIS_BITS)).argsort(kind="stable")
