"""Positions as integers on a grid, in Morton order, each only as fine as necessary."""

from typing import NamedTuple, Self

import numpy as np

from nsvq_lightning.io.numbers import power_above, power_below
from nsvq_lightning.splats.conventions import Bools, Float32s, Float64s, Int64s, Integers, Uint64s, middle_of

# Bits per coordinate: three coordinates make a key of 63 bits.
AXIS_BITS = 21

# Masks of groups of 1, 2, 4, 8, 16 and 21 adjacent bits, with gaps of twice that length between.
_MASKS = 0x1249249249249249, 0x10C30C30C30C30C3, 0x100F00F00F00F00F, 0x1F0000FF0000FF, 0x1F00000000FFFF, 0x1FFFFF
_SHIFTS = 2, 4, 8, 16, 32


class Grid(NamedTuple):
    """A cube with 2^21 cells per side, in which position ``x`` is in cell ``floor(x / step) - base``.

    A position in the middle of its cell stays there on every grid that gives its splat a cell of the same width.

    Attributes:
        step: Side of the finest cell, scene units; a power of two.
        base: First cell along each axis, in cells from the scene's origin.
    """

    step: float
    base: tuple[int, ...]

    @classmethod
    def around(cls, means: Float32s, widest: Float64s) -> Self:
        """The grid for positions ``[N, 3]`` whose cells may be at most ``widest [N]`` wide.

        Its cells are small enough for all but the smallest thousandth of splats, yet not below 2⁻²⁰ of the extent of
        all but the outermost thousandth at either end of each axis; so the cube holds all but a few far splats. Where
        that is too coarse for a tenth of the splats, more are outside, up to a quarter.
        """
        if len(means) == 0:
            return cls(1.0, (0, 0, 0))
        for far in (0.001, 0.02, 0.25):
            low, high = np.quantile(means.astype(np.float64), (far, 1 - far), axis=0)
            extent = max((high - low).max(), np.abs([low, high]).max() * 2.0**-40, 1e-30)
            finest = power_above(extent * 2.0 ** (1 - AXIS_BITS))  # the scene takes up to half of each side of the grid
            if not 0 < np.quantile(widest, 0.1) < finest:
                break
        step = power_below(max(np.quantile(widest, 0.001), finest))
        # Cells up to a quarter of the grid lie on multiples of their own width, whichever scene it was made for.
        quarter = 1 << AXIS_BITS - 2
        base = np.rint(((low + high) / 2 / step - 2 * quarter) / quarter).astype(np.int64) * quarter
        return cls(step, tuple(base.tolist()))

    def cells(self, means: Float32s) -> tuple[Int64s, Bools]:
        """Cell of each position ``[N, 3]``, 0 for those outside; and which ``[N]`` are inside."""
        cells = np.floor(means.astype(np.float64, "C") / self.step) - self.base
        inside = np.logical_and.reduce((cells >= 0) & (cells < 1 << AXIS_BITS), axis=1)
        return np.where(inside[:, None], cells, 0).astype(np.int64), inside

    def depths(self, doublings: Float64s) -> Int64s:
        """Bits per axis ``[N]``, 0 to 21, of cells that are at most 2 to the power of ``doublings [N]`` steps wide."""
        return AXIS_BITS - np.clip(np.floor(doublings), 0, AXIS_BITS).astype(np.int64)

    def centers(self, cells: Int64s, depths: Int64s) -> Float32s:
        """Centre of the cell of ``depths [N]`` bits that holds each cell ``[N, 3]``, scene units."""
        shift = (AXIS_BITS - depths)[:, None]
        middles = (cells >> shift << shift) + 0.5 * (1 << shift) + self.base
        return (middles * self.step).astype(np.float32)


def morton_keys(cells: Int64s, depths: Int64s) -> Uint64s:
    """Interleaved bits of coordinates ``[N, 3]``, highest first, x before y before z; those below ``depths`` are 0."""
    shift = AXIS_BITS - depths
    keys = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        # Two zeros between adjacent bits of the 21.
        bits: Integers = (cells[:, axis] >> shift << shift).astype(np.uint64)
        for mask, gap in zip(_MASKS[-2::-1], _SHIFTS[::-1], strict=True):
            bits = (bits | bits << gap) & mask
        keys |= bits << (2 - axis)
    return keys


def unmorton(keys: Uint64s) -> Int64s:
    """Coordinates ``[N, 3]`` of keys ``[N]``."""
    cells = np.empty((len(keys), 3), np.int64)
    for axis in range(3):
        bits = keys >> (2 - axis) & _MASKS[0]
        for mask, gap in zip(_MASKS[1:], _SHIFTS, strict=True):
            bits = (bits | bits >> gap) & mask
        cells[:, axis] = bits
    return cells


def spatial_order(means: Float32s) -> Integers:
    """Indices ``[N]`` of splats in Morton order of their positions ``[N, 3]``; equal ones keep their order.

    Those that are twice, four times, … as far out as four fifths of the splats follow, so that what few of them would
    stretch the bounds of is theirs alone; those within an eighth, a sixteenth, … of that come first, as what is near
    before a far background.
    """
    if not len(means):
        return np.arange(0)
    cells, _ = Grid.around(means, np.zeros(len(means))).cells(means)
    keys = morton_keys(cells, np.full(len(means), AXIS_BITS))
    middle, usual = middle_of(means)
    _, doublings = np.frexp(np.linalg.norm(means - middle, axis=1) / max(usual, 1e-30) / 2)
    return np.lexsort((keys, np.maximum(doublings, (doublings + 3).clip(None, 0))))
