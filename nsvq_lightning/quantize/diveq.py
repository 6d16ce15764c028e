"""Differentiable vector quantization (DiVeQ, Vali, Bäckström and Solin 2025)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.nsvq import noise_substitution

__all__ = ["DiVeQ"]


class DiVeQ(CodebookQuantizer):
    """Quantizer that moves the input by the length of the error, approximately towards the code.

    In training ``x_q = x + ‖c − x‖ · sg(d / ‖d‖)`` with ``d = (c − x) + v`` and v ~ N(0, σ²I), c the nearest code and
    sg the stop-gradient operator ("DiVeQ: Differentiable Vector Quantization Using the Reparameterization Trick",
    arXiv:2509.26469). With a small σ the result is nearly c, so training sees what is stored. With g its gradient and
    d̂ = d/‖d‖ ≈ (c − x)/‖c − x‖ a code gets Σ (g·d̂) d̂ over its rows, a true gradient along the errors, where that of
    NSVQ is 0 on average; x gets the rest, g − (g·d̂) d̂. In the limit of a large σ it is NSVQ.

    Args:
        num_codes: Codes K, at least 1.
        dim: Dimension D of a row.
        sigma: σ, in units of the attribute's raw space; keep it small compared with the quantization errors, which are
            a few hundredths there.
        **settings: Those of :class:`CodebookQuantizer`.

    Raises:
        ValueError: An argument is out of range.
    """

    def __init__(self, num_codes: int, dim: int, *, sigma: float = 1e-3, **settings: Any) -> None:
        super().__init__(num_codes, dim, **settings)
        if not (math.isfinite(sigma) and sigma >= 0):
            raise ValueError(f"sigma must be finite and at least 0, got {sigma}")
        self.sigma = sigma

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None) -> Tensor:
        """Rows ``rows [V]`` of ``x [N, D]``, moved approximately to their codes."""
        return noise_substitution(x, self.codebook, codes, generator, rows, aim=1.0, spread=self.sigma)
