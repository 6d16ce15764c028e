"""Searches that remember: the same codes as :func:`nearest`, bit for bit, mostly without a search.

From one training step to the next rows and codes move little. In many dimensions the tracker keeps for every row the
codes that were near when it was last searched, where the row was then, and the distance R below which there was no
other code. With d the distance to the nearest of the list now, m how far the row has moved and Δ how far any code can
have moved, d + m + Δ < R proves that the nearest code is in the list (the triangle inequality, as in Hamerly's
k-means). In few dimensions a search is cheap, and what is kept is the order in which codes were put into boxes.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.quantize.box_search import MAX_DIM, box_search
from nsvq_lightning.quantize.boxes import build_boxes
from nsvq_lightning.quantize.kernels import aligned_empty, lane_min
from nsvq_lightning.quantize.nearest import check_rows, nearest
from nsvq_lightning.quantize.scores import LIST, centre_codes, score_search, true_distance
from nsvq_lightning.rendering.cpu.jit import inline, kernel, thread_count
from nsvq_lightning.rendering.cpu.lanes import fma, get, lane_sum, lane_sums, load, lowest_bit, mask_bits, put, splat

__all__ = ["NearestTracker"]

_BLOCK = 256
"""Rows a unit of parallel work takes."""
_BOX_STEPS = 32
"""Searches after which the codes are put into boxes anew; boxes of an old order are right, but larger."""
_SNAPSHOT_STEPS = 16
"""Searches between two snapshots of the codebook. A code's way is taken as the sum of its ways from one snapshot to the
next: the more snapshots, the more a random walk counts as if it went straight on."""
_ROUNDING = 1.0 + 1e-5
"""Bounds are taken this much larger, far above what rounding does to a distance in float32."""

Floats = NDArray[np.float32]


@inline
def _distance(vectors, row, padded, code):  # type: ignore[no-untyped-def]
    total = splat(np.float32(0.0))
    for j in range(vectors):
        difference = load(row, 16 * j) - load(padded, code * 16 * vectors + 16 * j)
        total = fma(difference, difference, total)
    return total


@inline
def _member(vectors, row, padded, lists, at, place):  # type: ignore[no-untyped-def]
    return _distance(vectors, row, padded, np.int64(get(lists, at + place)))


@kernel
def _check_lists(x, codebook, padded, rows, lists, anchors, limits, drift, result):  # type: ignore[no-untyped-def]
    """Nearest codes of the rows whose list provably holds it, -1 for the others."""
    dim = x.shape[0] // rows.shape[0]
    vectors = (dim + 15) // 16
    for block in prange((rows.shape[0] + _BLOCK - 1) // _BLOCK):
        here, unused = np.zeros(16 * vectors, np.float32), np.zeros(16, np.float32)
        unused[LIST:] = np.inf
        for i in range(block * _BLOCK, min(rows.shape[0], (block + 1) * _BLOCK)):
            row = rows[i]
            for j in range(dim):
                put(here, j, get(x, i * dim + j))
            moved = np.sqrt(lane_sum(_distance(vectors, here, anchors, row)))
            at = row * LIST
            sums = (
                _member(vectors, here, padded, lists, at, 0),
                _member(vectors, here, padded, lists, at, 1),
                _member(vectors, here, padded, lists, at, 2),
                _member(vectors, here, padded, lists, at, 3),
                _member(vectors, here, padded, lists, at, 4),
                _member(vectors, here, padded, lists, at, 5),
                _member(vectors, here, padded, lists, at, 6),
                _member(vectors, here, padded, lists, at, 7),
            )
            squared = lane_sums(sums) + load(unused, 0)
            best = lane_min(squared)
            result[i] = -1
            if (np.float64(np.sqrt(best)) + moved) * _ROUNDING < limits[row] - drift:
                near = mask_bits(squared <= splat(best * np.float32(_ROUNDING)))
                result[i] = _settle(dim, x, i, codebook, lists, at, near)


@inline
def _settle(dim, x, row, codebook, lists, at, near):  # type: ignore[no-untyped-def]
    """Nearest by true distance among the members of a list whose bits are set."""
    code = np.int64(get(lists, at + lowest_bit(near)))
    if near & (near - 1) == 0:
        return code
    distance = np.float32(np.inf)
    while near != 0:
        candidate = np.int64(get(lists, at + lowest_bit(near)))
        near &= near - 1
        candidate_distance = true_distance(dim, x, row, codebook, candidate)
        if candidate_distance < distance or (candidate_distance == distance and candidate < code):
            code, distance = candidate, candidate_distance
    return code


def _padded(values: Floats, rows: int, fill: float) -> Floats:
    """``values [N, D]`` as ``[rows, D']`` with D' a multiple of 16; ``fill`` in added rows, 0 in added columns."""
    count, dim = values.shape
    out = aligned_empty((rows, -(-dim // 16) * 16))
    out[:, dim:] = 0
    out[:count, :dim] = values
    out[count:, :dim] = fill
    return out


class NearestTracker:
    """Nearest codes of the same rows, step after step.

    What it remembers costs memory (232 bytes a row for D = 45) and never changes a result, so no checkpoint needs it.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start afresh; worth calling when codes have jumped."""
        self._steps = 0
        self._order: NDArray[np.int32] | None = None
        self._snapshot: Floats | None = None
        self._travelled = 0.0
        self._lists = np.zeros((0, LIST), np.int32)
        self._anchors = np.zeros((0, 0), np.float32)
        self._limits = np.zeros(0)  # float64: ways add up over a whole run

    def search(self, x: Tensor, codebook: Tensor, rows: Tensor | None = None) -> Tensor:
        """Nearest codes, the result of :func:`nearest`.

        Args:
            x: Rows ``[V, D]``.
            codebook: Codes ``[K, D]``.
            rows: Numbers ``[V]`` int64 of these rows among all rows; without them nothing is remembered about rows.

        Returns:
            Codes ``[V]`` int64.

        Raises:
            ValueError: The shapes do not fit together.
            TypeError: The dtypes differ or are not floating point.
        """
        check_rows(x, codebook)
        if x.device.type != "cpu" or x.dtype != torch.float32:
            return nearest(x, codebook)
        values, codes = x.detach().contiguous().numpy(), codebook.detach().contiguous().numpy()
        if x.shape[1] <= MAX_DIM:
            return torch.from_numpy(self._search_boxes(values, codes))
        if rows is None or len(rows) == 0:
            return nearest(x, codebook)
        if rows.shape != x.shape[:1] or int(rows.min()) < 0:
            raise ValueError(f"rows must be {x.shape[0]} numbers from 0 on, got shape {list(rows.shape)}")
        return torch.from_numpy(self._search_lists(values, codes, rows.contiguous().numpy()))

    def _search_boxes(self, x: Floats, codebook: Floats) -> NDArray[np.int64]:
        if self._order is None or len(self._order) != len(codebook) or self._steps % _BOX_STEPS == 0:
            self._order = None
        self._steps += 1
        boxes = build_boxes(codebook, self._order)
        self._order = boxes.order
        return box_search(x, boxes)

    def _search_lists(self, x: Floats, codebook: Floats, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        drift = self._drift(codebook)
        self._grow(int(rows.max()) + 1, x.shape[1])
        result = np.empty(len(x), np.int64)
        padded = _padded(codebook, len(codebook) + 1, np.inf)  # lists are filled up with code K, infinitely far
        thread_count()
        _check_lists(
            x.ravel(),
            codebook.ravel(),
            padded.ravel(),
            rows,
            self._lists.ravel(),
            self._anchors.ravel(),
            self._limits,
            self._travelled + drift,
            result,
        )
        unsure = np.flatnonzero(result < 0)
        if len(unsure):
            where = rows[unsure]
            found = score_search(x[unsure], centre_codes(codebook), with_lists=True)
            result[unsure], self._lists[where], limits = found
            self._anchors[where, : x.shape[1]] = x[unsure]
            self._limits[where] = limits / _ROUNDING - drift + self._travelled
        return result

    def _drift(self, codebook: Floats) -> float:
        """Farthest way of a code since the snapshot; takes a new snapshot when it is time."""
        if self._snapshot is None or self._snapshot.shape != codebook.shape:
            self.forget()
            self._snapshot = codebook.copy()
        difference = codebook - self._snapshot
        drift = float(np.sqrt(np.einsum("kd,kd->k", difference, difference).max())) * _ROUNDING
        self._steps += 1
        if self._steps % _SNAPSHOT_STEPS == 0:
            self._travelled += drift
            self._snapshot, drift = codebook.copy(), 0.0
        return drift

    def _grow(self, count: int, dim: int) -> None:
        old = len(self._limits)
        if count <= old:
            return
        count = max(count, old + old // 2)
        lists, self._lists = self._lists, np.zeros((count, LIST), np.int32)
        anchors, self._anchors = self._anchors, np.zeros((count, -(-dim // 16) * 16), np.float32)
        limits, self._limits = self._limits, np.full(count, -np.inf)
        self._lists[:old], self._limits[:old] = lists, limits
        if old:
            self._anchors[:old] = anchors
