"""Noise substitution in vector quantization (NSVQ, Vali and Bäckström 2022), and its relative DiVeQ."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.rows import put_rows
from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.kmeans import sum_by_code
from nsvq_lightning.quantize.substitution import draw_seed, substitute, substitute_backward


class NSVQ(CodebookQuantizer):
    """Quantizer that replaces the quantization error by noise of the same length (paper, section 3.1).

    In training ``x_q = x + ‖x − c‖ · v / ‖v‖`` with c the nearest code and v ~ N(0, I), so gradients reach both the
    input and the code. Outside training, and once codes are frozen, ``x_q`` is the code itself.
    """

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None) -> Tensor:
        """Noise substitution of the rows ``rows [V]`` of ``x [N, D]`` whose nearest codes are ``codes [V]``."""
        return noise_substitution(x, self.codebook, codes, generator, rows)


def noise_substitution(
    x: Tensor,
    codebook: Tensor,
    codes: Tensor,
    generator: torch.Generator,
    rows: Tensor | None = None,
    *,
    aim: float = 0.0,
    spread: float = 1.0,
) -> Tensor:
    """``x + ‖x − c‖·d̂`` with c the code of each row; no gradient flows through d̂ = d/‖d‖.

    By default d = v ~ N(0, I); in general ``d = aim·(c − x) + spread·v``.

    The gradients have closed forms. With g the gradient of the result and r = x − c: that of x is g + (g·d̂) r/‖r‖,
    that of a code is −Σ (g·d̂) r/‖r‖ over its rows, always summed in the same order. The radial term is 0 where r is 0.

    Args:
        x: Table ``[N, D]``.
        codebook: Codes ``[K, D]``.
        codes: Code of each chosen row, ``[V]`` int64.
        generator: Source of the noise, on any device; one seed is drawn from it.
        rows: Rows ``[V]`` of the table, int64, ascending, distinct; all of them by default.
        aim: Weight of the residual c − x in the direction.
        spread: Weight of the noise in the direction.

    Returns:
        Rows ``[V, D]``, each at distance ‖x − c‖ from its row of ``x``.
    """
    mix = draw_seed(generator), aim, spread
    result: Tensor = _Substitution.apply(x, codebook, codes, rows, mix)  # type: ignore[no-untyped-call]
    return result


class _Substitution(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, codebook: Tensor, codes: Tensor, rows: Tensor | None, mix: tuple[int, float, float]
    ) -> Tensor:
        ctx.mix, ctx.kernels = mix, kernels_for(x)
        seed, aim, spread = mix
        if ctx.kernels is not None:
            rows = torch.arange(x.shape[0], device=x.device) if rows is None else rows
            inputs = x, rows, codebook, codes
        if ctx.kernels == "cpu":
            out = torch.from_numpy(substitute(seed, *_arrays(*inputs), aim=aim, spread=spread))
        elif ctx.kernels == "cuda":
            from nsvq_lightning.quantize.cuda.substitution import substitute as substitute_cuda

            out = substitute_cuda(seed, *_contiguous(*inputs), aim=aim, spread=spread)
        else:
            chosen = x if rows is None else x.index_select(0, rows)
            residual = chosen - codebook[codes]
            out = chosen + residual.norm(dim=1, keepdim=True) * _directions(residual, *mix)
        ctx.save_for_backward(x, codebook, codes, rows, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        x, codebook, codes, rows, out = ctx.saved_tensors
        if ctx.kernels == "cpu":
            grads = substitute_backward(*_arrays(grad, x, rows, codebook, codes, out))
            return torch.from_numpy(grads[0]), torch.from_numpy(grads[1]), None, None, None
        if ctx.kernels == "cuda":
            from nsvq_lightning.quantize.cuda.substitution import substitute_backward as backward_cuda

            return *backward_cuda(*_contiguous(grad, x, rows, codebook, codes, out)), None, None, None
        chosen = x if rows is None else x.index_select(0, rows)
        residual = chosen - codebook[codes]
        radial = (grad * _directions(residual, *ctx.mix)).sum(1, keepdim=True) * _unit(residual)
        grad_x = grad + radial
        if rows is not None:
            grad_x = put_rows(grad_x, rows, x.shape[0])
        return grad_x, -sum_by_code(radial, codes, codebook.shape[0]), None, None, None


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.numpy() for tensor in _contiguous(*tensors)]


def _contiguous(*tensors: Tensor) -> list[Tensor]:
    return [tensor.detach().contiguous() for tensor in tensors]


def _directions(residual: Tensor, seed: int, aim: float, spread: float) -> Tensor:
    """Unit direction vectors ``[V, D]`` for the residuals x − c."""
    generator = torch.Generator(residual.device).manual_seed(seed)
    noise = torch.randn(residual.shape, dtype=residual.dtype, device=residual.device, generator=generator)
    return _unit(spread * noise - aim * residual)


def _unit(vectors: Tensor) -> Tensor:
    """Rows scaled to length 1; zero rows stay 0."""
    length: Tensor = vectors.norm(dim=1, keepdim=True)
    return vectors / torch.where(length > 0, length, torch.inf)


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
