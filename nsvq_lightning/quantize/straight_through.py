"""Straight-through vector quantization, with a k-means codebook as in CompGS or a trained one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.rows import put_rows
from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.quantize.sums import sum_by_code
from nsvq_lightning.random import generator as seeded

__all__ = ["StraightThrough", "TrainedStraightThrough"]


class StraightThrough(CodebookQuantizer):
    """Quantizer that renders the nearest code itself and copies the gradient to the input (Bengio et al. 2013).

    In training ``x_q = c + x − sg(x)`` with c the nearest code and sg the stop-gradient operator: the value is c to the
    bit, the gradient of x is that of the result. The codebook gets none; :meth:`refit` fits it to the rows from time to
    time, as in CompGS (Navaneet et al. 2024), and :class:`nsvq_lightning.callbacks.CodebookRefit` schedules this.
    CompGS searches codes only at its refits; here a row has its nearest code in every step.
    """

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None) -> Tensor:
        """The codes of the rows ``rows [V]`` of ``x [N, D]``, whose gradient goes to the rows."""
        result: Tensor = _CopiedGradient.apply(x, self.codebook.detach(), codes, rows)  # type: ignore[no-untyped-call]
        return result

    @torch.no_grad()
    def refit(self, x: Tensor, steps: int) -> None:
        """Fit the codebook to the rows ``x [N, D]`` by ``steps`` Lloyd steps from its current state; K stays."""
        start = self.codebook.detach()
        # With a given start, k-means draws nothing from the generator.
        self.codebook.copy_(kmeans(x, self.num_codes, seeded(0), steps=steps, start=start))


class TrainedStraightThrough(CodebookQuantizer):
    """Straight-through quantizer whose codes are trained by their own gradient: x_q = c + x − sg(x).

    The gradient g of the result goes to the row, as in :class:`StraightThrough`, and to its code, summed over the rows
    that have it. So codes follow their rows without refits, each of which costs up to half a dB of test PSNR for about
    fifty iterations, and training may end at any iteration.
    """

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None) -> Tensor:
        """The codes of the rows ``rows [V]`` of ``x [N, D]``; the gradient goes to both."""
        result: Tensor = _CopiedGradient.apply(x, self.codebook, codes, rows)  # type: ignore[no-untyped-call]
        return result


class _CopiedGradient(torch.autograd.Function):
    """Codes ``[V, D]`` whose gradient is also used as that of the rows ``[V]`` of ``x [N, D]``."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, codebook: Tensor, codes: Tensor, rows: Tensor | None) -> Tensor:
        ctx.save_for_backward(codes, rows)
        ctx.count, ctx.num_codes = x.shape[0], codebook.shape[0]
        return codebook.index_select(0, codes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor | None, None, None]:
        codes, rows = ctx.saved_tensors
        to_codebook = sum_by_code(grad, codes, ctx.num_codes) if ctx.needs_input_grad[1] else None
        return grad if rows is None else put_rows(grad, rows, ctx.count), to_codebook, None, None
