"""The photometric loss: (1 - λ)·L1 + λ·(1 - SSIM) (Kerbl et al. 2023, eq. 7), without the pixels that do not count.

In place of L1 it can have a multiple of -PSNR, the logarithm of the mean squared error, which pictures are measured by.
As that of a photo is relative to its own error, those that splats can show well count as much as the others.

No loss and no metric depends on masked pixels. Both pictures are black there, as the structural similarity takes them
to be beyond their borders, and means are over the pixels that count.
"""

from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.quality.formulas import LOG_WEIGHT, MIN_ERROR, check_pair, in_range, plain_ssim


def apply_mask(image: Tensor, mask: Tensor | None) -> Tensor:
    """An image ``[H, W, 3]`` that is 0 where its mask ``[H, W]`` is; itself without a mask."""
    return image if mask is None else image.where(mask[..., None], 0)


def mean_of_kept(mean: Tensor, mask: Tensor | None) -> Tensor:
    """The mean over the pixels that count, from the mean over all pixels of something that is 0 elsewhere."""
    return mean if mask is None else mean * (mask.numel() / mask.sum())


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Structural similarity as the splatting papers measure it: Gaussian window, σ 1.5, zero padding, mean over RGB.

    Args:
        image: ``[H, W, 3]``, clamped to [0, 1].
        target: ``[H, W, 3]``, uint8 or in [0, 1].
        mask: Which pixels count ``[H, W]`` bool, see :mod:`nsvq_lightning.quality.loss`; None if all do.

    Returns:
        Scalar, 1 for equal images (Wang et al. 2004, eq. 13; beyond the border the images count as 0).

    Raises:
        ValueError: The shapes differ.
    """
    check_pair(image, target, mask)
    if mask is not None:
        return 1 - mean_of_kept(1 - ssim(apply_mask(image, mask), apply_mask(target, mask)), mask)
    kernels = None if torch.is_grad_enabled() and image.requires_grad else _kernels(image, target)
    if kernels:
        loss: Tensor = kernels.fused_loss(image.contiguous(), target.contiguous(), 1.0, derived=False)[0]
        return (1 - loss).to(image)
    return plain_ssim(*in_range(image, target))


def photometric_loss(
    image: Tensor, target: Tensor, dssim_weight: float = 0.2, mask: Tensor | None = None, *, psnr: bool = False
) -> Tensor:
    """(1 - λ)·mean abs(image - target) + λ·(1 - SSIM), differentiable in ``image``, which is clamped to [0, 1] first.

    With ``psnr``, 0.016·ln(mean square(image - target) + 1e-5) takes the place of the mean absolute difference.

    float32 images take fused kernels for clamping, loss and gradient; everything else is plain torch.

    Args:
        image: Rendered ``[H, W, 3]``; values outside [0, 1] get no gradient.
        target: Photo ``[H, W, 3]``, uint8 or in [0, 1].
        dssim_weight: λ in [0, 1].
        mask: Which pixels count ``[H, W]`` bool, see :mod:`nsvq_lightning.quality.loss`; None if all do.
        psnr: Whether to train for PSNR instead of L1.

    Raises:
        ValueError: The shapes differ, or the mask is not bool.
    """
    check_pair(image, target, mask)
    if mask is not None:
        masked = apply_mask(image, mask), apply_mask(target, mask)
        if not psnr:
            return mean_of_kept(photometric_loss(*masked, dssim_weight), mask)
        # Only 1 - SSIM is a mean over the pixels; the logarithm of one has the same slope over all of them.
        scaled = dssim_weight / max(float(mask.float().mean()), MIN_ERROR)
        total = scaled + 1 - dssim_weight
        return total * photometric_loss(*masked, scaled / total, psnr=True)
    if kernels := _kernels(image, target):
        return _Loss.apply(image, target, dssim_weight, psnr, kernels)  # type: ignore[no-any-return, no-untyped-call]
    return plain_loss(image, target, dssim_weight, psnr=psnr)


def plain_loss(image: Tensor, target: Tensor, dssim_weight: float, *, psnr: bool = False) -> Tensor:
    """The loss of images ``[H, W, 3]`` in plain torch, in the type of the first one."""
    image, target = in_range(image, target)
    difference = image - target
    error = LOG_WEIGHT * (difference.square().mean() + MIN_ERROR).log() if psnr else difference.abs().mean()
    return (1 - dssim_weight) * error + dssim_weight * (1 - plain_ssim(image, target))


def _kernels(image: Tensor, target: Tensor) -> Any:
    """The module of fused kernels that can take the images, or None; those of the CPU need rows of a vector or more."""
    kernels = kernels_for(image)
    fits = target.dtype in (torch.float32, torch.uint8) and not target.requires_grad and target.device == image.device
    wide = 3 * image.shape[1] >= 16 if kernels == "cpu" else image.numel() > 0
    return import_module(f"{__package__}.ssim_{kernels}") if kernels and fits and wide else None


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, dssim_weight: float, psnr: bool, kernels: Any) -> Tensor:
        image, target = image.contiguous(), target.contiguous()
        loss, *saved = kernels.fused_loss(image, target, dssim_weight, psnr=psnr, derived=ctx.needs_input_grad[0])
        ctx.kernels = kernels
        ctx.save_for_backward(image, target, *saved)
        return loss.to(image)  # type: ignore[no-any-return]  # of modules that are found by their name

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor, None, None, None, None]:
        return ctx.kernels.fused_loss_backward(*ctx.saved_tensors, scale), None, None, None, None
