"""Rows out of a table and back into one, in one pass over the memory each."""

from __future__ import annotations

import math

import torch
from numba import prange
from torch import Tensor

from nsvq_lightning.rendering.cpu.arrays import flat
from nsvq_lightning.rendering.cpu.jit import inline, kernel, thread_count
from nsvq_lightning.rendering.cpu.lanes import get, put
from nsvq_lightning.rendering.cpu.projection import clear
from nsvq_lightning.rendering.cpu.workspace import recycled

__all__ = ["clear_between", "gather_rows", "spread_rows"]


@inline
def clear_between(rows, i, columns, table):
    """Zero the rows of a table between the ``i - 1``-th and the ``i``-th of ``rows``; past the last, up to the end."""
    first = columns * (get(rows, i - 1) + 1) if i > 0 else 0
    clear(table, first, columns * get(rows, i) if i < rows.shape[0] else table.shape[0])


@inline
def _copy(source, start, target, place, count):
    for k in range(count):
        put(target, place + k, get(source, start + k))


@kernel
def _gather(threads, columns, source, rows, target):
    count = rows.shape[0]
    for thread in prange(threads):
        for i in range(count * thread // threads, count * (thread + 1) // threads):
            _copy(source, columns * get(rows, i), target, columns * i, columns)


@kernel
def _spread(threads, columns, source, rows, target):
    count = rows.shape[0]
    for thread in prange(threads):
        for i in range(count * thread // threads, count * (thread + 1) // threads):
            clear_between(rows, i, columns, target)
            _copy(source, columns * i, target, columns * get(rows, i), columns)
        if thread == threads - 1:
            clear_between(rows, count, columns, target)


def gather_rows(table: Tensor, rows: Tensor) -> Tensor:
    """The rows ``rows [V]`` of a float32 table ``[N, ...]`` on the CPU: ``[V, ...]``."""
    out = torch.empty(rows.shape[0], *table.shape[1:])
    _gather(thread_count(), _columns(table), flat(table), rows.numpy(), flat(out))
    return out


def spread_rows(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """A table ``[count, ...]`` of zeros but for ``values [V, ...]`` at the ascending ``rows [V]``."""
    table = recycled((count, *values.shape[1:]))
    _spread(thread_count(), _columns(values), flat(values), rows.numpy(), flat(table))
    return table


def _columns(table: Tensor) -> int:
    return math.prod(table.shape[1:])
