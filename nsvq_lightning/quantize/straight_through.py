"""Straight-through vector quantization with a codebook from k-means, the quantizer of CompGS."""

from __future__ import annotations

import torch
from torch import Tensor

from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.random import generator as seeded
from nsvq_lightning.subset import take_rows

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
        chosen = x if rows is None else take_rows(x, rows)
        return self.codebook.detach().index_select(0, codes) + (chosen - chosen.detach())

    @torch.no_grad()
    def refit(self, x: Tensor, steps: int) -> None:
        """Move the codebook to the rows ``x [N, D]`` by ``steps`` Lloyd steps from where it is; K stays."""
        start = self.codebook.detach()
        # With a start k-means draws nothing, whatever the generator.
        self.codebook.copy_(kmeans(x, self.num_codes, seeded(0), steps=steps, start=start))
