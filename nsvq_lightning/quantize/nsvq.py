"""Noise substitution in vector quantization (NSVQ, Vali and Bäckström 2022), the paper's quantizer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.noise import draw_seed
from nsvq_lightning.quantize.substitution import substitute, substitute_backward
from nsvq_lightning.quantize.sums import sum_by_code

__all__ = ["NSVQ", "noise_substitution"]


class NSVQ(CodebookQuantizer):
    """Quantizer that replaces the quantization error by noise of the same length (paper, section 3.1).

    In training ``x_q = x + ‖x − c‖ · v / ‖v‖`` with c the nearest code and v ~ N(0, I), so gradients reach both the
    input and the code. Outside training, and once codes are frozen, ``x_q`` is the code itself.
    """

    def approximate(self, x: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None) -> Tensor:
        """Noise substitution of the rows ``rows [V]`` of ``x [N, D]`` whose nearest codes are ``codes [V]``."""
        return noise_substitution(x, self.codebook, codes, generator, rows)


def noise_substitution(
    x: Tensor, codebook: Tensor, codes: Tensor, generator: torch.Generator, rows: Tensor | None = None
) -> Tensor:
    """``x + ‖x − c‖·v/‖v‖`` with c the code of each row and v ~ N(0, I).

    The gradients are closed forms. With g the gradient of the result, v̂ = v/‖v‖ and r = x − c: that of x is
    g + (g·v̂) r/‖r‖, that of a code is −Σ (g·v̂) r/‖r‖ over its rows, always summed in the same order. The radial term
    is 0 where r is 0.

    Args:
        x: Table ``[N, D]``.
        codebook: Codes ``[K, D]``.
        codes: Code of each chosen row, ``[V]`` int64.
        generator: Source of the noise, on any device; one seed is drawn from it.
        rows: Rows ``[V]`` of the table, int64, ascending, all different; all of them by default.

    Returns:
        Rows ``[V, D]`` at the distance ‖x − c‖ from those of ``x``.
    """
    seed = draw_seed(generator)
    result: Tensor = _NoiseSubstitution.apply(x, codebook, codes, rows, seed)  # type: ignore[no-untyped-call]
    return result


class _NoiseSubstitution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, codebook: Tensor, codes: Tensor, rows: Tensor | None, seed: int) -> Tensor:
        ctx.seed = seed
        if _has_kernel(x):
            rows = torch.arange(x.shape[0]) if rows is None else rows
            out = torch.from_numpy(substitute(seed, *_arrays(x, rows, codebook, codes)))
        else:
            chosen = x if rows is None else x.index_select(0, rows)
            length: Tensor = (chosen - codebook[codes]).norm(dim=1, keepdim=True)
            out = chosen + length * _directions(chosen, seed)
        ctx.save_for_backward(x, codebook, codes, rows, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        x, codebook, codes, rows, out = ctx.saved_tensors
        if _has_kernel(x):
            grads = substitute_backward(*_arrays(grad, x, rows, codebook, codes, out))
            return torch.from_numpy(grads[0]), torch.from_numpy(grads[1]), None, None, None
        chosen = x if rows is None else x.index_select(0, rows)
        residual = chosen - codebook[codes]
        length = residual.norm(dim=1, keepdim=True)
        along = (grad * _directions(chosen, ctx.seed)).sum(1, keepdim=True) / torch.where(length > 0, length, torch.inf)
        radial = along * residual
        grad_x = grad + radial
        if rows is not None:
            grad_x = torch.zeros_like(x).index_copy_(0, rows, grad_x)
        return grad_x, -sum_by_code(radial, codes, codebook.shape[0]), None, None, None


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def _has_kernel(x: Tensor) -> bool:
    return x.device.type == "cpu" and x.dtype == torch.float32


def _directions(x: Tensor, seed: int) -> Tensor:
    """Random unit vectors in the shape of ``x [N, D]``."""
    generator = torch.Generator(x.device).manual_seed(seed)
    noise = torch.randn(x.shape, dtype=x.dtype, device=x.device, generator=generator)
    length = noise.norm(dim=1, keepdim=True)
    return noise / torch.where(length > 0, length, torch.inf)
