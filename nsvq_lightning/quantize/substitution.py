"""Error substitution on the CPU: gather, residual, noise and result of a row in one pass, gradients in another.

Rows are read from the whole table, and their gradient is written back into one. Short rows are handled 16 at a time,
one row per lane. Rows of 16 or more columns are handled one at a time, in vectors along the row of which the last two
may overlap. The backward pass takes the direction from the result, not from a second draw: with x̃ - x = ‖r‖ d̂ the
radial term (g·d̂) r/‖r‖ is (g·(x̃ - x)) r/‖r‖².

The sums of a code add up its rows in order. Each part of the rows has its own sums, which are added in the order of the
parts; the parts depend only on the sizes, so the bits do not depend on the number of threads.

The noise is counter-based: vector m of a seed is a function of (seed, m), whichever thread computes it, and when. Two
rounds of 64-bit mixing (the finalizer of splitmix64, with the seed entering twice) give two uniform values, which the
Box-Muller transform turns into two normal ones. There are no branches and no tables, so all of it is vectorized.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray

from nsvq_lightning.compute import lanes as simd
from nsvq_lightning.compute.jit import inline, kernel, thread_count
from nsvq_lightning.compute.memory import FLOAT32, INT64, check_array, check_table, outside, recycled
from nsvq_lightning.compute.rows import clear, clear_between, count_outside
from nsvq_lightning.compute.simd import broadcast, fma, get, lane_sum, load, log2, put, select, store, vsqrt

MULTIPLIERS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_GOLDEN, _FIRST, _SECOND = (np.uint64(value) for value in MULTIPLIERS)
_S27, _S30, _S31, _S40, _LOW24 = np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(40), np.uint64(0xFFFFFF)
_UNIT = np.float32(2.0**-24)
_MINUS_TWO_LN2 = np.float32(-2 * np.log(2))
# cos 2πt and (sin 2πt)/t as polynomials of t² on |t| ≤ 1/2 (Chebyshev fits), highest power first; errors 1e-6.
COS = (-21.071106, 58.790493, -85.271622, 64.928658, -19.738981, 0.99999923)
SIN = (-12.471244, 41.342884, -76.614471, 81.599945, -41.341591, 6.283185)
_C0, _C1, _C2, _C3, _C4, _C5 = (np.float32(value) for value in COS)
_S0, _S1, _S2, _S3, _S4, _S5 = (np.float32(value) for value in SIN)


def draw_seed(generator: torch.Generator) -> int:
    """A 63-bit seed from a torch generator."""
    device = generator.device
    return int(torch.randint(0, 2**63 - 1, (), dtype=torch.int64, device=device, generator=generator))


@inline
def _uniforms(seed, pair, radius, angle):  # type: ignore[no-untyped-def]
    """Sixteen pairs starting at ``pair``: radius in (0, 1], angle in [-1/2, 1/2) turns, 24 random bits each."""
    key = np.uint64(seed)
    second_key = (key ^ (key >> _S31)) * _SECOND
    for lane in range(16):
        bits = (np.uint64(pair + lane) + key) * _GOLDEN
        bits = (bits ^ (bits >> _S30)) * _FIRST
        bits = (bits ^ (bits >> _S27) ^ second_key) * _SECOND
        bits = bits ^ (bits >> _S31)
        radius[lane] = np.float32(np.int32(bits >> _S40) + np.int32(1)) * _UNIT
        angle[lane] = np.float32(np.int32(bits & _LOW24)) * _UNIT - np.float32(0.5)


@inline
def _cosine(t):  # type: ignore[no-untyped-def]
    value = simd.fma(simd.broadcast(_C0), t, simd.broadcast(_C1))
    value = simd.fma(simd.fma(value, t, simd.broadcast(_C2)), t, simd.broadcast(_C3))
    return simd.fma(simd.fma(value, t, simd.broadcast(_C4)), t, simd.broadcast(_C5))


@inline
def _sine(t):  # type: ignore[no-untyped-def]
    value = simd.fma(simd.broadcast(_S0), t, simd.broadcast(_S1))
    value = simd.fma(simd.fma(value, t, simd.broadcast(_S2)), t, simd.broadcast(_S3))
    return simd.fma(simd.fma(value, t, simd.broadcast(_S4)), t, simd.broadcast(_S5))


@inline
def fill_normal(seed, first, count, out, radius, angle):  # type: ignore[no-untyped-def]
    """Write vectors ``first`` to ``first + count`` (both even) of a seed to ``out [count · 16]``.

    ``radius`` and ``angle`` are scratch, ``[16]`` each.
    """
    for pair in range(count // 2):
        _uniforms(seed, (first // 2 + pair) * 16, radius, angle)
        length = simd.vsqrt(simd.log2(simd.load(radius, 0)) * simd.broadcast(_MINUS_TWO_LN2))
        turn = simd.load(angle, 0)
        simd.store(out, pair * 32, length * _cosine(turn * turn))
        simd.store(out, pair * 32 + 16, length * (turn * _sine(turn * turn)))


@kernel
def _normal_kernel(seed, out):  # type: ignore[no-untyped-def]
    vectors = out.size // 16
    for block in prange((vectors + 63) // 64):
        radius, angle = np.empty(16, np.float32), np.empty(16, np.float32)
        first = block * 64
        fill_normal(seed, first, min(64, vectors - first), out[first * 16 :], radius, angle)


def normal_vectors(seed: int, vectors: int) -> NDArray[np.float32]:
    """The first ``vectors`` (an even number) vectors of 16 standard normal values of a seed, ``[vectors · 16]``.

    Raises:
        ValueError: ``vectors`` is negative or odd.
    """
    if vectors < 0 or vectors % 2:
        raise ValueError(f"vectors must be even and at least 0, got {vectors}")
    out = np.empty(vectors * 16, np.float32)
    thread_count()
    _normal_kernel(seed, out)
    return out


_ROWS = 256
"""Rows per unit of parallel work; the noise of a row depends only on its position."""
_LEAST_PARTS, _MOST_PARTS = 4, 64
"""Number of parts in which the rows are summed: enough for the threads, few enough that adding them up is cheap."""

_TINY = np.finfo(np.float32).tiny

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]


@inline
def _copy_in(dim, source, rows, first, count, group):  # type: ignore[no-untyped-def]
    """Copy chosen rows into vectors, one row per lane."""
    for lane in range(count):
        start = simd.get(rows, first + lane) * dim
        for j in range(dim):
            simd.put(group, j * 16 + lane, simd.get(source, start + j))


@inline
def _block(dim, x, rows, codebook, codes, block):  # type: ignore[no-untyped-def]
    """First and last row of a block, and how many of its indices are outside the table or the codebook.

    A block with such an index ends where it begins.
    """
    begin, stop = block * _ROWS, min(codes.shape[0], (block + 1) * _ROWS)
    found = count_outside(rows, begin, stop, x.shape[0] // dim)
    found += count_outside(codes, begin, stop, codebook.shape[0] // dim)
    return begin, stop if found == 0 else begin, found


@inline
def _part(dim, x, rows, codebook, codes, part, parts):  # type: ignore[no-untyped-def]
    """The same for a part; the row before its first one says where clearing begins."""
    begin, stop = codes.shape[0] * part // parts, codes.shape[0] * (part + 1) // parts
    found = count_outside(rows, begin - 1, stop, x.shape[0] // dim)
    found += count_outside(codes, begin, stop, codebook.shape[0] // dim)
    return begin, stop if found == 0 else begin, found


@inline
def _dots(dim, a, b):  # type: ignore[no-untyped-def]
    """Dot products of rows with rows, one per lane."""
    total = simd.broadcast(np.float32(0.0))
    for j in range(dim):
        total = simd.fma(simd.load(a, 16 * j), simd.load(b, 16 * j), total)
    return total


@inline
def _residuals_squared(dim, rows, chosen):  # type: ignore[no-untyped-def]
    total = simd.broadcast(np.float32(0.0))
    for j in range(dim):
        residual = simd.load(rows, 16 * j) - simd.load(chosen, 16 * j)
        total = simd.fma(residual, residual, total)
    return total


@inline
def _inverses(squared):  # type: ignore[no-untyped-def]
    """1/s, and 0 where s is 0 (or its inverse too large): a zero vector has no direction."""
    return simd.select(
        squared > simd.broadcast(_TINY), simd.broadcast(np.float32(1.0)) / squared, simd.broadcast(np.float32(0.0))
    )


@inline
def _dot_difference(dim, g, at_g, a, at_a, b, at_b, keep):  # type: ignore[no-untyped-def]
    """Dot product of a long row with a difference. ``keep`` masks the overlap of the last two vectors."""
    total = simd.broadcast(np.float32(0.0))
    for j in range(0, dim // 16 * 16, 16):
        total = simd.fma(simd.load(g, at_g + j), simd.load(a, at_a + j) - simd.load(b, at_b + j), total)
    if dim % 16:
        difference = simd.load(a, at_a + dim - 16) - simd.load(b, at_b + dim - 16)
        total = simd.fma(simd.load(g, at_g + dim - 16) * simd.load(keep, 0), difference, total)
    return simd.lane_sum(total)


@inline
def _residual_squared(dim, x, at, codebook, code, keep):  # type: ignore[no-untyped-def]
    total = simd.broadcast(np.float32(0.0))
    for j in range(0, dim // 16 * 16, 16):
        residual = simd.load(x, at + j) - simd.load(codebook, code + j)
        total = simd.fma(residual, residual, total)
    if dim % 16:
        residual = (simd.load(x, at + dim - 16) - simd.load(codebook, code + dim - 16)) * simd.load(keep, 0)
        total = simd.fma(residual, residual, total)
    return simd.lane_sum(total)


@inline
def _inverse(squared):  # type: ignore[no-untyped-def]
    return np.float32(1.0) / squared if squared > _TINY else np.float32(0.0)


def _short_forward(dim: int) -> Any:
    def forward(seed, aim, spread, x, rows, codebook, codes, out):  # type: ignore[no-untyped-def]
        count, missing = codes.shape[0], 0
        for block in prange((count + _ROWS - 1) // _ROWS):
            begin, stop, found = _block(dim, x, rows, codebook, codes, block)
            missing += found
            noise, radius, angle = np.empty(_ROWS * dim, np.float32), np.empty(16, np.float32), np.empty(16, np.float32)
            values, chosen = np.zeros(16 * dim, np.float32), np.zeros(16 * dim, np.float32)
            fill_normal(seed, block * _ROWS // 16 * dim, _ROWS // 16 * dim, noise, radius, angle)
            for first in range(begin, stop, 16):
                valid = min(16, count - first)
                _copy_in(dim, x, rows, first, valid, values)
                _copy_in(dim, codebook, codes, first, valid, chosen)
                at = (first - block * _ROWS) * dim
                error, squared = simd.broadcast(np.float32(0.0)), simd.broadcast(np.float32(0.0))
                for j in range(dim):
                    residual = simd.load(chosen, 16 * j) - simd.load(values, 16 * j)
                    direction = simd.fma(
                        simd.broadcast(aim), residual, simd.broadcast(spread) * simd.load(noise, at + 16 * j)
                    )
                    simd.store(noise, at + 16 * j, direction)
                    error, squared = simd.fma(residual, residual, error), simd.fma(direction, direction, squared)
                length = simd.vsqrt(error * _inverses(squared))
                for j in range(dim):
                    simd.store(
                        values, 16 * j, simd.fma(length, simd.load(noise, at + 16 * j), simd.load(values, 16 * j))
                    )
                for lane in range(valid):
                    for j in range(dim):
                        simd.put(out, (first + lane) * dim + j, simd.get(values, j * 16 + lane))
        return missing

    return kernel(forward)


def _long_forward(dim: int) -> Any:
    vectors = -(-dim // 16)

    def forward(seed, aim, spread, x, rows, codebook, codes, out):  # type: ignore[no-untyped-def]
        count, missing = codes.shape[0], 0
        for block in prange((count + _ROWS - 1) // _ROWS):
            begin, stop, found = _block(dim, x, rows, codebook, codes, block)
            missing += found
            radius, angle, keep = np.empty(16, np.float32), np.empty(16, np.float32), np.ones(16, np.float32)
            keep[: vectors * 16 - dim] = 0
            noise, direction = np.empty(2 * vectors * 16, np.float32), np.empty(vectors * 16, np.float32)
            for i in range(begin, stop):
                start = i % 2 * vectors * 16
                if start == 0:
                    fill_normal(seed, i * vectors, 2 * vectors, noise, radius, angle)
                at, code = simd.get(rows, i) * dim, simd.get(codes, i) * dim
                error, squared = simd.broadcast(np.float32(0.0)), simd.broadcast(np.float32(0.0))
                for j in range(vectors):
                    place = min(16 * j, dim - 16)
                    residual = simd.load(codebook, code + place) - simd.load(x, at + place)
                    way = simd.fma(
                        simd.broadcast(aim), residual, simd.broadcast(spread) * simd.load(noise, start + place)
                    )
                    simd.store(direction, place, way)
                    if j == vectors - 1:
                        residual, way = residual * simd.load(keep, 0), way * simd.load(keep, 0)
                    error, squared = simd.fma(residual, residual, error), simd.fma(way, way, squared)
                length = simd.broadcast(np.sqrt(simd.lane_sum(error) * _inverse(simd.lane_sum(squared))))
                for j in range(vectors):
                    place = min(16 * j, dim - 16)
                    simd.store(
                        out, i * dim + place, simd.fma(length, simd.load(direction, place), simd.load(x, at + place))
                    )
        return missing

    return kernel(forward)


def _short_backward(dim: int) -> Any:
    def backward(grad, x, rows, codebook, codes, out, grad_x, sums):  # type: ignore[no-untyped-def]
        count, parts, missing = codes.shape[0], sums.shape[0], 0
        for part in prange(parts):
            values, chosen = np.zeros(16 * dim, np.float32), np.zeros(16 * dim, np.float32)
            moved, slope = np.zeros(16 * dim, np.float32), np.zeros(16 * dim, np.float32)
            total = sums[part]
            clear(total, 0, total.shape[0])
            begin, stop, found = _part(dim, x, rows, codebook, codes, part, parts)
            missing += found
            for first in range(begin, stop, 16):
                valid = min(16, stop - first)
                _copy_in(dim, x, rows, first, valid, values)
                _copy_in(dim, codebook, codes, first, valid, chosen)
                for lane in range(valid):
                    for j in range(dim):
                        simd.put(moved, j * 16 + lane, simd.get(out, (first + lane) * dim + j))
                        simd.put(slope, j * 16 + lane, simd.get(grad, (first + lane) * dim + j))
                for j in range(dim):
                    simd.store(moved, 16 * j, simd.load(moved, 16 * j) - simd.load(values, 16 * j))
                scale = _dots(dim, slope, moved) * _inverses(_residuals_squared(dim, values, chosen))
                for j in range(dim):
                    radial = scale * (simd.load(values, 16 * j) - simd.load(chosen, 16 * j))
                    simd.store(chosen, 16 * j, radial)
                    simd.store(slope, 16 * j, simd.load(slope, 16 * j) + radial)
                for lane in range(valid):
                    i = first + lane
                    clear_between(rows, i, dim, grad_x)
                    at, code = simd.get(rows, i) * dim, simd.get(codes, i) * dim
                    for j in range(dim):
                        simd.put(grad_x, at + j, simd.get(slope, j * 16 + lane))
                        simd.put(total, code + j, simd.get(total, code + j) - simd.get(chosen, j * 16 + lane))
            if part == parts - 1 and found == 0:
                clear_between(rows, count, dim, grad_x)
        return missing

    return kernel(backward)


def _long_backward(dim: int) -> Any:
    vectors = -(-dim // 16)

    def backward(grad, x, rows, codebook, codes, out, grad_x, sums):  # type: ignore[no-untyped-def]
        count, parts, missing = codes.shape[0], sums.shape[0], 0
        for part in prange(parts):
            keep = np.ones(16, np.float32)
            keep[: vectors * 16 - dim] = 0
            total = sums[part]
            clear(total, 0, total.shape[0])
            begin, stop, found = _part(dim, x, rows, codebook, codes, part, parts)
            missing += found
            for i in range(begin, stop):
                at, code = simd.get(rows, i) * dim, simd.get(codes, i) * dim
                scale = _dot_difference(dim, grad, i * dim, out, i * dim, x, at, keep)
                scale *= _inverse(_residual_squared(dim, x, at, codebook, code, keep))
                clear_between(rows, i, dim, grad_x)
                # The last two vectors overlap, so the last sums are read before any are written.
                last = simd.load(total, code + dim - 16)
                for j in range(vectors):
                    place = min(16 * j, dim - 16)
                    radial = simd.broadcast(scale) * (simd.load(x, at + place) - simd.load(codebook, code + place))
                    simd.store(grad_x, at + place, simd.load(grad, i * dim + place) + radial)
                    before = last if j == vectors - 1 else simd.load(total, code + place)
                    simd.store(total, code + place, before - radial)
            if part == parts - 1 and found == 0:
                clear_between(rows, count, dim, grad_x)
        return missing

    return kernel(backward)


@cache
def _kernels(dim: int) -> tuple[Any, Any]:
    """Forward and backward for rows of ``dim`` columns, a compile-time constant."""
    return (_short_forward(dim), _short_backward(dim)) if dim < 16 else (_long_forward(dim), _long_backward(dim))


@kernel
def _add_parts(sums, total):  # type: ignore[no-untyped-def]
    """Add the sums of the parts in order."""
    parts, size = sums.shape
    for block in prange((size + 1023) // 1024):
        for i in range(block * 1024, min(size, (block + 1) * 1024)):
            value = sums[0, i]
            for part in range(1, parts):
                value += sums[part, i]
            total[i] = value


def substitute(
    seed: int, x: Floats, rows: Integers, codebook: Floats, codes: Integers, *, aim: float = 0.0, spread: float = 1.0
) -> Floats:
    """``x + ‖x − c‖·d/‖d‖`` with ``d = aim·(c − x) + spread·v``, v ~ N(0, I), for some rows of a table, ``[V, D]``.

    Args:
        seed: 63 random bits; v is a function of them and of the position in ``rows``.
        x: Table ``[N, D]``.
        rows: Which rows of it, ``[V]``.
        codebook: Codes ``[K, D]``.
        codes: Code of each chosen row, ``[V]``.
        aim: Weight of the residual c − x in the direction d.
        spread: Weight of the noise in d.

    Raises:
        ValueError: The arrays do not fit together, one is not contiguous, or a row or code is out of range.
        TypeError: A dtype is wrong.
    """
    _check(x, rows, codebook, codes)
    out = recycled((len(rows), x.shape[1])).numpy()
    thread_count()
    flat = x.ravel(), rows, codebook.ravel(), codes, out.ravel()
    if _kernels(x.shape[1])[0](seed, np.float32(aim), np.float32(spread), *flat):
        raise _missing(x, rows, codebook, codes)
    return out


def _check(x: Floats, rows: Integers, codebook: Floats, codes: Integers) -> None:
    check_table("x", x)
    check_array("rows", rows, (rows.size,), INT64)
    check_array("codebook", codebook, (len(codebook), x.shape[1]), FLOAT32)
    check_array("codes", codes, (len(rows),), INT64)


def _missing(x: Floats, rows: Integers, codebook: Floats, codes: Integers) -> ValueError:
    """The error for a row or a code that is out of range."""
    wrong_row = bool(((rows < 0) | (rows >= len(x))).any())
    return outside("rows", rows, len(x)) if wrong_row else outside("codes", codes, len(codebook))


def substitute_backward(
    grad: Floats, x: Floats, rows: Integers, codebook: Floats, codes: Integers, out: Floats
) -> tuple[Floats, Floats]:
    """Gradients of ``x [N, D]`` and ``codebook [K, D]`` from that of the result, ``grad [V, D]``.

    ``out [V, D]`` is the result of :func:`substitute`; ``rows [V]`` must be ascending and distinct here.

    Raises:
        ValueError: As for :func:`substitute`.
        TypeError: A dtype is wrong.
    """
    _check(x, rows, codebook, codes)
    for name, table in (("grad", grad), ("out", out)):
        check_array(name, table, (len(rows), x.shape[1]), FLOAT32)
    grad_x, grad_codebook = recycled(x.shape).numpy(), recycled(codebook.shape).numpy()
    parts = max(_LEAST_PARTS, min(_MOST_PARTS, len(rows) // (4 * len(codebook))))
    sums = recycled((parts, codebook.size)).numpy()
    thread_count()
    flat = grad.ravel(), x.ravel(), rows, codebook.ravel(), codes, out.ravel()
    if _kernels(x.shape[1])[1](*flat, grad_x.ravel(), sums):
        raise _missing(x, rows, codebook, codes)
    _add_parts(sums, grad_codebook.ravel())
    return grad_x, grad_codebook
