"""Positions as integers on a grid, in Morton order, each only as fine as necessary."""

from typing import NamedTuple, Self

import numpy as np

from nsvq_lightning.compute.jit import inline, kernel
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.io.numbers import power_above, power_below
from nsvq_lightning.splats.conventions import Bools, Float32s, Float64s, Int32s, Int64s, Integers, Uint64s, middle_of

# Bits per coordinate: three coordinates make a key of 63 bits.
AXIS_BITS = 21

# Masks of groups of 1, 2, 4, 8, 16 and 21 adjacent bits, with gaps of twice that length between.
_MASKS = 0x1249249249249249, 0x10C30C30C30C30C3, 0x100F00F00F00F00F, 0x1F0000FF0000FF, 0x1F00000000FFFF, 0x1FFFFF
_SHIFTS = 2, 4, 8, 16, 32
# Above every squared distance times the window.
_NONE = 2.0**52
# Rows before a row that are searched for neighbours. 64 instead of 16 would save another 0.05 of 8 bits of codes.
_WINDOW = 16


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


def nearest_before(cells: Int64s) -> Int32s:
    """The two nearest ``[N, 2]`` of the 16 rows before each row of ``cells [N, 3]``, nearest first; -1 where none is.

    Distances are integers, and the earlier of two equally near rows is taken: every machine finds the same rows.

    Raises:
        ValueError: ``cells`` is not ``[N, 3]``, or not contiguous.
        TypeError: It is not int64.
    """
    check_fit("cells [N, 3] int64", cells)
    found = np.empty((len(cells), 2), np.int32)
    _search_before(np.ascontiguousarray(cells.T, np.float64), found)
    return found


# Rows that are searched side by side.
_BLOCK = 256


@kernel
def _search_before(axes, found):  # type: ignore[no-untyped-def]
    count = len(found)
    for block in range(-(-count // _BLOCK)):
        start = block * _BLOCK
        end = min(start + _BLOCK, count)
        # A distance and, for equal ones, the place in the window in one number, exact in float64: two minima without
        # branches, in vectors along the rows.
        first = np.full(_BLOCK, _NONE)
        second = np.full(_BLOCK, _NONE)
        for back in range(1, _WINDOW + 1):
            for i in range(max(start, back), end):
                x = axes[0, i] - axes[0, i - back]
                y = axes[1, i] - axes[1, i - back]
                z = axes[2, i] - axes[2, i - back]
                found_now = (x * x + y * y + z * z) * _WINDOW + (_WINDOW - back)
                least = first[i - start]
                later = found_now if least < found_now else least
                first[i - start] = found_now if found_now < least else least
                second[i - start] = later if later < second[i - start] else second[i - start]
        for i in range(start, end):
            found[i, 0] = _row(i, first[i - start])
            found[i, 1] = _row(i, second[i - start])


@inline
def _row(i, place):  # type: ignore[no-untyped-def]
    """The row that a number of the search stands for; -1 for none."""
    return i - (_WINDOW - np.int64(place) % _WINDOW) if place < _NONE else -1


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
