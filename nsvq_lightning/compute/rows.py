"""Distinct rows out of a table and back into one."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.rows_cpu import gather_rows, spread_rows

__all__ = ["put_rows", "take_rows"]


def put_rows(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """A table ``[count, ...]`` of zeros but for ``values [V, ...]`` at ``rows [V]``, int64, ascending, distinct."""
    if kernels_for(values) == "cpu":
        return spread_rows(values, rows, count)
    return values.new_zeros(count, *values.shape[1:]).index_copy_(0, rows, values)


class _TakeRows(torch.autograd.Function):
    """``index_select`` whose backward copies rows instead of adding them: distinct rows never meet."""

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
    """The rows ``rows [V]`` (int64, ascending, all different) of ``tensor [N, ...]``: ``[V, ...]``.

    The backward pass takes half the time of ``index_select``'s, and no order of additions enters its result.
    """
    return cast(Tensor, _TakeRows.apply(tensor, rows))
