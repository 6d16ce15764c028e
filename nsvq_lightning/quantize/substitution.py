"""Noise substitution on the CPU: residual, noise and result of a row in one pass, its gradients in another.

Short rows are handled 16 at a time, one row a lane. Rows of 16 and more numbers are handled one at a time, in vectors
along the row of which the last two may overlap. The backward pass draws the noise again: that is faster than to write
it to memory and to read it back.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from nsvq_lightning.quantize.noise import fill_normal
from nsvq_lightning.rendering.cpu.jit import inline, kernel, thread_count
from nsvq_lightning.rendering.cpu.lanes import fma, get, lane_sum, load, put, select, splat, store, vsqrt

__all__ = ["substitute", "substitute_backward"]

_ROWS = 256
"""Rows a unit of parallel work takes; the noise of a row depends on its number alone."""

Floats = NDArray[np.float32]
Codes = NDArray[np.int64]


@inline
def _copy_in(dim, source, row, count, group):  # type: ignore[no-untyped-def]
    """Rows to vectors, one row a lane."""
    for lane in range(count):
        for j in range(dim):
            put(group, j * 16 + lane, get(source, (row + lane) * dim + j))


@inline
def _copy_out(dim, group, target, row, count):  # type: ignore[no-untyped-def]
    for lane in range(count):
        for j in range(dim):
            put(target, (row + lane) * dim + j, get(group, j * 16 + lane))


@inline
def _copy_codes(dim, codebook, codes, row, count, group):  # type: ignore[no-untyped-def]
    for lane in range(count):
        code = get(codes, row + lane)
        for j in range(dim):
            put(group, j * 16 + lane, get(codebook, code * dim + j))


@inline
def _dots(dim, a, b):  # type: ignore[no-untyped-def]
    """Products of rows with rows, one a lane."""
    total = splat(np.float32(0.0))
    for j in range(dim):
        total = fma(load(a, 16 * j), load(b, 16 * j), total)
    return total


@inline
def _residuals_squared(dim, rows, chosen):  # type: ignore[no-untyped-def]
    total = splat(np.float32(0.0))
    for j in range(dim):
        residual = load(rows, 16 * j) - load(chosen, 16 * j)
        total = fma(residual, residual, total)
    return total


@inline
def _inverse_roots(squared):  # type: ignore[no-untyped-def]
    """1/√s, and 0 where s is 0: a vector without length has no direction."""
    zero = splat(np.float32(0.0))
    return select(squared > zero, splat(np.float32(1.0)) / vsqrt(squared), zero)


@inline
def _dot(dim, a, at_a, b, at_b, keep):  # type: ignore[no-untyped-def]
    """Product of two long rows. ``keep`` leaves out what the last vector has in common with the one before."""
    total = splat(np.float32(0.0))
    for j in range(0, dim // 16 * 16, 16):
        total = fma(load(a, at_a + j), load(b, at_b + j), total)
    if dim % 16:
        total = fma(load(a, at_a + dim - 16) * load(keep, 0), load(b, at_b + dim - 16), total)
    return lane_sum(total)


@inline
def _residual_squared(dim, x, at, codebook, code, keep):  # type: ignore[no-untyped-def]
    total = splat(np.float32(0.0))
    for j in range(0, dim // 16 * 16, 16):
        residual = load(x, at + j) - load(codebook, code + j)
        total = fma(residual, residual, total)
    if dim % 16:
        residual = (load(x, at + dim - 16) - load(codebook, code + dim - 16)) * load(keep, 0)
        total = fma(residual, residual, total)
    return lane_sum(total)


@inline
def _inverse_root(squared):  # type: ignore[no-untyped-def]
    return np.float32(1.0) / np.sqrt(squared) if squared > np.float32(0.0) else np.float32(0.0)


def _short_forward(dim: int) -> Any:
    def forward(seed, x, codebook, codes, out):  # type: ignore[no-untyped-def]
        count = codes.shape[0]
        for block in prange((count + _ROWS - 1) // _ROWS):
            noise, radius, angle = np.empty(_ROWS * dim, np.float32), np.empty(16, np.float32), np.empty(16, np.float32)
            rows, chosen = np.zeros(16 * dim, np.float32), np.zeros(16 * dim, np.float32)
            fill_normal(seed, block * _ROWS // 16 * dim, _ROWS // 16 * dim, noise, radius, angle)
            for row in range(block * _ROWS, min(count, (block + 1) * _ROWS), 16):
                valid = min(16, count - row)
                _copy_in(dim, x, row, valid, rows)
                _copy_codes(dim, codebook, codes, row, valid, chosen)
                group = noise[(row - block * _ROWS) * dim :]
                length = vsqrt(_residuals_squared(dim, rows, chosen))
                inverse = _inverse_roots(_dots(dim, group, group))
                for j in range(dim):
                    store(rows, 16 * j, fma(length, load(group, 16 * j) * inverse, load(rows, 16 * j)))
                _copy_out(dim, rows, out, row, valid)

    return kernel(forward)


def _short_backward(dim: int) -> Any:
    def backward(seed, grad, x, codebook, codes, grad_x, factor):  # type: ignore[no-untyped-def]
        count = codes.shape[0]
        for block in prange((count + _ROWS - 1) // _ROWS):
            noise, radius, angle = np.empty(_ROWS * dim, np.float32), np.empty(16, np.float32), np.empty(16, np.float32)
            rows, chosen = np.zeros(16 * dim, np.float32), np.zeros(16 * dim, np.float32)
            slope, along = np.zeros(16 * dim, np.float32), np.empty(16, np.float32)
            fill_normal(seed, block * _ROWS // 16 * dim, _ROWS // 16 * dim, noise, radius, angle)
            for row in range(block * _ROWS, min(count, (block + 1) * _ROWS), 16):
                valid = min(16, count - row)
                _copy_in(dim, x, row, valid, rows)
                _copy_codes(dim, codebook, codes, row, valid, chosen)
                _copy_in(dim, grad, row, valid, slope)
                group = noise[(row - block * _ROWS) * dim :]
                scale = _dots(dim, slope, group) * _inverse_roots(_dots(dim, group, group))
                scale = scale * _inverse_roots(_residuals_squared(dim, rows, chosen))
                store(along, 0, scale)
                for j in range(dim):
                    residual = load(rows, 16 * j) - load(chosen, 16 * j)
                    store(slope, 16 * j, fma(scale, residual, load(slope, 16 * j)))
                _copy_out(dim, slope, grad_x, row, valid)
                for lane in range(valid):
                    factor[row + lane] = along[lane]

    return kernel(backward)


def _long_forward(dim: int) -> Any:
    vectors = -(-dim // 16)

    def forward(seed, x, codebook, codes, out):  # type: ignore[no-untyped-def]
        count = codes.shape[0]
        for block in prange((count + _ROWS - 1) // _ROWS):
            radius, angle, keep = np.empty(16, np.float32), np.empty(16, np.float32), np.ones(16, np.float32)
            keep[: vectors * 16 - dim] = 0
            size = _ROWS * vectors
            noise = np.empty(size * 16, np.float32)
            fill_normal(seed, block * size, size, noise, radius, angle)
            for row in range(block * _ROWS, min(count, (block + 1) * _ROWS)):
                at, code, start = row * dim, get(codes, row) * dim, (row - block * _ROWS) * vectors * 16
                length = splat(np.sqrt(_residual_squared(dim, x, at, codebook, code, keep)))
                inverse = splat(_inverse_root(_dot(dim, noise, start, noise, start, keep)))
                for j in range(vectors):
                    place = min(16 * j, dim - 16)
                    store(out, at + place, fma(length, load(noise, start + place) * inverse, load(x, at + place)))

    return kernel(forward)


def _long_backward(dim: int) -> Any:
    vectors = -(-dim // 16)

    def backward(seed, grad, x, codebook, codes, grad_x, factor):  # type: ignore[no-untyped-def]
        count = codes.shape[0]
        for block in prange((count + _ROWS - 1) // _ROWS):
            radius, angle, keep = np.empty(16, np.float32), np.empty(16, np.float32), np.ones(16, np.float32)
            keep[: vectors * 16 - dim] = 0
            size = _ROWS * vectors
            noise = np.empty(size * 16, np.float32)
            fill_normal(seed, block * size, size, noise, radius, angle)
            for row in range(block * _ROWS, min(count, (block + 1) * _ROWS)):
                at, code, start = row * dim, get(codes, row) * dim, (row - block * _ROWS) * vectors * 16
                scale = _dot(dim, grad, at, noise, start, keep)
                scale *= _inverse_root(_dot(dim, noise, start, noise, start, keep))
                scale *= _inverse_root(_residual_squared(dim, x, at, codebook, code, keep))
                put(factor, row, scale)
                for j in range(vectors):
                    place = min(16 * j, dim - 16)
                    residual = load(x, at + place) - load(codebook, code + place)
                    store(grad_x, at + place, fma(splat(scale), residual, load(grad, at + place)))

    return kernel(backward)


@cache
def _kernels(dim: int) -> tuple[Any, Any]:
    """Forward and backward for rows of ``dim`` numbers, a constant for the compiler."""
    return (_short_forward(dim), _short_backward(dim)) if dim < 16 else (_long_forward(dim), _long_backward(dim))


@kernel
def _sum_residuals(x, codebook, codes, factor, sums, parts):  # type: ignore[no-untyped-def]
    """Subtract factor · (x − c) from the sum of its code; a part owns a range of codes, so rows add in their order."""
    for part in prange(parts):
        first, last = part * sums.shape[0] // parts, (part + 1) * sums.shape[0] // parts
        for i in range(codes.shape[0]):
            code = codes[i]
            if first <= code < last:
                for j in range(x.shape[1]):
                    sums[code, j] -= factor[i] * (x[i, j] - codebook[code, j])


def substitute(seed: int, x: Floats, codebook: Floats, codes: Codes) -> Floats:
    """``x + ‖x − c‖·v̂`` with random directions v̂, ``[N, D]``.

    Args:
        seed: 63 random bits; a direction is a function of them and of the row's number.
        x: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``.
        codes: Code of each row, ``[N]``.
    """
    out = np.empty_like(x)
    thread_count()
    _kernels(x.shape[1])[0](seed, x.ravel(), codebook.ravel(), codes, out.ravel())
    return out


def substitute_backward(seed: int, grad: Floats, x: Floats, codebook: Floats, codes: Codes) -> tuple[Floats, Floats]:
    """Gradients of ``x [N, D]`` and ``codebook [K, D]`` from that of the result, ``grad [N, D]``."""
    grad_x, grad_codebook, factor = np.empty_like(x), np.zeros_like(codebook), np.empty(len(x), np.float32)
    threads = thread_count()
    flat = (array.ravel() for array in (grad, x, codebook))
    _kernels(x.shape[1])[1](seed, *flat, codes, grad_x.ravel(), factor)
    _sum_residuals(x, codebook, codes, factor, grad_codebook, threads)
    return grad_x, grad_codebook
