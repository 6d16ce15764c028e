"""Searches that remember: the same codes as :func:`nearest`, bit for bit, mostly without a search.

From one training step to the next, rows and codes move little. In many dimensions the tracker keeps for every row its
last code, the list of codes that were near when it was last searched, where the row was then, and two distances: R1,
below which there was no code but the nearest, and R, below which there was none outside the list. With d the distance
to the last code now, m how far the row has moved and Δ how far any code can have moved, d + m + Δ < R1 proves that the
code has not changed; with d the distance to the nearest code of the list, d + m + Δ < R proves that this is the nearest
of all (the triangle inequality, as in Hamerly's k-means). In few dimensions there is no list, only R1, which
:mod:`box_search` checks itself, and the order in which codes were put into boxes.
"""

from __future__ import annotations

from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import inline, kernel, thread_count
from nsvq_lightning.compute.memory import INT64, check_array
from nsvq_lightning.compute.simd import (
    broadcast,
    fma,
    get,
    lane_min,
    lane_sum,
    lane_sums,
    load,
    lowest_bit,
    mask_bits,
    put,
    store,
)
from nsvq_lightning.quantize.box_search import MAX_DIM, ROUNDING, BoxMemory, box_search, build_boxes, empty_memory
from nsvq_lightning.quantize.nearest import check_rows, nearest
from nsvq_lightning.quantize.scores import LIST, centre_codes, score_search, true_distance

if TYPE_CHECKING:
    from nsvq_lightning.quantize.cuda.tracking import DeviceTracker

__all__ = ["NearestTracker"]

_BLOCK = 256
"""Rows per unit of parallel work."""
_BOX_STEPS = 32
"""Searches after which the codes are sorted into boxes anew; boxes in an old order are correct, but larger."""
_SNAPSHOT_STEPS = 16
"""Searches between two snapshots of the codebook. How far a code has moved is the sum of its distances from snapshot to
snapshot: the more snapshots, the more a random walk counts as if it were a straight line."""

Floats = NDArray[np.float32]


@inline
def _squares(dim, a, at_a, b, at_b, keep):  # type: ignore[no-untyped-def]
    """Squared differences of two rows, to be summed. ``keep`` masks the overlap of the last two vectors."""
    total = broadcast(np.float32(0.0))
    if dim < 16:
        for j in range(dim):
            difference = broadcast(get(a, at_a + j) - get(b, at_b + j)) * load(keep, 0)
            total = fma(difference, difference, total)
        return total
    for j in range(0, dim // 16 * 16, 16):
        difference = load(a, at_a + j) - load(b, at_b + j)
        total = fma(difference, difference, total)
    if dim % 16:
        difference = (load(a, at_a + dim - 16) - load(b, at_b + dim - 16)) * load(keep, 0)
        total = fma(difference, difference, total)
    return total


def _overlap(dim: int) -> Floats:
    """1 in the lanes of a row's last vector that the one before does not cover, else 0; a single 1 for short rows."""
    keep = np.zeros(16, np.float32)
    keep[-(dim % 16) if dim > 16 else -1 :] = 1
    return keep


@inline
def _member(dim, x, at, codebook, lists, place, keep):  # type: ignore[no-untyped-def]
    return _squares(dim, x, at, codebook, np.int64(get(lists, place)) * dim, keep)


@inline
def _list_squared(dim, x, at, codebook, lists, start, keep):  # type: ignore[no-untyped-def]
    """Squared distances to the codes of a list, one per lane; the other lanes hold 0."""
    return lane_sums(
        (
            _member(dim, x, at, codebook, lists, start, keep),
            _member(dim, x, at, codebook, lists, start + 1, keep),
            _member(dim, x, at, codebook, lists, start + 2, keep),
            _member(dim, x, at, codebook, lists, start + 3, keep),
            _member(dim, x, at, codebook, lists, start + 4, keep),
            _member(dim, x, at, codebook, lists, start + 5, keep),
            _member(dim, x, at, codebook, lists, start + 6, keep),
            _member(dim, x, at, codebook, lists, start + 7, keep),
        )
    )


@inline
def _settle(dim, x, row, codebook, lists, start, near):  # type: ignore[no-untyped-def]
    """Nearest code by true distance among the members of a list whose bits are set."""
    code = np.int64(get(lists, start + lowest_bit(near)))
    if near & (near - 1) == 0:
        return code
    distance = np.float32(np.inf)
    while near != 0:
        candidate = np.int64(get(lists, start + lowest_bit(near)))
        near &= near - 1
        candidate_distance = true_distance(dim, x, row, codebook, candidate)
        if candidate_distance < distance or (candidate_distance == distance and candidate < code):
            code, distance = candidate, candidate_distance
    return code


@inline
def _second_smallest(squared, near, scratch):  # type: ignore[no-untyped-def]
    """Smallest lane other than the lowest one whose bit is set."""
    store(scratch, 0, squared)
    put(scratch, lowest_bit(near), np.float32(np.inf))
    return lane_min(load(scratch, 0))


@cache
def _check_kernel(dim: int) -> Any:
    """The check for one dimension, a compile-time constant."""

    def check(x, rows, codebook, memory, keep, travelled, drift, result):  # type: ignore[no-untyped-def]
        last, lists, anchors, clearance, limits = memory
        way = travelled + drift
        for block in prange((rows.shape[0] + _BLOCK - 1) // _BLOCK):
            unused, scratch = np.zeros(16, np.float32), np.empty(16, np.float32)
            unused[LIST:] = np.inf
            for i in range(block * _BLOCK, min(rows.shape[0], (block + 1) * _BLOCK)):
                row = get(rows, i)
                at, start, code = row * dim, row * LIST, np.int64(get(last, row))
                put(result, i, np.int64(-1))
                if code < 0:
                    continue
                moved = np.float64(np.sqrt(lane_sum(_squares(dim, x, at, anchors, at, keep)))) * ROUNDING
                distance = np.sqrt(lane_sum(_squares(dim, x, at, codebook, code * dim, keep)))
                if np.float64(distance) * ROUNDING + moved < get(clearance, row) - way:
                    put(result, i, code)
                    continue
                squared = _list_squared(dim, x, at, codebook, lists, start, keep) + load(unused, 0)
                best = lane_min(squared)
                distance = np.sqrt(best)
                if np.float64(distance) * ROUNDING + moved < get(limits, row) - way:
                    near = mask_bits(squared <= broadcast(best * np.float32(ROUNDING)))
                    code = _settle(dim, x, row, codebook, lists, start, near)
                    put(result, i, code)
                    put(last, row, np.int32(code))
                    second = np.float64(np.sqrt(_second_smallest(squared, near, scratch)))
                    if near & (near - 1) == 0 and second - distance > moved:
                        # The gap to the second code now exceeds how far the row has moved, so a new anchor pays.
                        for j in range(dim):
                            put(anchors, at + j, get(x, at + j))
                        limit = get(limits, row) - moved
                        put(limits, row, limit)
                        put(clearance, row, min(limit, second / ROUNDING - drift + travelled))

    return kernel(check)


@kernel
def _row_distances(a, b, squares):  # type: ignore[no-untyped-def]
    """Squared distances of the rows of two tables."""
    for i in prange(a.shape[0]):
        total = np.float32(0.0)
        for j in range(a.shape[1]):
            difference = a[i, j] - b[i, j]
            total += difference * difference
        squares[i] = total


@partial(kernel, parallel=False)
def _ascending(rows, count):  # type: ignore[no-untyped-def]
    """Whether row numbers are ascending, distinct and in [0, count)."""
    right = rows.shape[0] == 0 or (rows[0] >= 0 and rows[-1] < count)
    for i in range(1, rows.shape[0]):
        right &= rows[i - 1] < rows[i]
    return right


class NearestTracker:
    """Nearest codes of the same rows, step after step.

    What it remembers takes memory (232 bytes per row for D = 45, 24 for D = 3) but never changes a result, so
    checkpoints do not store it.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget all searches; worth calling when codes have jumped."""
        self._on_device: DeviceTracker | None = None
        self._steps = 0
        self._order: NDArray[np.int32] | None = None
        self._snapshot: Floats | None = None
        self._codebook_shape = (0, 0)
        self._travelled = 0.0
        self._last = np.zeros(0, np.int32)
        self._lists = np.zeros((0, LIST), np.int32)
        self._anchors = np.zeros((0, 0), np.float32)
        # In float64, because movements add up over a whole run.
        self._clearance, self._limits = np.zeros(0), np.zeros(0)

    def search(self, x: Tensor, codebook: Tensor, rows: Tensor | None = None) -> Tensor:
        """Nearest codes, the result of :func:`nearest` for the chosen rows.

        Args:
            x: Rows ``[N, D]``.
            codebook: Codes ``[K, D]``.
            rows: Which rows to search, ``[V]`` int64, ascending, distinct; all of them by default.

        Returns:
            Codes ``[V]`` int64.

        Raises:
            ValueError: The shapes do not fit together, or rows are not ascending, distinct and in range (which is
                checked on the CPU alone).
            TypeError: The dtypes differ or are not floating point, or rows are not int64.
        """
        check_rows(x, codebook)
        if rows is not None and rows.dim() != 1:
            raise ValueError(f"rows must have shape [V], got {list(rows.shape)}")
        kernels = kernels_for(x)
        if kernels == "cuda":
            return self._search_device(x.detach().contiguous(), codebook.detach().contiguous(), rows)
        if kernels is None:
            return nearest(x if rows is None else x.index_select(0, rows), codebook)
        values, codes = x.detach().contiguous().numpy(), codebook.detach().contiguous().numpy()
        chosen = np.arange(len(values)) if rows is None else rows.contiguous().numpy()
        check_array("rows", chosen, (len(chosen),), INT64)
        if not _ascending(chosen, len(values)):
            raise ValueError(f"rows must be ascending, distinct and in [0, {len(values)})")
        if self._codebook_shape != codes.shape:
            self.forget()
            self._codebook_shape = codes.shape
        self._grow(len(values))
        search = self._search_boxes if codes.shape[1] <= MAX_DIM else self._search_lists
        return torch.from_numpy(search(values, codes, chosen))

    def _search_device(self, x: Tensor, codebook: Tensor, rows: Tensor | None) -> Tensor:
        from nsvq_lightning.quantize.cuda.tracking import DeviceTracker

        if self._on_device is None or not self._on_device.fits(codebook):
            self._on_device = DeviceTracker(len(codebook), codebook.shape[1], codebook.device)
        chosen = torch.arange(len(x), device=x.device) if rows is None else rows.contiguous()
        return self._on_device.search(x, codebook, chosen)

    def _search_boxes(self, x: Floats, codebook: Floats, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        boxes = build_boxes(codebook, self._order if self._steps % _BOX_STEPS else None)
        self._order = boxes.order
        self._drift(codebook, 1)
        return box_search(
            x, codebook, boxes, rows, BoxMemory(self._last, self._anchors, self._clearance), self._travelled
        )

    def _search_lists(self, x: Floats, codebook: Floats, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        drift = self._drift(codebook, _SNAPSHOT_STEPS)
        result = np.empty(len(rows), np.int64)
        memory = self._last, self._lists.ravel(), self._anchors.ravel(), self._clearance, self._limits
        dim = x.shape[1]
        thread_count()
        _check_kernel(dim)(x.ravel(), rows, codebook.ravel(), memory, _overlap(dim), self._travelled, drift, result)
        unsure = np.flatnonzero(result < 0)
        if 2 * len(unsure) > len(rows):  # codes have jumped; a new snapshot spares the next searches the cost
            drift = self._take_snapshot(codebook, drift)
        if len(unsure):
            where = rows[unsure]
            found, lists, distances = score_search(x[where], centre_codes(codebook), with_lists=True)
            self._last[where] = result[unsure] = found
            self._lists[where], self._anchors[where] = lists, x[where]
            self._limits[where], self._clearance[where] = distances / ROUNDING - drift + self._travelled
        return result

    def _drift(self, codebook: Floats, every: int) -> float:
        """Farthest that any code has moved since the snapshot; a new one is taken after ``every`` searches."""
        if self._snapshot is None:
            self._snapshot = codebook.copy()
        squares = np.empty(len(codebook), np.float32)
        thread_count()
        _row_distances(codebook, self._snapshot, squares)
        drift = float(np.sqrt(squares.max())) * ROUNDING
        self._steps += 1
        return self._take_snapshot(codebook, drift) if self._steps % every == 0 else drift

    def _take_snapshot(self, codebook: Floats, drift: float) -> float:
        """Take a snapshot of codes that have moved by ``drift`` since the last; returns the new drift, 0."""
        self._travelled += drift
        self._snapshot = codebook.copy()
        return 0.0

    def _grow(self, count: int) -> None:
        """Make room for ``count`` rows."""
        old = len(self._last)
        if count <= old:
            return
        with_lists, dim = self._codebook_shape[1] > MAX_DIM, self._codebook_shape[1]
        more = empty_memory(count - old, dim)
        self._last, self._clearance = np.append(self._last, more.last), np.append(self._clearance, more.clearance)
        self._anchors = np.append(self._anchors.reshape(old, dim), more.anchors, 0)
        if with_lists:
            self._lists = np.append(self._lists, np.zeros((count - old, LIST), np.int32), 0)
            self._limits = np.append(self._limits, more.clearance)
