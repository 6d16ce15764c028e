"""Noise substitution in vector quantization (NSVQ, Vali and Bäckström 2022), and its relative DiVeQ."""

import math
from importlib import import_module
from typing import Any

import torch
from torch import Generator, Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.rows import put_rows
from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.kmeans import sum_by_code


class NSVQ(CodebookQuantizer):
    """Quantizer that replaces the quantization error by noise of the same length (paper, section 3.1).

    In training ``x_q = x + ‖x − c‖ · v / ‖v‖`` with c the nearest code and v ~ N(0, I), so gradients reach both the
    input and the code. Outside training, and once codes are frozen, ``x_q`` is the code itself.

    Attributes:
        aim: Weight of c − x in the direction, added to v.
        sigma: σ, the standard deviation of v.
    """

    aim, sigma = 0.0, 1.0

    def approximate(self, x: Tensor, codes: Tensor, generator: Generator, rows: Tensor | None) -> Tensor:
        """Noise substitution of the rows ``rows [V]`` of ``x [N, D]`` whose nearest codes are ``codes [V]``."""
        return noise_substitution(x, self.codebook, codes, generator, rows, aim=self.aim, spread=self.sigma)


def noise_substitution(
    x: Tensor,
    codebook: Tensor,
    codes: Tensor,
    generator: Generator,
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
    seed = int(torch.randint(0, 2**63 - 1, (), dtype=torch.int64, device=generator.device, generator=generator))
    rows = torch.arange(len(x), device=x.device) if rows is None else rows
    return _Substitution.apply(x, codebook, codes, rows, (seed, aim, spread))  # type: ignore[no-any-return, no-untyped-call]


class _Substitution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, codebook: Tensor, codes: Tensor, rows: Tensor, mix: Any) -> Tensor:
        ctx.mix, ctx.kernels = mix, _kernels(x)
        if ctx.kernels is None:
            chosen = x.index_select(0, rows)
            residual = chosen - codebook[codes]
            out: Tensor = chosen + residual.norm(dim=1, keepdim=True) * _directions(residual, *mix)
        else:
            seed, aim, spread = mix
            inputs = (tensor.contiguous() for tensor in (x, rows, codebook, codes))
            out = ctx.kernels.substitute(seed, *inputs, aim=aim, spread=spread)
        ctx.save_for_backward(x, rows, codebook, codes, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        x, rows, codebook, codes, out = ctx.saved_tensors
        if ctx.kernels is None:
            residual = x.index_select(0, rows) - codebook[codes]
            radial = (grad * _directions(residual, *ctx.mix)).sum(1, keepdim=True) * _unit(residual)
            grad_x = put_rows(grad + radial, rows, len(x))
            grad_codebook = -sum_by_code(radial, codes, len(codebook))
        else:
            inputs = (tensor.contiguous() for tensor in (grad, x, rows, codebook, codes, out))
            grad_x, grad_codebook = ctx.kernels.substitute_backward(*inputs)
        return grad_x, grad_codebook, None, None, None


def _kernels(like: Tensor) -> Any:
    """The module whose kernels take a tensor, or None."""
    kernels = kernels_for(like)
    homes = {"cpu": "substitution", "cuda": "cuda.substitution"}
    return import_module(f"{__package__}.{homes[kernels]}") if kernels else None


def _directions(residual: Tensor, seed: int, aim: float, spread: float) -> Tensor:
    """Unit direction vectors ``[V, D]`` for the residuals x − c."""
    generator = Generator(residual.device).manual_seed(seed)
    noise = torch.randn(residual.shape, dtype=residual.dtype, device=residual.device, generator=generator)
    return _unit(spread * noise - aim * residual)


def _unit(vectors: Tensor) -> Tensor:
    """Rows scaled to length 1; zero rows stay 0."""
    return torch.nn.functional.normalize(vectors, eps=torch.finfo(vectors.dtype).tiny)


class DiVeQ(NSVQ):
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

    aim = 1.0

    def __init__(self, num_codes: int, dim: int, *, sigma: float = 1e-3, **settings: Any) -> None:
        super().__init__(num_codes, dim, **settings)
        if not 0 <= sigma < math.inf:
            raise ValueError(f"sigma must be finite and at least 0, got {sigma}")
        self.sigma = sigma
