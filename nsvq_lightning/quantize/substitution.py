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

from functools import cache
from typing import Any

import numpy as np
from torch import Tensor

from nsvq_lightning.compute.jit import F, inline, parallel, thread_count
from nsvq_lightning.compute.memory import check_fit, check_inside, flat, recycled
from nsvq_lightning.compute.rows import clear, clear_between, count_outside, share
from nsvq_lightning.compute.simd import broadcast, fma, get, lane_sum, load, log2, put, sqrt, store, where
from nsvq_lightning.quantize.scores import new_lanes

_UNIT, _TINY, _MINUS_TWO_LN2 = F(2.0**-24), np.finfo(np.float32).tiny, F(-2 * np.log(2))
_ROWS = 256  # rows per unit of parallel work; the noise of a row depends only on its position


@inline
def _polynomial(c, t):
    value = fma(c[0], t, c[1])
    value = fma(fma(value, t, c[2]), t, c[3])
    return fma(fma(value, t, c[4]), t, c[5])


MULTIPLIERS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
# cos 2πt and (sin 2πt)/t as polynomials of t² on |t| ≤ 1/2 (Chebyshev fits), highest power first; errors 1e-6.
COS = (-21.071106, 58.790493, -85.271622, 64.928658, -19.738981, 0.99999923)
SIN = (-12.471244, 41.342884, -76.614471, 81.599945, -41.341591, 6.283185)

_GOLDEN, _FIRST, _SECOND = (np.uint64(value) for value in MULTIPLIERS)
_COS, _SIN = (tuple(F(value) for value in each) for each in (COS, SIN))


@inline
def _uniforms(seed, pair, out, at):
    """Sixteen pairs starting at ``pair``: radii in (0, 1], then angles in [-1/2, 1/2) turns, 24 random bits each."""
    key = np.uint64(seed)
    second_key = (key ^ (key >> np.uint64(31))) * _SECOND
    for lane in range(16):
        bits = (np.uint64(pair + lane) + key) * _GOLDEN
        bits = (bits ^ (bits >> np.uint64(30))) * _FIRST
        bits = (bits ^ (bits >> np.uint64(27)) ^ second_key) * _SECOND
        bits = bits ^ (bits >> np.uint64(31))
        put(out, at + lane, F(np.int32(bits >> np.uint64(40)) + np.int32(1)) * _UNIT)
        put(out, at + 16 + lane, F(np.int32(bits & np.uint64(0xFFFFFF))) * _UNIT - F(0.5))


@inline
def fill_normal(seed, first, count, out):
    """Write vectors ``first`` to ``first + count`` (both even) of a seed to ``out [count · 16]``."""
    for pair in range(count // 2):
        at = pair * 32
        _uniforms(seed, (first // 2 + pair) * 16, out, at)
        length = sqrt(log2(load(out, at)) * _MINUS_TWO_LN2)
        turn = load(out, at + 16)
        store(out, at, length * _polynomial(_COS, turn * turn))
        store(out, at + 16, length * (turn * _polynomial(_SIN, turn * turn)))


@inline
def _new_group(dim):
    """Vectors for 16 rows, one for each column."""
    return np.zeros(16 * dim, np.float32)


@inline
def _take_row(dim, source, start, lane, group):
    """Copy a row into one lane of vectors."""
    for j in range(dim):
        put(group, j * 16 + lane, get(source, start + j))


@inline
def _outside(dim, x, rows, codebook, codes, begin, stop):
    """How many rows and codes are out of range, with the row before the first, which says where clearing begins."""
    found = count_outside(rows, begin - 1, stop, x.shape[0] // dim)
    return found + count_outside(codes, begin, stop, codebook.shape[0] // dim)


@inline
def _inverses(squared):
    """1/s, and 0 where s is 0 (or its inverse too large): a zero vector has no direction."""
    return where(squared > _TINY, 1 / squared, 0)


@inline
def _short_forward(dim, seed, aim, spread, x, rows, codebook, codes, out, begin, stop):
    noise = np.empty(_ROWS * dim, np.float32)
    values, chosen = _new_group(dim), _new_group(dim)
    fill_normal(seed, begin // 16 * dim, _ROWS // 16 * dim, noise)
    for first in range(begin, stop, 16):
        valid = min(16, stop - first)
        for lane in range(valid):
            _take_row(dim, x, get(rows, first + lane) * dim, lane, values)
            _take_row(dim, codebook, get(codes, first + lane) * dim, lane, chosen)
        at = (first - begin) * dim
        error = squared = broadcast(0)
        for j in range(dim):
            residual = load(chosen, 16 * j) - load(values, 16 * j)
            direction = fma(aim, residual, spread * load(noise, at + 16 * j))
            store(noise, at + 16 * j, direction)
            error = fma(residual, residual, error)
            squared = fma(direction, direction, squared)
        length = sqrt(error * _inverses(squared))
        for j in range(dim):
            store(values, 16 * j, fma(length, load(noise, at + 16 * j), load(values, 16 * j)))
        for lane in range(valid):
            for j in range(dim):
                put(out, (first + lane) * dim + j, get(values, j * 16 + lane))


@inline
def _long_forward(dim, seed, aim, spread, x, rows, codebook, codes, out, begin, stop):
    vectors = (dim + 15) // 16
    keep = new_lanes(dim)
    noise, direction = np.empty(2 * vectors * 16, np.float32), np.empty(vectors * 16, np.float32)
    for i in range(begin, stop):
        start = i % 2 * vectors * 16
        if start == 0:
            fill_normal(seed, i * vectors, 2 * vectors, noise)
        at, code = get(rows, i) * dim, get(codes, i) * dim
        error = squared = broadcast(0)
        for j in range(vectors):
            place = min(16 * j, dim - 16)
            residual = load(codebook, code + place) - load(x, at + place)
            way = fma(aim, residual, spread * load(noise, start + place))
            store(direction, place, way)
            if j == vectors - 1:
                residual, way = residual * load(keep, 0), way * load(keep, 0)
            error = fma(residual, residual, error)
            squared = fma(way, way, squared)
        length = sqrt(lane_sum(error) * _inverses(broadcast(lane_sum(squared))))
        for j in range(vectors):
            place = min(16 * j, dim - 16)
            store(out, i * dim + place, fma(length, load(direction, place), load(x, at + place)))


@cache
def _forward(dim: int) -> Any:
    """The kernel for rows of ``dim`` columns, a compile-time constant."""
    write_rows = _short_forward if dim < 16 else _long_forward

    def forward(block, _, seed, aim, spread, x, rows, codebook, codes, out):
        begin, stop = block * _ROWS, min(codes.shape[0], (block + 1) * _ROWS)
        found = _outside(dim, x, rows, codebook, codes, begin, stop)
        if found == 0:
            write_rows(dim, seed, aim, spread, x, rows, codebook, codes, out, begin, stop)
        return found

    return parallel(forward)


@inline
def _short_backward(dim, grad, x, rows, codebook, codes, out, grad_x, sums, begin, stop):
    values, chosen = _new_group(dim), _new_group(dim)
    moved, slope = _new_group(dim), _new_group(dim)
    for first in range(begin, stop, 16):
        valid = min(16, stop - first)
        for lane in range(valid):
            i = first + lane
            _take_row(dim, x, get(rows, i) * dim, lane, values)
            _take_row(dim, codebook, get(codes, i) * dim, lane, chosen)
            _take_row(dim, out, i * dim, lane, moved)
            _take_row(dim, grad, i * dim, lane, slope)
        dots = squared = broadcast(0)
        for j in range(dim):
            value = load(values, 16 * j)
            dots = fma(load(slope, 16 * j), load(moved, 16 * j) - value, dots)
            residual = value - load(chosen, 16 * j)
            squared = fma(residual, residual, squared)
        scale = dots * _inverses(squared)
        for j in range(dim):
            radial = scale * (load(values, 16 * j) - load(chosen, 16 * j))
            store(chosen, 16 * j, radial)
            store(slope, 16 * j, load(slope, 16 * j) + radial)
        for lane in range(valid):
            i = first + lane
            clear_between(rows, i, dim, grad_x)
            at, code = get(rows, i) * dim, get(codes, i) * dim
            for j in range(dim):
                put(grad_x, at + j, get(slope, j * 16 + lane))
                put(sums, code + j, get(sums, code + j) - get(chosen, j * 16 + lane))


@inline
def _long_backward(dim, grad, x, rows, codebook, codes, out, grad_x, sums, begin, stop):
    vectors = (dim + 15) // 16
    keep = new_lanes(dim)
    for i in range(begin, stop):
        at, code = get(rows, i) * dim, get(codes, i) * dim
        dots = squared = broadcast(0)
        for j in range(vectors):
            place = min(16 * j, dim - 16)
            value, slope = load(x, at + place), load(grad, i * dim + place)
            residual = value - load(codebook, code + place)
            if j == vectors - 1:
                residual, slope = residual * load(keep, 0), slope * load(keep, 0)
            dots = fma(slope, load(out, i * dim + place) - value, dots)
            squared = fma(residual, residual, squared)
        scale = lane_sum(dots) * _inverses(broadcast(lane_sum(squared)))
        clear_between(rows, i, dim, grad_x)
        # The last two vectors overlap, so the last sums are read before any are written.
        last = load(sums, code + dim - 16)
        for j in range(vectors):
            place = min(16 * j, dim - 16)
            radial = scale * (load(x, at + place) - load(codebook, code + place))
            store(grad_x, at + place, load(grad, i * dim + place) + radial)
            before = last if j == vectors - 1 else load(sums, code + place)
            store(sums, code + place, before - radial)


@cache
def _backward(dim: int) -> Any:
    """The kernel of the gradients; each part of the rows has its own sums."""
    write_rows = _short_backward if dim < 16 else _long_backward

    def backward(part, parts, grad, x, rows, codebook, codes, out, grad_x, sums):
        count = codes.shape[0]
        begin, stop = share(count, part, parts)
        found = _outside(dim, x, rows, codebook, codes, begin, stop)
        if found == 0:
            clear(sums[part], 0, sums.shape[1])
            write_rows(dim, grad, x, rows, codebook, codes, out, grad_x, sums[part], begin, stop)
            if part == parts - 1:
                clear_between(rows, count, dim, grad_x)
        return found

    return parallel(backward)


def substitute(
    seed: int, x: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor, *, aim: float, spread: float
) -> Tensor:
    """``x + ‖x − c‖·d/‖d‖`` with ``d = aim·(c − x) + spread·v``, v ~ N(0, I), for some rows of a table, ``[V, D]``.

    Args:
        seed: 63 random bits; v is a function of them and of the position in ``rows``.
        x: Contiguous float32 table ``[N, D]`` on the CPU, as are all tensors here.
        rows: Which rows of it, ``[V]`` int64.
        codebook: Codes ``[K, D]``.
        codes: Code of each chosen row, ``[V]`` int64.
        aim: Weight of the residual c − x in the direction d.
        spread: Weight of the noise in d.

    Raises:
        ValueError: The tensors do not fit together, one is not contiguous, or a row or code is out of range.
        TypeError: A dtype is wrong.
    """
    check_inputs(x, rows, codebook, codes)
    out = recycled((len(rows), x.shape[1]))
    thread_count()
    blocks = -(-len(rows) // _ROWS)
    tables = map(flat, (x, rows, codebook, codes, out))
    if _forward(x.shape[1])(blocks, seed, F(aim), F(spread), *tables):
        _check_inside(x, rows, codebook, codes)
    return out


def check_inputs(*tensors: Tensor) -> None:
    """Refuse tensors that do not fit together; the last two are those of a backward pass.

    Raises:
        ValueError: The shapes or devices do not fit together, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    check_fit("x [N, D], rows [V] int64, codebook [K, D], codes [V] int64, grad [V, D], out [V, D]", *tensors)


def _check_inside(x: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor) -> None:
    """Name the row or the code that a kernel has found out of range."""
    check_inside("rows", rows, len(x))
    check_inside("codes", codes, len(codebook))


def substitute_backward(
    grad: Tensor, x: Tensor, rows: Tensor, codebook: Tensor, codes: Tensor, out: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of ``x [N, D]`` and ``codebook [K, D]`` from that of the result, ``grad [V, D]``.

    ``out [V, D]`` is the result of :func:`substitute`; ``rows [V]`` must be ascending and distinct here.

    Raises:
        ValueError: As for :func:`substitute`.
        TypeError: A dtype is wrong.
    """
    check_inputs(x, rows, codebook, codes, grad, out)
    grad_x, grad_codebook = recycled(x.shape), recycled(codebook.shape)
    # Enough parts for the threads, few enough that adding them up is cheap.
    parts = max(4, min(64, len(rows) // (4 * len(codebook))))
    sums = recycled((parts, codebook.numel())).numpy()
    thread_count()
    tables = map(flat, (grad, x, rows, codebook, codes, out, grad_x))
    if _backward(x.shape[1])(parts, *tables, sums):
        _check_inside(x, rows, codebook, codes)
    np.add.reduce(sums, axis=0, out=grad_codebook.numpy().ravel())
    return grad_x, grad_codebook
