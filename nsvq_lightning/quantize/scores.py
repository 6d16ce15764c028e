"""Exact nearest code in many dimensions: dot products on 16-lane vectors, settled by true distances where they tie.

With rows and codes centred on the mean of the codes, ‖x − c‖² = ‖x‖² + 2 s(c) with the score s(c) = ‖c‖²/2 − x·c, one
fused multiply-add a number. Codes are spread over 32 classes (code mod 32, the lanes of two vectors), and the best and
second best score of every class is kept. All codes that can be nearest after rounding are then class bests, unless some
second best is as near as rounding too (equal codes in one class; then all codes are compared by true distances). What
else this yields is a short list of the nearest codes and a distance below which there is no other code, which lets
:mod:`tracking` skip most searches.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from nsvq_lightning.quantize.kernels import aligned_empty, lane_min
from nsvq_lightning.rendering.cpu.jit import inline, kernel, thread_count
from nsvq_lightning.rendering.cpu.lanes import fma, fnma, get, load, select, splat, store, vmax, vmin

__all__ = ["LIST", "CentredCodes", "centre_codes", "score_search", "true_distance"]

LIST = 8
"""Codes in the list of a row."""
_GROUP = 6
"""Rows scored together."""
_TILE = 8 * _GROUP
"""Rows that pass over the codes while a chunk of these stays in the first-level cache."""
_CHUNK = 4
"""Blocks of 32 codes in a chunk."""
_STATE = 96
"""Floats a row keeps: best score, second best score and block of the best, for 32 classes."""


class CentredCodes(NamedTuple):
    """Codes ready for :func:`score_search`.

    Attributes:
        codebook: The codes as they are, ``[K, D]``.
        centre: Mean of the finite codes, ``[D]``.
        blocks: Centred codes, ``[⌈K/32⌉, D, 32]``.
        halves: Half the squared norm of each, ``[⌈K/32⌉ · 32]``; infinite where there is no finite code.
        longest: Largest norm of a centred code.
    """

    codebook: NDArray[np.float32]
    centre: NDArray[np.float32]
    blocks: NDArray[np.float32]
    halves: NDArray[np.float32]
    longest: float


def centre_codes(codebook: NDArray[np.float32]) -> CentredCodes:
    """Centre the codes ``[K, D]`` and lay them out in blocks of 32."""
    count, dim = codebook.shape
    finite = np.isfinite(codebook).all(1)
    centre = codebook[finite].mean(0, dtype=np.float64).astype(np.float32) if finite.any() else codebook[0] * 0
    size = -(-count // 32) * 32
    centred, halves = np.zeros((size, dim), np.float32), np.full(size, np.inf, np.float32)
    centred[:count][finite] = codebook[finite] - centre
    squared = np.einsum("kd,kd->k", centred[:count], centred[:count], dtype=np.float64)
    halves[:count][finite] = 0.5 * squared[finite]
    blocks = aligned_empty((size // 32, dim, 32))
    blocks[:] = centred.reshape(-1, 32, dim).transpose(0, 2, 1)
    return CentredCodes(codebook, centre, blocks, halves, float(np.sqrt(squared.max())))


@inline
def true_distance(dim, x, row, codebook, code):  # type: ignore[no-untyped-def]
    """Squared distance as a sum of squared differences in one fixed order; it decides between codes that tie."""
    total = splat(np.float32(0.0))
    for j in range(dim):
        difference = splat(get(codebook, code * dim + j) - get(x, row * dim + j))
        total = fma(difference, difference, total)
    return lane_min(total)


@inline
def _keep_class(state, at, score, number):  # type: ignore[no-untyped-def]
    best, second, block_of = load(state, at), load(state, at + 32), load(state, at + 64)
    store(state, at + 64, select(score < best, number, block_of))
    store(state, at + 32, vmin(vmax(score, best), second))
    store(state, at, vmin(score, best))


@inline
def _keep(state, row, block, low, high):  # type: ignore[no-untyped-def]
    """Update best, second best and block of the best of a row's 32 classes."""
    number = splat(np.float32(block))
    _keep_class(state, row * _STATE, low, number)
    _keep_class(state, row * _STATE + 16, high, number)


@inline
def _score_block(dim, blocks, halves, block, rows, first, state):  # type: ignore[no-untyped-def]
    """Scores of 6 rows against 32 codes: 12 sums that hide each other's latency."""
    a0 = a1 = a2 = a3 = a4 = a5 = load(halves, block * 32)
    b0 = b1 = b2 = b3 = b4 = b5 = load(halves, block * 32 + 16)
    at, row = block * dim * 32, first * dim
    for j in range(dim):
        low, high = load(blocks, at + 32 * j), load(blocks, at + 32 * j + 16)
        value = splat(get(rows, row + j))
        a0, b0 = fnma(value, low, a0), fnma(value, high, b0)
        value = splat(get(rows, row + dim + j))
        a1, b1 = fnma(value, low, a1), fnma(value, high, b1)
        value = splat(get(rows, row + 2 * dim + j))
        a2, b2 = fnma(value, low, a2), fnma(value, high, b2)
        value = splat(get(rows, row + 3 * dim + j))
        a3, b3 = fnma(value, low, a3), fnma(value, high, b3)
        value = splat(get(rows, row + 4 * dim + j))
        a4, b4 = fnma(value, low, a4), fnma(value, high, b4)
        value = splat(get(rows, row + 5 * dim + j))
        a5, b5 = fnma(value, low, a5), fnma(value, high, b5)
    _keep(state, first, block, a0, b0)
    _keep(state, first + 1, block, a1, b1)
    _keep(state, first + 2, block, a2, b2)
    _keep(state, first + 3, block, a3, b3)
    _keep(state, first + 4, block, a4, b4)
    _keep(state, first + 5, block, a5, b5)


@inline
def _score_tile(dim, blocks, halves, rows, count, state):  # type: ignore[no-untyped-def]
    infinite, zero = splat(np.float32(np.inf)), splat(np.float32(0.0))
    for k in range(0, count * _STATE, _STATE):
        for part in range(0, 64, 16):
            store(state, k + part, infinite)
        store(state, k + 64, zero)
        store(state, k + 80, zero)
    total = halves.shape[0] // 32
    for chunk in range(0, total, _CHUNK):
        for first in range(0, count, _GROUP):
            for block in range(chunk, min(total, chunk + _CHUNK)):
                _score_block(dim, blocks, halves, block, rows, first, state)


@inline
def _settle(dim, x, row, codebook, state, at, limit):  # type: ignore[no-untyped-def]
    """Nearest code by true distance among the class bests with a score up to ``limit``; -1 if there is none."""
    found, code, distance = 0, np.int64(-1), np.float32(np.inf)
    for lane in range(32):
        if get(state, at + lane) <= limit:
            found, code = found + 1, np.int64(get(state, at + 64 + lane)) * 32 + lane
    if found < 2:
        return code
    code = np.int64(-1)
    for lane in range(32):
        if get(state, at + lane) <= limit:
            candidate = np.int64(get(state, at + 64 + lane)) * 32 + lane
            candidate_distance = true_distance(dim, x, row, codebook, candidate)
            if candidate_distance < distance or (candidate_distance == distance and candidate < code):
                code, distance = candidate, candidate_distance
    return code


@inline
def _compare_all(dim, x, row, codebook):  # type: ignore[no-untyped-def]
    code, distance = 0, np.float32(np.inf)
    for candidate in range(codebook.shape[0] // dim):
        candidate_distance = true_distance(dim, x, row, codebook, candidate)
        if candidate_distance < distance:
            code, distance = candidate, candidate_distance
    return code


@inline
def _write_list(state, at, others, lists, start, scores):  # type: ignore[no-untyped-def]
    """Write the nearest class bests, nearest first; returns the score below which there is no code outside the list."""
    size = 0
    for lane in range(32):
        score = get(state, at + lane)
        if score >= others:
            continue
        if size == LIST:
            if score >= scores[LIST - 1]:
                others = score
                continue
            others, size = scores[LIST - 1], LIST - 1
        place = size
        while place > 0 and scores[place - 1] > score:
            scores[place], lists[start + place] = scores[place - 1], lists[start + place - 1]
            place -= 1
        scores[place] = score
        lists[start + place] = np.int32(get(state, at + 64 + lane)) * 32 + lane
        size += 1
    return others


@cache
def _search_kernel(dim: int) -> Any:
    """The search for one dimension, a constant for the compiler."""

    def search(x, codebook, centre, blocks, halves, longest, result, lists, limits):  # type: ignore[no-untyped-def]
        count = result.shape[0]
        rounding = np.float32(2.0 * (dim + 8) * 2.0**-24)
        for tile in prange((count + _TILE - 1) // _TILE):
            rows, state = np.empty(_TILE * dim, np.float32), np.empty(_TILE * _STATE, np.float32)
            squared, scores = np.zeros(_TILE, np.float32), np.empty(LIST, np.float32)
            start, valid = tile * _TILE, min(_TILE, count - tile * _TILE)
            for i in range(_TILE):
                for j in range(dim):
                    value = x[(start + min(i, valid - 1)) * dim + j] - centre[j]
                    rows[i * dim + j] = value
                    squared[i] += value * value
            _score_tile(dim, blocks, halves, rows, (valid + _GROUP - 1) // _GROUP * _GROUP, state)
            for i in range(valid):
                at, row = i * _STATE, start + i
                best, others = state[at], state[at + 32]
                for lane in range(1, 32):
                    best, others = min(best, state[at + lane]), min(others, state[at + 32 + lane])
                reach = np.sqrt(squared[i]) + longest
                margin = rounding * reach * reach
                code = -1
                if others > best + margin:
                    code = _settle(dim, x, row, codebook, state, at, best + margin)
                result[row] = code if code >= 0 else _compare_all(dim, x, row, codebook)
                if lists.shape[0] > 0:
                    others = _write_list(state, at, others, lists, row * LIST, scores)
                    limits[row] = np.sqrt(max(np.float32(0.0), squared[i] + np.float32(2.0) * (others - margin)))

    return kernel(search)


def score_search(
    x: NDArray[np.float32], codes: CentredCodes, with_lists: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """Nearest codes of contiguous rows ``x [N, D]``; a row that is not a number gets code 0.

    Args:
        x: Rows.
        codes: The codes from :func:`centre_codes`.
        with_lists: Whether to return what the search knows beside the nearest code.

    Returns:
        Codes ``[N]``; a list of near codes ``[N, LIST]``, filled up with K; and the distance ``[N]`` below which there
        is no code outside the list. The last two are empty unless asked for.
    """
    count, dim = x.shape
    result = np.empty(count, np.int64)
    lists = np.full((count if with_lists else 0, LIST), codes.codebook.shape[0], np.int32)
    limits = np.empty(count if with_lists else 0, np.float32)
    thread_count()
    _search_kernel(dim)(
        x.ravel(),
        codes.codebook.ravel(),
        codes.centre,
        codes.blocks.ravel(),
        codes.halves,
        np.float32(codes.longest),
        result,
        lists.ravel(),
        limits,
    )
    return result, lists, limits
