"""Exact nearest code in few dimensions: two levels of boxes around the codes, on 16-lane vectors.

A query visits only the nodes and leaves whose box is not farther than its best code so far. The distances to a box and
to a code are computed with the same sequence of roundings, each monotone in its operands, so the float32 bound never
exceeds the float32 distance of a code inside: pruning needs no safety margin, and the result is that of a search over
all codes, bit for bit. The first candidate is the best code of the leaf that looks nearest; a bad one costs time but
does not change the result.

Most queries of a later step need no search: a memory keeps where a query was last searched and how far the
second-nearest code was then. As long as the distance to its code and the distances that the query and the codes have
moved add up to less, the code is still the nearest (:mod:`tracking`).
"""

from functools import cache
from typing import Any

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline, parallel, thread_count
from nsvq_lightning.compute.memory import Array, aligned_empty, check_fit, check_inside
from nsvq_lightning.compute.rows import count_outside
from nsvq_lightning.compute.simd import fma, get, integer, lane_min, load, lowest_bit, mask_bits, put, store

# Factor on the bounds, far above the relative rounding error of a float32 distance.
ROUNDING = 1.0 + 1e-5
_NO_CODE = np.int32(np.iinfo(np.int32).max)  # label of a lane without a code
_ROWS = 512  # queries per unit of parallel work; a pass over them hides the latency of one behind the others
_TASKS = 2048  # capacity for visits to leaves, which are deferred and processed together


# Beyond this dimension, boxes prune too little, and the scores of :mod:`scores` are faster.
MAX_DIM = 8


def sort_into_leaves(codebook: Array) -> Array:
    """Codes ``[K]`` int32 in an order in which each 16, a leaf, are near each other, and each 256, a node.

    What is larger is cut near the median of the axis along which it is widest. Those with a NaN lie far away.
    """
    order = np.arange(len(codebook), dtype=np.int32)
    columns = np.nan_to_num(codebook.T, nan=3e38).astype(np.float64)
    parts = [order]
    while parts:
        part = parts.pop()
        size = 256 if len(part) > 256 else 16
        if len(part) > size:
            middle = -(-len(part) // size) // 2 * size
            values = columns[:, part]
            widest = values[np.ptp(values, axis=1).argmax()]
            part[:] = part[widest.argpartition(middle)]
            parts += part[:middle], part[middle:]
    return order


def _boxes(codebook: Array, order: Array) -> tuple[Array, ...]:
    """The codes in boxes, flat.

    Leaves ``[nodes · 16, D, 16]``, lanes without a code at infinity; the codes of their lanes ``[nodes · 16, 16]``;
    lower and upper corners of the leaves of a node ``[nodes, D, 2, 16]``, and of the nodes ``[nodes / 16, D, 2, 16]``.
    """
    count, dim = codebook.shape
    nodes = -(-count // 4096) * 16
    points, labels = np.full((256 * nodes, dim), np.inf, np.float32), np.full(256 * nodes, _NO_CODE)
    points[:count], labels[:count] = codebook.take(order, 0), order
    points[np.isnan(points)] = np.inf  # where no code is chosen
    tree = [aligned_empty((16 * nodes, dim, 16)), labels]
    tree[0][:] = points.reshape(-1, 16, dim).mT
    low, high = points, points.copy()
    high[count:] = -np.inf
    for _ in range(2):  # corners of leaves, then of nodes
        # A copy with the lanes first, as NumPy is slow along a short axis in the middle.
        low, high = (each.reshape(-1, 16, dim).swapaxes(0, 1).copy() for each in (low, high))
        low, high = low.min(0), high.max(0)
        corners = [each.reshape(-1, 16, dim).mT for each in (low, high)]
        tree.append(aligned_empty((len(low) // 16, dim, 2, 16)))
        np.stack(corners, axis=2, out=tree[-1])
    return tuple(array.ravel() for array in tree)


@inline
def _box_distances(dim, boxes, at, x, row):
    """Squared distances of a query to 16 boxes."""
    total = simd.broadcast(0)
    for j in range(dim):
        value = get(x, row + j)
        below = load(boxes, at + 32 * j) - value
        above = value - load(boxes, at + 32 * j + 16)
        gap = simd.maximum(simd.maximum(below, above), 0)
        total = fma(gap, gap, total)
    return total


@inline
def code_distances(dim, codes, at, x, row):
    """Squared distances of a query to 16 codes, whose columns follow each other."""
    total = simd.broadcast(0)
    for j in range(dim):
        difference = load(codes, at + 16 * j) - get(x, row + j)
        total = fma(difference, difference, total)
    return total


@inline
def _visit_leaf(dim, tree, leaf, x, i, limit, state):
    """Compare the codes of a leaf that are not farther than ``limit``; of equal distances the lower code wins."""
    codes, labels, _, _ = tree
    best, label, second, _, _, scratch, _ = state
    distances = code_distances(dim, codes, leaf * dim * 16, x, i * dim)
    bits = mask_bits(distances <= limit)
    if bits != 0:
        store(scratch, 0, distances)
        while bits != 0:
            lane = lowest_bit(bits)
            bits &= bits - 1
            distance, code = get(scratch, lane), get(labels, leaf * 16 + lane)
            smallest = get(best, i)
            if distance < smallest or (distance == smallest and code < get(label, i)):
                put(second, i, smallest)
                put(best, i, distance)
                put(label, i, code)
            elif distance < get(second, i):
                put(second, i, distance)


@inline
def place_of_least(least, block_of):
    """Where the least of blocks of 16 numbers is, the first of equal ones; lanes hold their least and its block."""
    smallest = lane_min(least)
    block = lane_min(simd.where(least <= smallest, block_of, np.inf))
    lane = mask_bits((least <= smallest) & (block_of <= block))
    return np.int64(block) * 16 + lowest_bit(lane)


@inline
def _nearest_node(dim, nodes, x, row):
    """Node whose box is nearest (0 for a query with a NaN)."""
    nearest, group_of = simd.broadcast(np.inf), simd.broadcast(0)
    for group in range(nodes.size // (32 * dim)):
        distances = _box_distances(dim, nodes, group * 32 * dim, x, row)
        group_of = simd.where(distances < nearest, group, group_of)
        nearest = simd.minimum(distances, nearest)
    return place_of_least(nearest, group_of)


@inline
def _prove(dim, codebook, x, row, code, memory, travelled):
    """Whether a bound proves that a row has kept its last code."""
    _, anchors, clearance = memory
    moved = distance = F(0.0)
    for j in range(dim):
        value = get(x, row * dim + j)
        from_anchor, from_code = value - get(anchors, row * dim + j), value - get(codebook, code * dim + j)
        moved += from_anchor * from_anchor
        distance += from_code * from_code
    way = (np.float64(np.sqrt(distance)) + np.float64(np.sqrt(moved))) * ROUNDING
    return way < get(clearance, row) - travelled


@inline
def _guess(dim, tree, x, count, state):
    """For each query, find the best code of one near leaf: three passes without unpredictable branches."""
    codes, _, leaves, nodes = tree
    best, label, second, guess, _, _, bounded = state
    for i in range(count):
        put(guess, i, _nearest_node(dim, nodes, x, i * dim))
    for i in range(count):
        node = get(guess, i)
        distances = _box_distances(dim, leaves, node * 32 * dim, x, i * dim)
        lane = lowest_bit(mask_bits(distances <= lane_min(distances)))
        put(guess, i, node * 16 + lane)
    for i in range(count):
        leaf = get(guess, i)
        distances = code_distances(dim, codes, leaf * dim * 16, x, i * dim)
        limit = lane_min(distances)
        if bounded:
            limit = lane_min(simd.where(distances > limit, distances, np.inf))
        put(best, i, np.inf)
        put(label, i, _NO_CODE)
        put(second, i, np.inf)
        _visit_leaf(dim, tree, leaf, x, i, limit, state)


@inline
def _limit(i, state):
    """Distance beyond which no code matters: the best so far, or the second-best if that is needed."""
    best, _, second, _, _, _, bounded = state
    return get(second, i) if bounded else get(best, i)


@inline
def _visit_leaves(dim, tree, x, state, pending):
    """Visit the pending (query, leaf) pairs."""
    tasks = state[4]
    for t in range(pending):
        i, leaf = get(tasks, 2 * t), get(tasks, 2 * t + 1)
        _visit_leaf(dim, tree, leaf, x, i, _limit(i, state), state)


@inline
def _visit_near(dim, tree, x, count, state):
    """Visit every other leaf that may hold a code that matters."""
    _, _, leaves, nodes = tree
    _, _, _, guess, tasks, _, _ = state
    pending = 0
    for i in range(count):
        row, limit = i * dim, _limit(i, state)
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
    largest = np.finfo(np.float32).max

    def search(block, _, x, rows, codebook, tree, memory, travelled, result):
        last_codes, anchors, clearance = memory
        bounded = last_codes.shape[0] > 0
        best, second = np.empty(_ROWS, np.float32), np.empty(_ROWS, np.float32)
        label, guess = np.empty(_ROWS, np.int32), np.empty(_ROWS, np.int64)
        state = best, label, second, guess, np.empty(2 * _TASKS, np.int64), np.empty(16, np.float32), bounded
        queries, places = np.empty(_ROWS * dim, np.float32), np.empty(_ROWS, np.int64)
        first, stop = block * _ROWS, min(result.shape[0], (block + 1) * _ROWS)
        found_outside = count_outside(rows, first, stop, x.shape[0] // dim)
        if found_outside > 0:
            return found_outside
        count = 0
        for i in range(first, stop):
            row, proven = get(rows, i), False
            if bounded:
                code = integer(last_codes, row)
                put(result, i, code)
                known = code >= 0 and code < codebook.shape[0] // dim
                proven = known and _prove(dim, codebook, x, row, code, memory, travelled)
            if not proven:
                put(places, count, i)
                for j in range(dim):
                    put(queries, count * dim + j, get(x, row * dim + j))
                count += 1
        _guess(dim, tree, queries, count, state)
        _visit_near(dim, tree, queries, count, state)
        for i in range(count):
            place, nearest = get(places, i), get(label, i)
            if nearest == _NO_CODE:
                nearest = np.int32(0)
            put(result, place, nearest)
            if bounded:
                row = get(rows, place)
                put(last_codes, row, nearest)
                for j in range(dim):
                    put(anchors, row * dim + j, get(queries, i * dim + j))
                # There may still be codes beyond the largest float32 number.
                away = np.float64(min(get(second, i), largest))
                put(clearance, row, np.sqrt(away) / ROUNDING + travelled)
        return 0

    return parallel(search)


def box_search(
    x: Array,
    codebook: Array,
    order: Array | None = None,
    rows: Array | None = None,
    memory: tuple[Array, ...] | None = None,
    travelled: float = 0.0,
) -> Array:
    """Nearest codes ``[V]`` of queries; one with a NaN gets code 0.

    Args:
        x: Queries ``[N, D]``, contiguous float32.
        codebook: Codes ``[K, D]``, contiguous float32, K at least 1.
        order: From :func:`sort_into_leaves`. That of an earlier codebook saves the sorting, is correct in any case, and
            good while codes have moved little.
        rows: Which queries, ``[V]`` int64, distinct and in [0, N); all of them by default.
        memory: What is known of these rows (it may have more) from their last searches, updated in place: their codes
            ``[N]`` int32, -1 before the first; where they were then ``[N, D]``; and the distances below which there was
            no other code, plus how far the codes had moved by then, ``[N]`` in float64, because movements add up over a
            whole run. Without it every query is searched.
        travelled: Upper bound on how far any code has moved in total since ``memory`` was empty.

    Raises:
        ValueError: The arrays do not fit together, one is not contiguous, or a row or a code is out of range.
        TypeError: A dtype is wrong.
    """
    count, dim = x.shape
    order = sort_into_leaves(codebook) if order is None else order
    rows = np.arange(count) if rows is None else rows
    last, anchors, clearance = memory or (np.empty(0, np.int32), np.empty((0, dim), np.float32), np.empty(0))
    text = "x [N, D], codebook [K, D], order [K] int32, rows [V] int64, codes [M] int32, anchors [M, D], "
    remembered = max(count, len(last)) if memory else 0
    check_fit(f"{text}clearance [M] float64", x, codebook, order, rows, last, anchors, clearance, M=remembered)
    check_inside("order", order, len(codebook))
    result = np.empty(len(rows), np.int64)
    thread_count()
    blocks, tree = -(-len(rows) // _ROWS), _boxes(codebook, order)
    known = last, anchors.ravel(), clearance
    if _search_kernel(dim)(blocks, x.ravel(), rows, codebook.ravel(), tree, known, float(travelled), result):
        check_inside("rows", rows, count)
    return result
