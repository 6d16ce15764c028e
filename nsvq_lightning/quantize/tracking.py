"""Searches that remember: the same codes as :func:`nearest`, bit for bit, mostly without a search.

From one training step to the next, rows and codes move little. In many dimensions the tracker keeps for every row its
last code, the list of codes that were near when it was last searched, where the row was then, and two distances: R1,
below which there was no code but the nearest, and R, below which there was none outside the list. With d the distance
to the last code now, m how far the row has moved and Δ how far any code can have moved, d + m + Δ < R1 proves that the
code has not changed; with d the distance to the nearest code of the list, d + m + Δ < R proves that this is the nearest
of all (the triangle inequality, as in Hamerly's k-means). In few dimensions there is no list, only R1, which
:mod:`box_search` checks itself, and the order in which codes were put into boxes.
"""

from functools import cache
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import F, inline, parallel, thread_count
from nsvq_lightning.compute.memory import Array, check_fit
from nsvq_lightning.compute.simd import get, integer, load, put, store
from nsvq_lightning.quantize.box_search import MAX_DIM, ROUNDING, box_search, sort_into_leaves
from nsvq_lightning.quantize.nearest import check_rows, nearest
from nsvq_lightning.quantize.scores import LIST, closer, new_lanes, score_search, squares

_BLOCK = 256  # rows per unit of parallel work


@inline
def _list_squared(dim, x, at, codebook, lists, start, keep):
    """Squared distances to the codes of a list, one per lane; the other lanes hold 0."""

    def member(k):
        return squares(dim, x, at, codebook, integer(lists, start + k) * dim, keep)

    return simd.lane_sums((member(0), member(1), member(2), member(3), member(4), member(5), member(6), member(7)))


@inline
def _settle(dim, x, row, codebook, lists, start, near):
    """Nearest code by true distance among the members of a list whose bits are set."""
    code = integer(lists, start + simd.lowest_bit(near))
    if near & (near - 1) == 0:
        return code
    distance = F(np.inf)
    while near != 0:
        candidate = integer(lists, start + simd.lowest_bit(near))
        near &= near - 1
        code, distance = closer(dim, x, row, codebook, code, distance, candidate)
    return code


@cache
def _check_kernel(dim: int) -> Any:
    """The check for one dimension, a compile-time constant."""

    def check(block, _, x, rows, codebook, memory, travelled, drift, result):
        last, anchors, clearance, lists, limits = memory
        way, keep = travelled + drift, new_lanes(dim)
        unused, scratch = np.zeros(16, np.float32), np.empty(16, np.float32)
        unused[LIST:] = np.inf
        for i in range(block * _BLOCK, min(rows.shape[0], (block + 1) * _BLOCK)):
            row = get(rows, i)
            at, start, code = row * dim, row * LIST, integer(last, row)
            put(result, i, np.int64(-1))
            if code < 0:
                continue
            moved = np.float64(np.sqrt(simd.lane_sum(squares(dim, x, at, anchors, at, keep)))) * ROUNDING
            distance = np.sqrt(simd.lane_sum(squares(dim, x, at, codebook, code * dim, keep)))
            if np.float64(distance) * ROUNDING + moved < get(clearance, row) - way:
                put(result, i, code)
                continue
            squared = _list_squared(dim, x, at, codebook, lists, start, keep) + load(unused, 0)
            best = simd.lane_min(squared)
            distance = np.sqrt(best)
            if np.float64(distance) * ROUNDING + moved < get(limits, row) - way:
                near = simd.mask_bits(squared <= best * F(ROUNDING))
                code = _settle(dim, x, row, codebook, lists, start, near)
                put(result, i, code)
                put(last, row, np.int32(code))
                store(scratch, 0, squared)
                put(scratch, simd.lowest_bit(near), F(np.inf))
                second = np.float64(np.sqrt(simd.lane_min(load(scratch, 0))))
                if near & (near - 1) == 0 and second - distance > moved:
                    # The gap to the second code now exceeds how far the row has moved, so a new anchor pays.
                    for j in range(dim):
                        put(anchors, at + j, get(x, at + j))
                    limit = get(limits, row) - moved
                    put(limits, row, limit)
                    put(clearance, row, min(limit, second / ROUNDING - drift + travelled))

    return parallel(check)


def _blank_memory(count: int, dim: int) -> tuple[Array, ...]:
    """What is known about ``count`` rows that have not been searched.

    The memory of :func:`box_search` and, in many dimensions, the codes that were near ``[N, LIST]`` int32, with the
    distance below which there was none outside the list, plus how far the codes had moved by then, ``[N]``.
    """
    listed = count if dim > MAX_DIM else 0
    return (
        np.full(count, -1, np.int32),
        np.zeros((count, dim), np.float32),
        np.full(count, -np.inf),
        np.zeros((listed, LIST), np.int32),
        np.full(listed, -np.inf),
    )


class NearestTracker:
    """Nearest codes of the same rows, step after step.

    What it remembers takes memory (232 bytes per row for D = 45, 24 for D = 3) but never changes a result, so
    checkpoints do not store it.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Forget all searches; worth calling when codes have jumped."""
        self._on_device: Any = None
        self._steps = 0
        self._order: Array | None = None
        self._snapshot = np.zeros((0, 0), np.float32)
        self._travelled = 0.0
        self._memory: tuple[Array, ...] = ()

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
        x, codebook = check_rows(x, codebook)
        chosen = torch.arange(len(x), device=x.device) if rows is None else rows.contiguous()
        check_fit("rows [V] int64", chosen)
        kernels = kernels_for(x)
        if kernels is None:
            return nearest(x if rows is None else x.index_select(0, rows), codebook)
        if kernels == "cuda":
            from nsvq_lightning.quantize.cuda.search import DeviceTracker

            if self._on_device is None or not self._on_device.fits(codebook):
                self._on_device = DeviceTracker(codebook)
            return cast(Tensor, self._on_device.search(x, codebook, chosen))
        numbers = chosen.numpy()
        if len(numbers) and (numbers[0] < 0 or numbers[-1] >= len(x) or not (numbers[1:] > numbers[:-1]).all()):
            raise ValueError(f"rows must be ascending, distinct and in [0, {len(x)})")
        self._make_room(len(x), codebook.numpy())
        search = self._search_boxes if codebook.shape[1] <= MAX_DIM else self._search_lists
        return torch.from_numpy(search(x.numpy(), codebook.numpy(), numbers))

    def _make_room(self, count: int, codebook: Array) -> None:
        """Have a memory of at least ``count`` rows, an empty one if the codebook has another shape than the last."""
        dim = codebook.shape[1]
        if self._snapshot.shape != codebook.shape:
            self.forget()
            self._snapshot, self._memory = codebook.copy(), _blank_memory(0, dim)
        more = count - len(self._memory[0])
        if more > 0:
            self._memory = tuple(map(np.concatenate, zip(self._memory, _blank_memory(more, dim), strict=True)))

    def _search_boxes(self, x: Array, codebook: Array, rows: Array) -> Array:
        if self._steps % 64 == 0 or self._order is None:  # boxes in an old order are larger
            self._order = sort_into_leaves(codebook)
        self._drift(codebook, 1)
        return box_search(x, codebook, self._order, rows, self._memory[:3], self._travelled)

    def _search_lists(self, x: Array, codebook: Array, rows: Array) -> Array:
        # How far a code has moved is the sum of its distances from snapshot to snapshot: the more snapshots, the more a
        # random walk counts as if it were a straight line.
        drift = self._drift(codebook, 16)
        result = np.empty(len(rows), np.int64)
        last, anchors, clearance, lists, limits = self._memory
        memory = tuple(array.ravel() for array in self._memory)
        thread_count()
        blocks = -(-len(rows) // _BLOCK)
        _check_kernel(x.shape[1])(blocks, x.ravel(), rows, codebook.ravel(), memory, self._travelled, drift, result)
        unsure = np.flatnonzero(result < 0)
        if 2 * len(unsure) > len(rows):  # codes have jumped; a new snapshot spares the next searches the cost
            drift = self._take_snapshot(codebook, drift)
        if len(unsure):
            where = rows[unsure]
            found, lists[where], distances = score_search(x[where], codebook, with_lists=True)
            last[where] = result[unsure] = found
            anchors[where] = x[where]
            limits[where], clearance[where] = distances / ROUNDING - drift + self._travelled
        return result

    def _drift(self, codebook: Array, every: int) -> float:
        """Farthest that any code has moved since the snapshot; a new one is taken after ``every`` searches."""
        moved = codebook - self._snapshot
        drift = float(np.sqrt(np.einsum("ij,ij->i", moved, moved).max())) * ROUNDING
        self._steps += 1
        return self._take_snapshot(codebook, drift) if self._steps % every == 0 else drift

    def _take_snapshot(self, codebook: Array, drift: float) -> float:
        """Take a snapshot of codes that have moved by ``drift`` since the last; returns the new drift, 0."""
        self._travelled += drift
        self._snapshot = codebook.copy()
        return 0.0
