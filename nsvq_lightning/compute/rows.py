"""Rows and numbers: in shares of whole vectors, and distinct ones out of a table and back into one."""

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.jit import inline, parallel
from nsvq_lightning.compute.memory import recycled
from nsvq_lightning.compute.simd import get, load, load_rows3, load_rows4, put, scratch


@inline
def share(count, part, parts):
    """First and end of a part of ``count`` things."""
    return count * part // parts, count * (part + 1) // parts


@inline
def vector_share(count, part, parts):
    """The same of ``count`` splats: whole vectors, except for the very last one."""
    vectors = (count + 15) // 16
    return 16 * (vectors * part // parts), min(count, 16 * (vectors * (part + 1) // parts))


def _loader(columns, load):
    """A helper that loads 16 rows; an incomplete last vector is read from a copy."""

    @inline
    def load_rows(rows, start, count):
        if count < 16:
            padded = scratch(64)
            for k in range(columns * count):
                put(padded, k, get(rows, columns * start + k))
            return load(padded, 0)
        return load(rows, columns * start)

    return load_rows


load_numbers, load_vectors, load_quats = _loader(1, load), _loader(3, load_rows3), _loader(4, load_rows4)


@inline
def clear(array, first, last):
    """Zero a range of elements."""
    for i in range(first, last):
        put(array, i, 0)


@parallel
def clear_all(part, parts, table):
    """Zero a table."""
    clear(table, *share(table.shape[0], part, parts))


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


def put_rows(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """A table ``[count, ...]`` of zeros except for ``values [V, ...]`` at ``rows [V]``, int64, ascending, distinct."""
    shape = (count, *values.shape[1:])
    table = recycled(shape) if kernels_for(values) == "cpu" else values.new_empty(shape)
    return table.zero_().index_copy_(0, rows, values)


class _TakeRows(torch.autograd.Function):
    """``index_select`` whose backward copies rows instead of adding them, since they are distinct."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.count = tensor.shape[0]
        return tensor.index_select(0, rows)

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


def sorted_by_key(keys: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Places ``[N]`` int64, stably sorted by keys in [0, count), and where each key begins ``[count + 1]`` int32."""
    # 16-bit keys take a quarter of the sorting passes of 64-bit ones.
    key = torch.int16 if count < 2**15 else torch.int32
    found, places = keys.to(key).sort(stable=True)
    return places, torch.searchsorted(found, torch.arange(count + 1, dtype=key, device=keys.device), out_int32=True)
