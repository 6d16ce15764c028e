"""The photometric loss: (1 - λ)·L1 + λ·(1 - SSIM) (Kerbl et al. 2023, eq. 7)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from nsvq_lightning.compute.devices import kernels_for

__all__ = ["SSIM_C1", "SSIM_C2", "SSIM_RADIUS", "check_pair", "photometric_loss", "ssim", "ssim_window"]

SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def ssim_window() -> Tensor:
    """The 11 taps of the Gaussian window with σ = 1.5, summing to 1; float64."""
    offsets = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64)
    taps = torch.exp(-offsets.square() / (2 * SSIM_SIGMA**2))
    return taps / taps.sum()


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity as the splatting papers measure it: Gaussian window, σ 1.5, zero padding, mean over RGB.

    Args:
        image: ``[H, W, 3]``, clamped to [0, 1].
        target: ``[H, W, 3]``, uint8 or in [0, 1].

    Returns:
        Scalar, 1 for equal images (Wang et al. 2004, eq. 13; beyond the border the images count as 0).

    Raises:
        ValueError: The shapes differ.
    """
    check_pair(image, target)
    kernels = None if torch.is_grad_enabled() and image.requires_grad else _kernels(image, target)
    if kernels == "cpu":
        from nsvq_lightning.quality.ssim_cpu import l1_dssim

        return image.new_tensor(1 - l1_dssim(image.contiguous(), target.contiguous(), 1.0)[0])
    if kernels == "cuda":
        from nsvq_lightning.quality.ssim_cuda import l1_dssim as l1_dssim_cuda

        return 1 - l1_dssim_cuda(image.contiguous(), target.contiguous(), 1.0, derived=False)[0]
    image, target = _in_range(image, target)
    planes = torch.cat([image, target, image * image, target * target, image * target], -1).movedim(-1, 0)[None]
    channels = planes.shape[1]
    taps = ssim_window().to(image).expand(channels, 1, -1)
    planes = functional.conv2d(planes, taps[..., None], padding=(SSIM_RADIUS, 0), groups=channels)
    planes = functional.conv2d(planes, taps[:, :, None], padding=(0, SSIM_RADIUS), groups=channels)
    mean_x, mean_y, square_x, square_y, product = planes[0].chunk(5)
    variance_x, variance_y = square_x - mean_x**2, square_y - mean_y**2
    covariance = product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_x + variance_y + SSIM_C2)
    return (luminance * structure).mean()


def photometric_loss(image: Tensor, target: Tensor, dssim_weight: float = 0.2) -> Tensor:
    """(1 - λ)·mean |image - target| + λ·(1 - SSIM), differentiable in ``image``, which is clamped to [0, 1] first.

    float32 images take fused kernels for clamping, loss and gradient; everything else is plain torch.

    Args:
        image: Rendered ``[H, W, 3]``; values outside [0, 1] get no gradient.
        target: Photo ``[H, W, 3]``, uint8 or in [0, 1].
        dssim_weight: λ in [0, 1].

    Raises:
        ValueError: The shapes differ.
    """
    check_pair(image, target)
    kernels = _kernels(image, target)
    if kernels is not None:
        function = _CpuLoss if kernels == "cpu" else _CudaLoss
        loss: Tensor = function.apply(image, target, dssim_weight)  # type: ignore[no-untyped-call]
        return loss
    image, target = _in_range(image, target)
    return (1 - dssim_weight) * (image - target).abs().mean() + dssim_weight * (1 - ssim(image, target))


def check_pair(image: Tensor, target: Tensor) -> None:
    """Refuse pictures that cannot be compared.

    Raises:
        ValueError: They are not both ``[H, W, 3]``.
    """
    if image.shape != target.shape or image.dim() != 3 or image.shape[-1] != 3:
        raise ValueError(f"image and target must both be [H, W, 3], got {list(image.shape)} and {list(target.shape)}")


def _in_range(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    return image.clamp(0.0, 1.0), target.to(image.dtype) / 255 if target.dtype == torch.uint8 else target


def _kernels(image: Tensor, target: Tensor) -> Literal["cpu", "cuda"] | None:
    """Whose fused kernels can take the images; those of the CPU need rows of at least one vector."""
    kernels = kernels_for(image)
    fits = target.dtype in (torch.float32, torch.uint8) and not target.requires_grad and target.device == image.device
    wide = 3 * image.shape[1] >= 16 if kernels == "cpu" else image.numel() > 0
    return kernels if fits and wide else None


class _CpuLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, dssim_weight: float) -> Tensor:
        from nsvq_lightning.quality.ssim_cpu import l1_dssim

        loss, gradient = l1_dssim(image.detach().contiguous(), target.contiguous(), dssim_weight)
        ctx.save_for_backward(gradient)
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        # One view a step leaves the loss as it is, and a pass over the image is worth sparing.
        return gradient if scale == 1 else gradient * scale, None, None


class _CudaLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, dssim_weight: float) -> Tensor:
        from nsvq_lightning.quality.ssim_cuda import l1_dssim

        image, target = image.contiguous(), target.contiguous()
        loss, ctx.derivatives = l1_dssim(image, target, dssim_weight, derived=ctx.needs_input_grad[0])
        ctx.save_for_backward(image, target)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor, None, None]:
        from nsvq_lightning.quality.ssim_cuda import l1_dssim_backward

        image, target = ctx.saved_tensors
        return l1_dssim_backward(image, target, ctx.derivatives, scale), None, None
