"""Exact nearest code in few dimensions: two levels of boxes around the codes, on 16-lane vectors.

A query visits only the nodes and leaves whose box is not farther than its best code so far. The distance to a box and
the distance to a code are the same sequence of roundings, each monotone in its operands, so the float32 bound never
exceeds the float32 distance of a code inside: pruning needs no safety margin, and the result is that of a search over
all codes, bit for bit. The first code to compare with is the one of the last search, where there was one, else the best
of the leaf that looks nearest; a bad start costs time and changes nothing.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from nsvq_lightning.quantize.boxes import NO_CODE, Boxes
from nsvq_lightning.quantize.kernels import lane_min
from nsvq_lightning.rendering.cpu.jit import inline, kernel, thread_count
from nsvq_lightning.rendering.cpu.lanes import (
    fma,
    get,
    load,
    lowest_bit,
    mask_bits,
    put,
    select,
    splat,
    store,
    vmax,
    vmin,
)

__all__ = ["MAX_DIM", "UNKNOWN", "box_search"]

MAX_DIM = 8
"""Above it a box holds most of the space around its codes, and the scores of :mod:`scores` are faster."""

UNKNOWN = np.int32(-1)
"""The last code of a row that has not been searched."""

_ROWS = 512
"""Queries a unit of parallel work takes; a pass over them hides the latency of one query behind the others."""
_TASKS = 2048
"""Visits to leaves that are put off until there are enough of them."""


@inline
def _box_distances(dim, boxes, at, x, row):  # type: ignore[no-untyped-def]
    """Squared distances of a query to 16 boxes."""
    zero = splat(np.float32(0.0))
    total = zero
    for j in range(dim):
        value = splat(get(x, row + j))
        below = load(boxes, at + 32 * j) - value
        above = value - load(boxes, at + 32 * j + 16)
        gap = vmax(vmax(below, above), zero)
        total = fma(gap, gap, total)
    return total


@inline
def _code_distances(dim, codes, leaf, x, row):  # type: ignore[no-untyped-def]
    """Squared distances of a query to the 16 codes of a leaf."""
    total = splat(np.float32(0.0))
    for j in range(dim):
        difference = load(codes, (leaf * dim + j) * 16) - splat(get(x, row + j))
        total = fma(difference, difference, total)
    return total


@inline
def _visit_leaf(dim, codes, labels, leaf, x, row, limit, scratch, best, label):  # type: ignore[no-untyped-def]
    """Compare the codes of a leaf that are not farther than ``limit``; of equal distances the lower code wins."""
    distances = _code_distances(dim, codes, leaf, x, row)
    bits = mask_bits(distances <= splat(limit))
    if bits != 0:
        store(scratch, 0, distances)
        while bits != 0:
            lane = lowest_bit(bits)
            bits &= bits - 1
            distance, code = get(scratch, lane), get(labels, leaf * 16 + lane)
            if distance < best or (distance == best and code < label):
                best, label = distance, code
    return best, label


@inline
def _nearest_node(dim, nodes, x, row):  # type: ignore[no-untyped-def]
    """Node whose box is nearest (0 for a query that is not a number)."""
    nearest, group_of = splat(np.float32(np.inf)), splat(np.float32(0.0))
    for group in range(nodes.size // (32 * dim)):
        distances = _box_distances(dim, nodes, group * 32 * dim, x, row)
        group_of = select(distances < nearest, splat(np.float32(group)), group_of)
        nearest = vmin(distances, nearest)
    smallest = splat(lane_min(nearest))
    group = lane_min(select(nearest <= smallest, group_of, splat(np.float32(np.inf))))
    lane = mask_bits((nearest <= smallest) & (group_of <= splat(group)))
    return np.int64(group) * 16 + lowest_bit(lane)


@inline
def _recall(dim, codebook, x, rows, first, last, state, count):  # type: ignore[no-untyped-def]
    """Start every query of a block from its last code; False where one has none at a finite distance."""
    best, label, guess, _, _ = state
    for i in range(count):
        code = np.int64(get(last, get(rows, first + i)))
        if code < 0:
            return False
        total = splat(np.float32(0.0))
        for j in range(dim):
            difference = splat(get(codebook, code * dim + j)) - splat(get(x, i * dim + j))
            total = fma(difference, difference, total)
        distance = lane_min(total)
        if not distance < np.float32(np.inf):
            return False
        put(best, i, distance)
        put(label, i, np.int32(code))
        put(guess, i, -1)
    return True


@inline
def _guess(dim, tree, x, count, state):  # type: ignore[no-untyped-def]
    """For each query the best code of one near leaf: three passes without unpredictable branches."""
    codes, labels, leaves, nodes = tree
    best, label, guess, _, scratch = state
    for i in range(count):
        put(guess, i, _nearest_node(dim, nodes, x, i * dim))
    for i in range(count):
        node = get(guess, i)
        distances = _box_distances(dim, leaves, node * 32 * dim, x, i * dim)
        lane = lowest_bit(mask_bits(distances <= splat(lane_min(distances))))
        put(guess, i, node * 16 + lane)
    for i in range(count):
        leaf = get(guess, i)
        limit = lane_min(_code_distances(dim, codes, leaf, x, i * dim))
        nearest, code = _visit_leaf(dim, codes, labels, leaf, x, i * dim, limit, scratch, np.float32(np.inf), NO_CODE)
        put(best, i, nearest)
        put(label, i, code)


@inline
def _visit_leaves(dim, tree, x, state, pending):  # type: ignore[no-untyped-def]
    """Visit the pending (query, leaf) pairs."""
    codes, labels, _, _ = tree
    best, label, _, tasks, scratch = state
    for t in range(pending):
        i, leaf = get(tasks, 2 * t), get(tasks, 2 * t + 1)
        limit = get(best, i)
        nearest, code = _visit_leaf(dim, codes, labels, leaf, x, i * dim, limit, scratch, limit, get(label, i))
        put(best, i, nearest)
        put(label, i, code)


@inline
def _visit_near(dim, tree, x, count, state):  # type: ignore[no-untyped-def]
    """Visit every other leaf that is not farther than the best code so far."""
    _, _, leaves, nodes = tree
    best, _, guess, tasks, _ = state
    pending = 0
    for i in range(count):
        row, limit = i * dim, splat(get(best, i))
        for group in range(nodes.size // (32 * dim)):
            near_nodes = mask_bits(_box_distances(dim, nodes, group * 32 * dim, x, row) <= limit)
            while near_nodes != 0:
                node = group * 16 + lowest_bit(near_nodes)
                near_nodes &= near_nodes - 1
                near_leaves = mask_bits(_box_distances(dim, leaves, node * 32 * dim, x, row) <= limit)
                while near_leaves != 0:
                    leaf = node * 16 + lowest_bit(near_leaves)
                    near_leaves &= near_leaves - 1
                    put(tasks, 2 * pending, i)
                    put(tasks, 2 * pending + 1, leaf)
                    pending += leaf != get(guess, i)
                if pending > _TASKS - 16:
                    _visit_leaves(dim, tree, x, state, pending)
                    pending = 0
    _visit_leaves(dim, tree, x, state, pending)


@cache
def _search_kernel(dim: int) -> Any:
    """The search for one dimension: a constant for the compiler, so that short loops over it disappear."""

    def search(x, rows, codebook, codes, labels, leaves, nodes, last, result):  # type: ignore[no-untyped-def]
        total = result.shape[0]
        for block in prange((total + _ROWS - 1) // _ROWS):
            best, label = np.empty(_ROWS, np.float32), np.empty(_ROWS, np.int32)
            guess, tasks = np.empty(_ROWS, np.int64), np.empty(2 * _TASKS, np.int64)
            state = best, label, guess, tasks, np.empty(16, np.float32)
            tree, queries = (codes, labels, leaves, nodes), np.empty(_ROWS * dim, np.float32)
            first = block * _ROWS
            count = min(_ROWS, total - first)
            for i in range(count):
                for j in range(dim):
                    put(queries, i * dim + j, get(x, get(rows, first + i) * dim + j))
            if not _recall(dim, codebook, queries, rows, first, last, state, count):
                _guess(dim, tree, queries, count, state)
            _visit_near(dim, tree, queries, count, state)
            for i in range(count):
                code = get(label, i) if get(label, i) != NO_CODE else np.int32(0)
                put(result, first + i, np.int64(code))
                put(last, get(rows, first + i), code)

    return kernel(search)


def box_search(
    x: NDArray[np.float32],
    codebook: NDArray[np.float32],
    boxes: Boxes,
    rows: NDArray[np.int64] | None = None,
    last: NDArray[np.int32] | None = None,
) -> NDArray[np.int64]:
    """Nearest codes ``[V]`` of contiguous queries; one that is not a number gets code 0.

    Args:
        x: Queries ``[N, D]``.
        codebook: Codes ``[K, D]``, contiguous.
        boxes: The same codes in boxes.
        rows: Which queries, ``[V]``, all different; all of them by default.
        last: Code ``[N]`` below K that a query had when it was searched last, or ``UNKNOWN``; updated.
    """
    rows = np.arange(len(x)) if rows is None else rows
    last = np.full(len(x), UNKNOWN) if last is None else last
    result = np.empty(len(rows), np.int64)
    thread_count()
    tree = (part.ravel() for part in boxes[:4])
    _search_kernel(x.shape[1])(x.ravel(), rows, codebook.ravel(), *tree, last, result)
    return result
