"""Exact nearest code in many dimensions: dot products on 16-lane vectors, with ties settled by true distances.

With rows and codes centred on the mean of the codes, ‖x − c‖² = ‖x‖² + 2 s(c) with the score s(c) = ‖c‖²/2 − x·c, one
fused multiply-add per element. A row keeps its few best scores, sorted; most blocks of codes hold no better one, which
a single branch checks for six rows. All codes that can be nearest after rounding are among the best, unless even the
last of these ties up to rounding (many equal codes; then all codes are compared by true distances). The search also
yields a short list of the nearest codes and a distance below which there is no other code, which lets :mod:`tracking`
skip most searches.
"""

from functools import cache
from typing import Any

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline, parallel, thread_count
from nsvq_lightning.compute.memory import Array, aligned_empty, check_fit
from nsvq_lightning.compute.simd import fma, fnma, get, integer, load, put, store

# Codes in the list of a row.
LIST = 8
_BEST = LIST + 1  # scores that a row keeps: those of a list, and the smallest of a code outside it
_GROUP = 6  # rows scored together
_TILE = 8 * _GROUP  # rows that pass over a chunk of codes while it stays in the L1 cache


def _centred(codebook: Array) -> tuple[Array, Array, Array, np.float32]:
    """Mean of the finite codes ``[D]``, and what is centred on it.

    The codes in blocks of 32, ``[⌈K/32⌉, D, 32]`` flat; half their squared norms ``[⌈K/32⌉ · 32]``, infinite where
    there is no finite code, which is 0 there; and the largest norm.
    """
    count, dim = codebook.shape
    finite = np.isfinite(codebook).all(1)
    centre = (codebook[finite] if finite.any() else np.zeros((1, dim))).mean(0, dtype=np.float64).astype(np.float32)
    with np.errstate(over="ignore"):
        codes = np.pad(codebook - centre, ((0, -count % 32), (0, 0)))
        halves = (np.einsum("ij,ij->i", codes, codes, dtype=np.float64) / 2).astype(np.float32)
    lost = ~np.isfinite(halves)
    lost[count:] = True
    codes[lost] = 0
    halves[lost] = np.inf
    blocks = aligned_empty((len(codes) // 32, dim, 32))
    blocks[:] = codes.reshape(-1, 32, dim).mT
    return centre, blocks.ravel(), halves, F(np.sqrt(2 * float(halves[~lost].max(initial=0))))


@inline
def closer(dim, x, row, codebook, code, distance, candidate):
    """The nearer of a code at ``distance`` and a candidate, and its distance; of equally near ones the lower.

    Squared distances are sums of squared differences in one fixed order.
    """
    total = simd.broadcast(0)
    for j in range(dim):
        difference = get(codebook, candidate * dim + j) - get(x, row * dim + j)
        total = fma(difference, difference, total)
    candidate_distance = simd.lane_min(total)
    if candidate_distance < distance or (candidate_distance == distance and candidate < code):
        return candidate, candidate_distance
    return code, distance


@inline
def new_lanes(dim):
    """1 in the lanes of a row's last vector that the one before does not cover; a single 1 for short rows."""
    keep = np.empty(16, np.float32)
    covered = -dim % 16 if dim >= 16 else 15
    for lane in range(16):
        keep[lane] = lane >= covered
    return keep


@inline
def squares(dim, a, at_a, b, at_b, keep):
    """Squared differences of two rows, to be summed. ``keep`` are the :func:`new_lanes` of such rows."""
    total = simd.broadcast(0)
    if dim < 16:
        for j in range(dim):
            difference = (get(a, at_a + j) - get(b, at_b + j)) * load(keep, 0)
            total = fma(difference, difference, total)
        return total
    for j in range(0, dim // 16 * 16, 16):
        difference = load(a, at_a + j) - load(b, at_b + j)
        total = fma(difference, difference, total)
    if dim % 16:
        difference = (load(a, at_a + dim - 16) - load(b, at_b + dim - 16)) * load(keep, 0)
        total = fma(difference, difference, total)
    return total


_BEST_ALONE = 4  # scores that a row keeps where no list is requested
_CHUNK = 4  # blocks of 32 codes in a chunk


@inline
def _insert(scores, codes, at, kept, score, code):
    """Insert a score into the sorted scores of a row; the last one drops out."""
    place = at + kept - 1
    while place > at and get(scores, place - 1) > score:
        put(scores, place, get(scores, place - 1))
        put(codes, place, get(codes, place - 1))
        place -= 1
    put(scores, place, score)
    put(codes, place, code)


@inline
def _keep(kept, first, block, state):
    """Of the scores ``found`` of a block, insert those below the limits of 6 rows."""
    scores, codes, limits, slack, found = state
    for i in range(_GROUP):
        limit = get(limits, first + i)
        low, high = load(found, 32 * i), load(found, 32 * i + 16)
        below = simd.mask_bits(low < limit) | (simd.mask_bits(high < limit) << 16)
        while below != 0:
            lane = simd.lowest_bit(below)
            below &= below - 1
            score, at = get(found, 32 * i + lane), (first + i) * _BEST
            if score < get(limits, first + i):
                _insert(scores, codes, at, kept, score, np.int32(block * 32 + lane))
                last, reach = get(scores, at + kept - 1), get(scores, at) + get(slack, first + i)
                put(limits, first + i, min(last, reach))


@inline
def _subtract(sums, value, low, high):
    return fnma(value, low, sums[0]), fnma(value, high, sums[1])


@inline
def _below(sums, limits, row):
    return simd.minimum(sums[0], sums[1]) < get(limits, row)


@inline
def _score_block(dim, blocks, halves, block, rows, first, kept, state):
    """Scores of 6 rows against 32 codes: 12 sums that hide each other's latency."""
    _, _, limits, _, found = state
    s0 = s1 = s2 = s3 = s4 = s5 = load(halves, block * 32), load(halves, block * 32 + 16)
    for j in range(dim):
        at, row = (block * dim + j) * 32, first * dim + j
        low, high = load(blocks, at), load(blocks, at + 16)
        s0 = _subtract(s0, get(rows, row), low, high)
        s1 = _subtract(s1, get(rows, row + dim), low, high)
        s2 = _subtract(s2, get(rows, row + 2 * dim), low, high)
        s3 = _subtract(s3, get(rows, row + 3 * dim), low, high)
        s4 = _subtract(s4, get(rows, row + 4 * dim), low, high)
        s5 = _subtract(s5, get(rows, row + 5 * dim), low, high)
    below = (
        _below(s0, limits, first)
        | _below(s1, limits, first + 1)
        | _below(s2, limits, first + 2)
        | _below(s3, limits, first + 3)
        | _below(s4, limits, first + 4)
        | _below(s5, limits, first + 5)
    )
    if simd.mask_bits(below) != 0:
        sums = s0 + s1 + s2 + s3 + s4 + s5
        for k in range(12):
            store(found, 16 * k, sums[k])
        _keep(kept, first, block, state)


@inline
def _settle(dim, x, row, codebook, scores, codes, at, kept, limit):
    """Nearest code by true distance among those with a score up to ``limit``."""
    code = integer(codes, at)
    if get(scores, at + 1) > limit:
        return code
    distance = F(np.inf)
    for place in range(at, at + kept):
        if get(scores, place) <= limit:
            code, distance = closer(dim, x, row, codebook, code, distance, integer(codes, place))
    return code


@inline
def _reach(squared, score, margin):
    """Distance of a row to codes with a score, less what rounding may have added."""
    return np.sqrt(max(F(0.0), squared + F(2.0) * (score - margin)))


@cache
def _search_kernel(dim: int) -> Any:
    """The search for one dimension, a compile-time constant."""

    def search(tile, _, x, codebook, centre, blocks, halves, longest, result, lists, distances):
        count = result.shape[0]
        with_lists = lists.shape[0] > 0
        kept = _BEST if with_lists else _BEST_ALONE
        rounding = F(2.0 * (dim + 8) * 2.0**-24)
        rows, squared = np.empty(_TILE * dim, np.float32), np.zeros(_TILE, np.float32)
        scores, codes = np.full(_TILE * _BEST, F(np.inf)), np.zeros(_TILE * _BEST, np.int32)
        limits = np.full(_TILE, F(np.inf))
        slack, margins = np.empty(_TILE, np.float32), np.empty(_TILE, np.float32)
        state = scores, codes, limits, slack, np.empty(32 * _GROUP, np.float32)
        start, valid = tile * _TILE, min(_TILE, count - tile * _TILE)
        for i in range(_TILE):
            for j in range(dim):
                value = x[(start + min(i, valid - 1)) * dim + j] - centre[j]
                rows[i * dim + j] = value
                squared[i] += value * value
            norms = np.sqrt(squared[i]) + longest
            margins[i] = rounding * norms * norms
            # Without a list, only codes that may be nearest after rounding are kept.
            slack[i] = F(np.inf) if with_lists else F(2.0) * margins[i]
        total = halves.shape[0] // 32
        for chunk in range(0, total, _CHUNK):
            for first in range(0, valid, _GROUP):
                for block in range(chunk, min(total, chunk + _CHUNK)):
                    _score_block(dim, blocks, halves, block, rows, first, kept, state)
        for i in range(valid):
            at, row = i * _BEST, start + i
            limit, others = scores[at] + margins[i], scores[at + kept - 1]
            if others > limit:
                result[row] = _settle(dim, x, row, codebook, scores, codes, at, kept, limit)
            else:
                code, distance = 0, F(np.inf)
                for candidate in range(codebook.shape[0] // dim):
                    code, distance = closer(dim, x, row, codebook, code, distance, candidate)
                result[row] = code
            if with_lists:
                for k in range(LIST):
                    lists[row * LIST + k] = codes[at + k] if scores[at + k] < F(np.inf) else codes[at]
                distances[row] = _reach(squared[i], others, margins[i])
                second = scores[at + 1]
                distances[count + row] = _reach(squared[i], second, margins[i]) if second > limit else F(0.0)

    return parallel(search)


def score_search(x: Array, codebook: Array, with_lists: bool = False) -> tuple[Array, Array, Array]:
    """Nearest codes of rows ``x [N, D]``; a row with a NaN gets code 0.

    Args:
        x: Rows, contiguous float32.
        codebook: Codes ``[K, D]``, contiguous float32, K at least 1.
        with_lists: Whether to return what else the search finds.

    Returns:
        Codes ``[N]``; lists of the nearest codes ``[N, LIST]`` int32, padded with the first where there are fewer; and
        distances ``[2, N]``: below the first there is no code outside the list, below the second none but the nearest.
        The last two are empty unless requested.

    Raises:
        ValueError: Rows and codes do not fit together, or an array is not contiguous.
        TypeError: One is not float32.
    """
    check_fit("x [N, D], codebook [K, D]", x, codebook)
    count, dim = x.shape
    result = np.empty(count, np.int64)
    listed = count if with_lists else 0
    lists = np.empty((listed, LIST), np.int32)
    distances = np.empty((2, listed), np.float32)
    thread_count()
    found = result, lists.ravel(), distances.ravel()
    _search_kernel(dim)(-(-len(x) // _TILE), x.ravel(), codebook.ravel(), *_centred(codebook), *found)
    return result, lists, distances
