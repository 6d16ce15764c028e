"""Straight-through vector quantization with a codebook from k-means, the quantizer of CompGS."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.random import generator as seeded
from nsvq_lightning.subset import put_rows

__all__ = ["StraightThrough"]


class StraightThrough(CodebookQuantizer):
    """Quantizer that renders the nearest code itself and copies the gradient to the input (Bengio et al. 2013).

    In training ``x_q = c + x − sg(x)`` with c the nearest code and sg a constant for the gradient: the value is c to
    the bit, the gradient of x is that of the result. The codebook gets none; :meth:`refit` moves it to the rows now and
    then, as in CompGS (Navaneet et al. 2024), which :class:`nsvq_lightning.callbacks.CodebookRefit` does on schedule.
    CompGS searches codes at its refits only; here a row has its nearest code in every step.
    """

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None) -> Tensor:
        """The codes of the rows ``rows [V]`` of ``x [N, D]``, whose gradient goes to the rows."""
        result: Tensor = _CopiedGradient.apply(x, self.codebook.detach(), codes, rows)  # type: ignore[no-untyped-call]
        return result

    @torch.no_grad()
    def refit(self, x: Tensor, steps: int) -> None:
        """Move the codebook to the rows ``x [N, D]`` by ``steps`` Lloyd steps from where it is; K stays."""
        start = self.codebook.detach()
        # With a start k-means draws nothing, whatever the generator.
        self.codebook.copy_(kmeans(x, self.num_codes, seeded(0), steps=steps, start=start))


class _CopiedGradient(torch.autograd.Function):
    """Codes ``[V, D]`` whose gradient is taken for that of the rows ``[V]`` of ``x [N, D]``."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, codebook: Tensor, codes: Tensor, rows: Tensor | None) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.count = x.shape[0]
        return codebook.index_select(0, codes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        (rows,) = ctx.saved_tensors
        return grad if rows is None else put_rows(grad, rows, ctx.count), None, None, None
