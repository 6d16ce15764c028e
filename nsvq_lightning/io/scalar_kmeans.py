"""The few levels that represent many values with the least squared error (Max 1960, Lloyd 1982)."""

import heapq
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.splats.conventions import Float32s, Float64s, Uint8s


def split(best_cut: Callable[[int, int], tuple[float, int]], size: int, count: int) -> list[tuple[int, int]]:
    """Start and end of cells of ``size`` numbers: of one cell of all, always the one that gains most is cut in two.

    Args:
        best_cut: From start and end of a cell, how much a cut gains and where it is; below 0 if there is none.
        size: How many numbers there are.
        count: Largest number of cells.
    """
    gain, cut = best_cut(0, size)
    heap = [(-gain, 0, cut, size)]
    while len(heap) < count and heap[0][0] <= 0:
        _, start, cut, end = heapq.heappop(heap)
        for first, last in ((start, cut), (cut, end)):
            gain, inner = best_cut(first, last)
            heapq.heappush(heap, (-gain, first, inner, last))
    return [(start, end) for _, start, _, end in heap]


def scalar_kmeans(values: Float32s, weight: NDArray[np.integer] | None = None, count: int = 256) -> Float32s:
    """Levels ``[count]``, ascending, that nearly minimize the mean squared distance of values to their nearest level.

    If there are no more distinct values than levels, the levels are those values. Otherwise one cell of all values is
    split where that gains most, then always the cell that gains most, until there are enough; Lloyd steps then move
    each level to the mean of its values until none moves. On random numbers this ends within a tenth of the optimum.

    Args:
        values: Any shape, at least one, finite.
        weight: How often each value counts, broadcasts with ``values``; once if None.
        count: Number of levels; the last one is repeated if fewer are enough.
    """
    distinct, inverse = np.unique(values, return_inverse=True)
    weights = None if weight is None else np.broadcast_to(weight, values.shape).ravel().astype(np.float64)
    mass = np.bincount(inverse.ravel(), weights, minlength=len(distinct)).astype(np.float64)
    numbers, mass = distinct[mass > 0].astype(np.float64), mass[mass > 0]
    if len(numbers) <= count:
        return np.pad(numbers, (0, count - len(numbers)), "edge").astype(np.float32)
    cells = _Cells(numbers, mass)
    starts = sorted(start for start, _ in split(cells.best_split, len(numbers), count))
    levels = cells.means(np.array([*starts, len(numbers)]), np.zeros(count))
    for _ in range(500):  # each costs one search of 256 borders, whatever the number of values
        ends = np.concatenate([[0], np.searchsorted(numbers, _borders(levels)), [len(numbers)]])
        moved = cells.means(ends, levels)
        if np.array_equal(moved, levels):
            break
        levels = moved
    return levels.astype(np.float32)


def nearest_level(values: Float32s, levels: Float32s) -> Uint8s:
    """Index of the level nearest to each value; ``levels`` ascending, at most 256."""
    return np.searchsorted(_borders(levels.astype(np.float64)), values).astype(np.uint8)


def _borders(levels: Float64s) -> Float64s:
    return (levels[1:] + levels[:-1]) / 2


class _Cells:
    """Sums over runs of sorted values, each a cell with one level: its mean."""

    def __init__(self, numbers: Float64s, mass: Float64s) -> None:
        self._middle = float(np.average(numbers, weights=mass))  # sums of differences from it lose no digits
        self._mass = np.concatenate([[0.0], np.cumsum(mass)])
        self._sum = np.concatenate([[0.0], np.cumsum(mass * (numbers - self._middle))])

    def means(self, ends: NDArray[np.intp], empty: Float64s) -> Float64s:
        """Means ``[C]`` of the cells between ``ends [C + 1]``; for a cell without values, that of ``empty [C]``."""
        mass = np.diff(self._mass[ends])
        return np.where(mass > 0, np.diff(self._sum[ends]) / np.where(mass > 0, mass, 1) + self._middle, empty)

    def best_split(self, first: int, end: int) -> tuple[float, int]:
        """The largest reduction of the sum of squares by splitting a cell, and where; -1 for a cell of one value."""
        if end - first < 2:
            return -1.0, first
        cuts = slice(first + 1, end)
        left, right = self._mass[cuts] - self._mass[first], self._mass[end] - self._mass[cuts]
        left_sum, right_sum = self._sum[cuts] - self._sum[first], self._sum[end] - self._sum[cuts]
        gains = np.square(left_sum / left - right_sum / right) * (left * right / (left + right))
        best = int(gains.argmax())
        return float(gains[best]), first + 1 + best
