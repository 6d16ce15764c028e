"""Copy distinct rows out of a table, and back into one."""

import math
from typing import Any, cast

import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import inline, kernel, thread_count
from nsvq_lightning.compute.memory import INT64, Array, flat, flat_checked, outside, recycled
from nsvq_lightning.compute.simd import get, put


@inline
def clear(array, first, last):
    """Zero a range of elements."""
    for i in range(first, last):
        put(array, i, 0)


@inline
def clear_between(rows, i, columns, table):
    """Zero the rows of a table between the ``i - 1``-th and the ``i``-th of ``rows``; past the last, up to the end."""
    first = columns * (get(rows, i - 1) + 1) if i > 0 else 0
    clear(table, first, columns * get(rows, i) if i < rows.shape[0] else table.shape[0])


@inline
def count_outside(rows, first, last, count):
    """How many of ``rows[first:last]`` are not rows of a table of ``count`` rows; ``first`` may be -1."""
    found = 0
    for i in range(max(first, 0), last):
        found += get(rows, i) < 0 or get(rows, i) >= count
    return found


@inline
def _copy(source, start, target, place, count):
    for k in range(count):
        put(target, place + k, get(source, start + k))


@kernel
def _gather(threads, height, columns, source, rows, target):
    """Copy rows of a table of ``height`` rows; returns how many are outside it (if any, not all rows are copied)."""
    count = rows.shape[0]
    missing = 0
    for thread in prange(threads):
        first, last = count * thread // threads, count * (thread + 1) // threads
        found = count_outside(rows, first, last, height)
        missing += found
        if found == 0:
            for i in range(first, last):
                _copy(source, columns * get(rows, i), target, columns * i, columns)
    return missing


@kernel
def _spread(threads, height, columns, source, rows, target):
    """The inverse of :func:`_gather`."""
    count = rows.shape[0]
    missing = 0
    for thread in prange(threads):
        first, last = count * thread // threads, count * (thread + 1) // threads
        # The row before the first one says where clearing begins.
        found = count_outside(rows, first - 1, last, height)
        missing += found
        if found == 0:
            for i in range(first, last):
                clear_between(rows, i, columns, target)
                _copy(source, columns * i, target, columns * get(rows, i), columns)
            if thread == threads - 1:
                clear_between(rows, count, columns, target)
    return missing


def gather_rows(table: Tensor, rows: Tensor) -> Tensor:
    """The rows ``rows [V]`` of a float32 table ``[N, ...]`` on the CPU: ``[V, ...]``.

    Raises:
        ValueError: ``rows`` is not ``[V]``, or one of them is outside the table.
        TypeError: The table is not float32, or the rows are not int64.
    """
    values = flat_checked("table", table.contiguous(), tuple(table.shape))
    numbers = _numbers(rows)
    out = torch.empty(len(numbers), *table.shape[1:])
    if _gather(thread_count(), len(table), math.prod(table.shape[1:]), values, numbers, flat(out)):
        raise outside("rows", numbers, len(table))
    return out


def spread_rows(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """A table ``[count, ...]`` of zeros except for ``values [V, ...]`` at the ascending ``rows [V]``.

    Raises:
        ValueError: ``rows`` is not ``[V]``, or one of them is outside the table.
        TypeError: The values are not float32, or the rows are not int64.
    """
    numbers = _numbers(rows)
    table = recycled((count, *values.shape[1:]))
    given = flat_checked("values", values.contiguous(), (len(numbers), *values.shape[1:]))
    if _spread(thread_count(), count, math.prod(values.shape[1:]), given, numbers, flat(table)):
        raise outside("rows", numbers, count)
    return table


def _numbers(rows: Tensor) -> Array:
    return flat_checked("rows", rows.contiguous(), (rows.numel(),), INT64)


def put_rows(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """A table ``[count, ...]`` of zeros except for ``values [V, ...]`` at ``rows [V]``, int64, ascending, distinct."""
    if kernels_for(values) == "cpu":
        return spread_rows(values, rows, count)
    return values.new_zeros(count, *values.shape[1:]).index_copy_(0, rows, values)


class _TakeRows(torch.autograd.Function):
    """``index_select`` whose backward copies rows instead of adding them, since they are distinct."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.count = tensor.shape[0]
        return gather_rows(tensor, rows) if kernels_for(tensor) == "cpu" else tensor.index_select(0, rows)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        return put_rows(grad, rows, ctx.count), None


def take_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """The rows ``rows [V]`` (int64, ascending, distinct) of ``tensor [N, ...]``: ``[V, ...]``.

    The backward pass takes half the time of ``index_select``'s, and its result depends on no order of additions.
    """
    return cast(Tensor, _TakeRows.apply(tensor, rows))
