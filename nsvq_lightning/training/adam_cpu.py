"""One step of Adam over a table of rows, in a single pass over memory.

The step is memory-bound: seven streams (weight, gradient and two moments in, all but the gradient out). So what
helps is touching less memory: only the leading columns, or only the rows that have a gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numba import prange
from torch import Tensor

from nsvq_lightning.compute.jit import F, inline, kernel, thread_count
from nsvq_lightning.compute.lanes import any_lane, broadcast, fma, get, load, prefetch, put, select, store, vsqrt
from nsvq_lightning.compute.memory import Array, Workspace, flat_checked

__all__ = ["adam_update"]

WIDTH = 16
AHEAD = 256
"""Prefetch distance in floats: a tenth faster than hardware prefetching alone."""
BLOCK = 16
"""Rows that are checked together: as many whole vectors as a row has columns."""


@inline
def unpack(factors):
    """The six factors of a step as scalars, see :func:`_factors`."""
    return get(factors, 0), get(factors, 1), get(factors, 2), get(factors, 3), get(factors, 4), get(factors, 5)


@inline
def update(weights, gradients, firsts, seconds, o, factors, chosen):
    """Adam on those of the sixteen elements from ``o`` on that are chosen."""
    for table in (weights, gradients, firsts, seconds):
        prefetch(table, o + AHEAD)
    step, gain, decay, fresh, root, eps = factors
    weight, gradient, first, second = load(weights, o), load(gradients, o), load(firsts, o), load(seconds, o)
    mean = fma(broadcast(gain), gradient - first, first)
    square = fma(broadcast(decay), second, broadcast(fresh) * (gradient * gradient))
    moved = weight - broadcast(step) * mean / fma(vsqrt(square), broadcast(root), broadcast(eps))
    store(weights, o, select(chosen, moved, weight))
    store(firsts, o, select(chosen, mean, first))
    store(seconds, o, select(chosen, square, second))


@inline
def update_one(weights, gradients, firsts, seconds, o, factors):
    """Adam on one element."""
    step, gain, decay, fresh, root, eps = factors
    gradient, first = get(gradients, o), get(firsts, o)
    mean = gain * (gradient - first) + first
    square = decay * get(seconds, o) + fresh * (gradient * gradient)
    put(weights, o, get(weights, o) - step * mean / (np.sqrt(square) * root + eps))
    put(firsts, o, mean)
    put(seconds, o, square)


@kernel
def update_all(threads, weights, gradients, firsts, seconds, packed):
    """Update every element of the table."""
    vectors = weights.shape[0] // WIDTH
    for thread in prange(threads):
        factors = unpack(packed)
        every = broadcast(F(1)) > broadcast(F(0))
        for i in range(vectors * thread // threads, vectors * (thread + 1) // threads):
            update(weights, gradients, firsts, seconds, WIDTH * i, factors, every)
        if thread == threads - 1:
            for o in range(WIDTH * vectors, weights.shape[0]):
                update_one(weights, gradients, firsts, seconds, o, factors)


@kernel
def update_columns(threads, rows, stride, columns, weights, gradients, firsts, seconds, packed):
    """Update the leading ``columns`` of each row, and what shares a vector with them; at most ``stride`` in all."""
    for thread in prange(threads):
        factors = unpack(packed)
        every = broadcast(F(1)) > broadcast(F(0))
        for row in range(rows * thread // threads, rows * (thread + 1) // threads):
            for k in range(0, columns, WIDTH):
                update(weights, gradients, firsts, seconds, row * stride + k, factors, every)


@inline
def has_gradient(gradients, o, columns):
    """Whether any of ``columns`` elements is not 0; NaN counts too."""
    zero = broadcast(F(0))
    if columns >= WIDTH:
        for k in range(0, columns, WIDTH):
            # The last vector overlaps the one before it.
            x = load(gradients, o + min(k, columns - WIDTH))
            if any_lane(~((x >= zero) & (x <= zero))):
                return True
    else:
        for k in range(columns):
            if get(gradients, o + k) != F(0):
                return True
    return False


@inline
def mark_rows(gradients, o, rows, columns, marks):
    """Mark each element of some rows: 1 where its row has a gradient, else 0."""
    for row in range(rows):
        start = row * columns
        mark = F(1) if has_gradient(gradients, o + start, columns) else F(0)
        if columns >= WIDTH:
            for k in range(0, columns, WIDTH):
                store(marks, start + min(k, columns - WIDTH), broadcast(mark))
        else:
            for k in range(start, start + columns):
                put(marks, k, mark)


@kernel
def update_rows(threads, rows, stride, weights, gradients, firsts, seconds, packed, scratch):
    """Update the rows that have a gradient."""
    blocks = (rows + BLOCK - 1) // BLOCK
    for thread in prange(threads):
        factors = unpack(packed)
        marks = scratch[thread]
        for block in range(blocks * thread // threads, blocks * (thread + 1) // threads):
            o = block * BLOCK * stride
            here = min(BLOCK, rows - block * BLOCK)
            mark_rows(gradients, o, here, stride, marks)
            whole = here * stride // WIDTH * WIDTH
            for k in range(0, whole, WIDTH):
                chosen = load(marks, k) > broadcast(F(0))
                if any_lane(chosen):
                    update(weights, gradients, firsts, seconds, o + k, factors, chosen)
            for k in range(whole, here * stride):
                if get(marks, k) != F(0):
                    update_one(weights, gradients, firsts, seconds, o + k, factors)


def adam_update(
    weights: Tensor,
    gradients: Tensor,
    first: Tensor,
    second: Tensor,
    *,
    step: int,
    lr: float,
    betas: tuple[float, float],
    eps: float,
    columns: int | None = None,
    rows_with_gradient: bool = False,
) -> Callable[[], None]:
    """Prepare an in-place Adam step on contiguous float32 tensors ``[N, ...]`` on the CPU; call the result to run it.

    Prepare several steps first, then run them: each one flushes the caches, which slows down Python code in between.

    Args:
        weights: The parameter.
        gradients: Its gradient.
        first: First moment, the mean of the gradients.
        second: Second moment, the mean of their squares.
        step: 1-based number of the step, for bias correction.
        lr: Learning rate.
        betas: Decay rates of the two moments.
        eps: Added to the root of the second moment.
        columns: Update only this many leading columns of each row; the caller guarantees that gradient and moments of
            the others are 0, so that Adam would not change them.
        rows_with_gradient: Leave rows whose gradient is 0 unchanged, moments included.

    Raises:
        ValueError: The tensors differ in shape, or one is not contiguous.
        TypeError: One is not float32.
    """
    packed = _factors(step, lr, betas, eps)
    given = {"weights": weights, "gradients": gradients, "first": first, "second": second}
    shape = tuple(weights.shape)
    tables = [flat_checked(name, tensor, shape) for name, tensor in given.items()]
    threads, rows, stride = thread_count(), shape[0], math.prod(shape[1:])
    if rows_with_gradient:
        return partial(_update_rows, threads, rows, stride, *tables, packed)
    if columns is not None and -(-columns // WIDTH) * WIDTH <= stride:
        return partial(update_columns, threads, rows, stride, columns, *tables, packed)
    return partial(update_all, threads, *tables, packed)


def _update_rows(threads: int, rows: int, stride: int, *tables: Array) -> None:
    work = Workspace.borrow()
    update_rows(threads, rows, stride, *tables, work.rows("marks", threads, BLOCK * stride))
    work.give_back()


def _factors(step: int, lr: float, betas: tuple[float, float], eps: float) -> Array:
    """Step size, gradient's share in the first moment, decay and share in the second, 1 / root of its bias, eps."""
    first, second = (1 - beta**step for beta in betas)
    return np.array([lr / first, 1 - betas[0], betas[1], 1 - betas[1], 1 / math.sqrt(second), eps], np.float32)
