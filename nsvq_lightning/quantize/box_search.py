"""Exact nearest code in few dimensions: two levels of boxes around the codes, on 16-lane vectors.

A query visits only the nodes and leaves whose box is not farther than its best code so far. The distances to a box and
to a code are computed with the same sequence of roundings, each monotone in its operands, so the float32 bound never
exceeds the float32 distance of a code inside: pruning needs no safety margin, and the result is that of a search over
all codes, bit for bit. The first candidate is the best code of the leaf that looks nearest; a bad one costs time but
does not change the result.

Most queries of a later step need no search: :class:`BoxMemory` keeps where a query was last searched and how far the
second-nearest code was then. As long as the distance to its code and the distances that the query and the codes have
moved add up to less, the code is still the nearest (:mod:`tracking`).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from nsvq_lightning.compute.jit import inline, kernel, thread_count
from nsvq_lightning.compute.memory import (
    FLOAT32,
    FLOAT64,
    INT32,
    INT64,
    aligned_empty,
    check_array,
    check_table,
    outside,
)
from nsvq_lightning.compute.rows import count_outside
from nsvq_lightning.compute.simd import (
    broadcast,
    fma,
    get,
    lane_min,
    load,
    lowest_bit,
    mask_bits,
    put,
    select,
    store,
    vmax,
    vmin,
)

__all__ = [
    "MAX_DIM",
    "NO_CODE",
    "ROUNDING",
    "UNKNOWN",
    "BoxMemory",
    "Boxes",
    "box_search",
    "build_boxes",
    "check_boxes",
    "empty_memory",
]


NO_CODE = np.int32(np.iinfo(np.int32).max)
"""Label of a lane without a code."""


class Boxes(NamedTuple):
    """Codes sorted into boxes.

    Attributes:
        codes: Leaves, ``[nodes · 16, D, 16]``; lanes without a code are at infinity.
        labels: Codes of the lanes, ``[nodes · 16, 16]`` int32.
        leaves: Lower and upper corners of the leaves of a node, ``[nodes, D, 2, 16]``.
        nodes: Lower and upper corners of the nodes, ``[nodes / 16, D, 2, 16]``.
        order: Codes in lane order, ``[K]`` int32.
    """

    codes: NDArray[np.float32]
    labels: NDArray[np.int32]
    leaves: NDArray[np.float32]
    nodes: NDArray[np.float32]
    order: NDArray[np.int32]


@inline
def _widest_axis(points, order, start, stop):  # type: ignore[no-untyped-def]
    axis, widest = 0, np.float32(-1.0)
    for j in range(points.shape[0]):
        low = high = points[j, order[start]]
        for i in range(start + 1, stop):
            value = points[j, order[i]]
            low, high = min(low, value), max(high, value)
        if high - low > widest:
            axis, widest = j, high - low
    return axis


@inline
def _split(values, order, start, stop, middle):  # type: ignore[no-untyped-def]
    """Quickselect: the ``middle - start`` smallest of ``order[start:stop]`` come first."""
    stop -= 1
    while start < stop:
        pivot = values[order[(start + stop) // 2]]
        low, high = start, stop
        while low <= high:
            while values[order[low]] < pivot:
                low += 1
            while values[order[high]] > pivot:
                high -= 1
            if low <= high:
                order[low], order[high] = order[high], order[low]
                low, high = low + 1, high - 1
        if middle <= high:
            stop = high
        elif middle >= low:
            start = low
        else:
            return


@inline
def _sort_into_leaves(points, order, start, stop):  # type: ignore[no-untyped-def]
    """Split by medians at multiples of 256 codes (a node), then of 16 (a leaf)."""
    stack = np.empty((64, 2), np.int64)
    stack[0, 0], stack[0, 1] = start, stop
    depth = 1
    while depth > 0:
        depth -= 1
        start, stop = stack[depth, 0], stack[depth, 1]
        size = 256 if stop - start > 256 else 16
        if stop - start <= size:
            continue
        middle = start + (stop - start + size - 1) // size // 2 * size
        _split(points[_widest_axis(points, order, start, stop)], order, start, stop, middle)
        stack[depth, 0], stack[depth, 1] = start, middle
        stack[depth + 1, 0], stack[depth + 1, 1] = middle, stop
        depth += 2


@kernel
def _order_codes(points, order, cuts):  # type: ignore[no-untyped-def]
    """Sort the parts between ``cuts`` into leaves, in parallel."""
    for part in prange(cuts.shape[0] - 1):
        _sort_into_leaves(points, order, cuts[part], cuts[part + 1])


@kernel
def _pack(points, order, codes, labels, leaves, nodes):  # type: ignore[no-untyped-def]
    dim, count = points.shape
    for node in prange(leaves.shape[0]):
        for j in range(dim):
            node_low, node_high = np.float32(np.inf), np.float32(-np.inf)
            for child in range(16):
                leaf = node * 16 + child
                low, high = np.float32(np.inf), np.float32(-np.inf)
                for lane in range(16):
                    place = leaf * 16 + lane
                    value, label = np.float32(np.inf), NO_CODE
                    if place < count:
                        label = order[place]
                        value = points[j, label]
                        low, high = min(low, value), max(high, value)
                    codes[leaf, j, lane] = value
                    labels[leaf, lane] = label
                leaves[node, j, 0, child] = low
                leaves[node, j, 1, child] = high
                node_low, node_high = min(node_low, low), max(node_high, high)
            nodes[node // 16, j, 0, node % 16] = node_low
            nodes[node // 16, j, 1, node % 16] = node_high


def build_boxes(codebook: NDArray[np.float32], order: NDArray[np.int32] | None = None) -> Boxes:
    """Put the codes ``[K, D]`` into boxes. Codes with a NaN are placed at infinity and never chosen.

    ``order`` may be that of earlier boxes: much faster, correct in any case, and good while codes have moved little.

    Raises:
        ValueError: There is no code, the codebook is not contiguous, or ``order`` does not hold ``[K]`` codes.
        TypeError: A dtype is wrong.
    """
    check_table("codebook", codebook)
    count, dim = codebook.shape
    if count == 0:
        raise ValueError(f"the codebook must have at least one code, got shape {list(codebook.shape)}; fit it first")
    points = np.ascontiguousarray(codebook.T)
    points[np.isnan(points)] = np.inf
    nodes = -(-count // 4096) * 16
    thread_count()
    if order is None:
        order = np.arange(count, dtype=np.int32)
        _order_codes(points, order, np.array([0, count]))
    else:
        check_array("order", order, (count,), INT32)
        if order.min() < 0 or order.max() >= count:
            raise outside("order", order, count)
    boxes = Boxes(
        aligned_empty((nodes * 16, dim, 16)),
        np.empty((nodes * 16, 16), np.int32),
        aligned_empty((nodes, dim, 2, 16)),
        aligned_empty((nodes // 16, dim, 2, 16)),
        order,
    )
    _pack(points, order, *boxes[:4])
    return boxes


def check_boxes(boxes: Boxes, codebook: NDArray[np.float32]) -> None:
    """Refuse boxes that do not fit a codebook ``[K, D]`` with K at least 1.

    Raises:
        ValueError: There is no code, or an array has another shape or is not contiguous.
        TypeError: A dtype is wrong.
    """
    count, dim = codebook.shape
    nodes = -(-count // 4096) * 16
    if count == 0:
        raise ValueError(f"the codebook must have at least one code, got shape {list(codebook.shape)}; fit it first")
    check_array("boxes.codes", boxes.codes, (nodes * 16, dim, 16), FLOAT32)
    check_array("boxes.labels", boxes.labels, (nodes * 16, 16), INT32)
    check_array("boxes.leaves", boxes.leaves, (nodes, dim, 2, 16), FLOAT32)
    check_array("boxes.nodes", boxes.nodes, (nodes // 16, dim, 2, 16), FLOAT32)


MAX_DIM = 8
"""Beyond this dimension, boxes prune too little, and the scores of :mod:`scores` are faster."""

UNKNOWN = np.int32(-1)
"""Stands for the last code of a row that has not been searched."""

ROUNDING = 1.0 + 1e-5
"""Factor on the bounds, far above the relative rounding error of a float32 distance."""

_LARGEST = np.finfo(np.float32).max
_ROWS = 512
"""Queries per unit of parallel work; a pass over them hides the latency of one query behind the others."""
_TASKS = 2048
"""Capacity for visits to leaves, which are deferred and processed together."""


class BoxMemory(NamedTuple):
    """What is known about rows from their last search.

    Attributes:
        last: Code, or ``UNKNOWN``, ``[N]`` int32.
        anchors: Where the row was then, ``[N, D]``.
        clearance: Distance below which there was no other code, plus how far the codes had moved by then, ``[N]`` in
            float64, because movements add up over a whole run.
    """

    last: NDArray[np.int32]
    anchors: NDArray[np.float32]
    clearance: NDArray[np.float64]


def empty_memory(count: int, dim: int) -> BoxMemory:
    """Memory of ``count`` rows that have not been searched."""
    return BoxMemory(np.full(count, UNKNOWN), np.zeros((count, dim), np.float32), np.full(count, -np.inf))


@inline
def _box_distances(dim, boxes, at, x, row):  # type: ignore[no-untyped-def]
    """Squared distances of a query to 16 boxes."""
    zero = broadcast(np.float32(0.0))
    total = zero
    for j in range(dim):
        value = broadcast(get(x, row + j))
        below = load(boxes, at + 32 * j) - value
        above = value - load(boxes, at + 32 * j + 16)
        gap = vmax(vmax(below, above), zero)
        total = fma(gap, gap, total)
    return total


@inline
def _code_distances(dim, codes, leaf, x, row):  # type: ignore[no-untyped-def]
    """Squared distances of a query to the 16 codes of a leaf."""
    total = broadcast(np.float32(0.0))
    for j in range(dim):
        difference = load(codes, (leaf * dim + j) * 16) - broadcast(get(x, row + j))
        total = fma(difference, difference, total)
    return total


@inline
def _visit_leaf(dim, codes, labels, leaf, x, row, limit, scratch, found):  # type: ignore[no-untyped-def]
    """Compare the codes of a leaf that are not farther than ``limit``; of equal distances the lower code wins.

    ``found`` holds the smallest distance so far, its code and the distance of the second-nearest code.
    """
    best, label, second = found
    distances = _code_distances(dim, codes, leaf, x, row)
    bits = mask_bits(distances <= broadcast(limit))
    if bits != 0:
        store(scratch, 0, distances)
        while bits != 0:
            lane = lowest_bit(bits)
            bits &= bits - 1
            distance, code = get(scratch, lane), get(labels, leaf * 16 + lane)
            if distance < best or (distance == best and code < label):
                best, label, second = distance, code, best
            elif distance < second:
                second = distance
    return best, label, second


@inline
def _nearest_node(dim, nodes, x, row):  # type: ignore[no-untyped-def]
    """Node whose box is nearest (0 for a query with a NaN)."""
    nearest, group_of = broadcast(np.float32(np.inf)), broadcast(np.float32(0.0))
    for group in range(nodes.size // (32 * dim)):
        distances = _box_distances(dim, nodes, group * 32 * dim, x, row)
        group_of = select(distances < nearest, broadcast(np.float32(group)), group_of)
        nearest = vmin(distances, nearest)
    smallest = broadcast(lane_min(nearest))
    group = lane_min(select(nearest <= smallest, group_of, broadcast(np.float32(np.inf))))
    lane = mask_bits((nearest <= smallest) & (group_of <= broadcast(group)))
    return np.int64(group) * 16 + lowest_bit(lane)


@inline
def _prove(dim, codebook, x, row, code, memory, travelled):  # type: ignore[no-untyped-def]
    """Whether a bound proves that a row has kept its last code."""
    _, anchors, clearance = memory
    moved = distance = np.float32(0.0)
    for j in range(dim):
        value = get(x, row * dim + j)
        from_anchor, from_code = value - get(anchors, row * dim + j), value - get(codebook, code * dim + j)
        moved += from_anchor * from_anchor
        distance += from_code * from_code
    way = (np.float64(np.sqrt(distance)) + np.float64(np.sqrt(moved))) * ROUNDING
    return way < get(clearance, row) - travelled


@inline
def _remember(dim, x, at, found, memory, row, travelled):  # type: ignore[no-untyped-def]
    """Keep where a row was searched and the distance of its second-nearest code."""
    last, anchors, clearance = memory
    _, code, second = found
    put(last, row, code)
    for j in range(dim):
        put(anchors, row * dim + j, get(x, at + j))
    # There may still be codes beyond the largest float32 number.
    put(clearance, row, np.sqrt(np.float64(min(second, _LARGEST))) / ROUNDING + travelled)


@inline
def _guess(dim, tree, x, count, state):  # type: ignore[no-untyped-def]
    """For each query, find the best code of one near leaf: three passes without unpredictable branches."""
    codes, labels, leaves, nodes = tree
    best, label, second, guess, _, scratch, bounded = state
    infinity = np.float32(np.inf)
    for i in range(count):
        put(guess, i, _nearest_node(dim, nodes, x, i * dim))
    for i in range(count):
        node = get(guess, i)
        distances = _box_distances(dim, leaves, node * 32 * dim, x, i * dim)
        lane = lowest_bit(mask_bits(distances <= broadcast(lane_min(distances))))
        put(guess, i, node * 16 + lane)
    for i in range(count):
        leaf = get(guess, i)
        distances = _code_distances(dim, codes, leaf, x, i * dim)
        limit = lane_min(distances)
        if bounded:
            limit = lane_min(select(distances > broadcast(limit), distances, broadcast(infinity)))
        found = _visit_leaf(dim, codes, labels, leaf, x, i * dim, limit, scratch, (infinity, NO_CODE, infinity))
        put(best, i, found[0])
        put(label, i, found[1])
        put(second, i, found[2])


@inline
def _visit_leaves(dim, tree, x, state, pending):  # type: ignore[no-untyped-def]
    """Visit the pending (query, leaf) pairs."""
    codes, labels, _, _ = tree
    best, label, second, _, tasks, scratch, bounded = state
    for t in range(pending):
        i, leaf = get(tasks, 2 * t), get(tasks, 2 * t + 1)
        found = get(best, i), get(label, i), get(second, i)
        limit = found[2] if bounded else found[0]
        found = _visit_leaf(dim, codes, labels, leaf, x, i * dim, limit, scratch, found)
        put(best, i, found[0])
        put(label, i, found[1])
        put(second, i, found[2])


@inline
def _visit_near(dim, tree, x, count, state):  # type: ignore[no-untyped-def]
    """Visit every other leaf that is not farther than the best code so far, or the second-best if that is needed."""
    _, _, leaves, nodes = tree
    best, _, second, guess, tasks, _, bounded = state
    pending = 0
    for i in range(count):
        row, limit = i * dim, broadcast(get(second, i) if bounded else get(best, i))
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
    """The search for one dimension, a compile-time constant, so that short loops over it are unrolled."""

    def search(x, rows, codebook, codes, labels, leaves, nodes, memory, travelled, result):  # type: ignore[no-untyped-def]
        total, bounded, missing = result.shape[0], memory[0].shape[0] > 0, 0
        for block in prange((total + _ROWS - 1) // _ROWS):
            best, label, second = np.empty(_ROWS, np.float32), np.empty(_ROWS, np.int32), np.empty(_ROWS, np.float32)
            guess, tasks = np.empty(_ROWS, np.int64), np.empty(2 * _TASKS, np.int64)
            state = best, label, second, guess, tasks, np.empty(16, np.float32), bounded
            tree, queries = (codes, labels, leaves, nodes), np.empty(_ROWS * dim, np.float32)
            places = np.empty(_ROWS, np.int64)
            count, first, stop = 0, block * _ROWS, min(total, (block + 1) * _ROWS)
            found_outside = count_outside(rows, first, stop, x.shape[0] // dim)
            missing += found_outside
            for i in range(first, stop if found_outside == 0 else first):
                row = get(rows, i)
                last = np.int64(get(memory[0], row)) if bounded else np.int64(UNKNOWN)
                put(result, i, last)
                put(places, count, i)
                known = last >= 0 and last < codebook.shape[0] // dim
                count += not (known and _prove(dim, codebook, x, row, last, memory, travelled))
            for i in range(count):
                row = get(rows, get(places, i))
                for j in range(dim):
                    put(queries, i * dim + j, get(x, row * dim + j))
            _guess(dim, tree, queries, count, state)
            _visit_near(dim, tree, queries, count, state)
            for i in range(count):
                nearest = get(label, i) if get(label, i) != NO_CODE else np.int32(0)
                put(result, get(places, i), np.int64(nearest))
                if bounded:
                    found = get(best, i), nearest, get(second, i)
                    _remember(dim, queries, i * dim, found, memory, get(rows, get(places, i)), travelled)
        return missing

    return kernel(search)


def box_search(
    x: NDArray[np.float32],
    codebook: NDArray[np.float32],
    boxes: Boxes,
    rows: NDArray[np.int64] | None = None,
    memory: BoxMemory | None = None,
    travelled: float = 0.0,
) -> NDArray[np.int64]:
    """Nearest codes ``[V]`` of contiguous queries; one with a NaN gets code 0.

    Args:
        x: Queries ``[N, D]``.
        codebook: Codes ``[K, D]``, contiguous.
        boxes: The same codes in boxes.
        rows: Which queries, ``[V]``, distinct; all of them by default.
        memory: Results of earlier searches, updated in place; without it every query is searched.
        travelled: Upper bound on how far any code has moved in total since ``memory`` was empty.

    Raises:
        ValueError: The arrays do not fit together, one is not contiguous, a row is out of range, or there is no code.
        TypeError: A dtype is wrong.
    """
    check_table("x", x)
    rows = np.arange(len(x)) if rows is None else rows
    memory = empty_memory(0, x.shape[1]) if memory is None else memory
    check_array("rows", rows, (rows.size,), INT64)
    check_array("codebook", codebook, (len(codebook), x.shape[1]), FLOAT32)
    check_boxes(boxes, codebook)
    _check_memory(memory, x)
    result = np.empty(len(rows), np.int64)
    thread_count()
    tree = (part.ravel() for part in boxes[:4])
    flat = memory.last, memory.anchors.ravel(), memory.clearance
    if _search_kernel(x.shape[1])(x.ravel(), rows, codebook.ravel(), *tree, flat, float(travelled), result):
        raise outside("rows", rows, len(x))
    return result


def _check_memory(memory: BoxMemory, x: NDArray[np.float32]) -> None:
    """Check that the memory is empty or has at least all rows; it may have more if the scene was larger before."""
    count = len(memory.last)
    if 0 < count < len(x):
        raise ValueError(f"memory must have the {len(x)} rows of x, got {count}")
    check_array("memory.last", memory.last, (count,), INT32)
    check_array("memory.anchors", memory.anchors, (count, x.shape[1]), FLOAT32)
    check_array("memory.clearance", memory.clearance, (count,), FLOAT64)
