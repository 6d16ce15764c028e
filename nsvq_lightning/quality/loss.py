"""The photometric loss: (1 - λ)·L1 + λ·(1 - SSIM) (Kerbl et al. 2023, eq. 7), without the pixels that do not count.

No loss and no metric depends on masked pixels. Both pictures are black there, as the structural similarity takes them
to be beyond their borders, and means are over the pixels that count.
"""

from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.quality.formulas import check_pair, in_range, plain_ssim


def apply_mask(image: Tensor, mask: Tensor | None) -> Tensor:
    """An image ``[H, W, 3]`` that is 0 where its mask ``[H, W]`` is; itself without a mask."""
    return image if mask is None else image * mask[..., None]


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
    if kernels == "cpu":
        from nsvq_lightning.quality.ssim_cpu import l1_dssim

        return image.new_tensor(1 - l1_dssim(image.contiguous(), target.contiguous(), 1.0)[0])
    if kernels == "cuda":
        from nsvq_lightning.quality.ssim_cuda import l1_dssim as l1_dssim_cuda

        return 1 - l1_dssim_cuda(image.contiguous(), target.contiguous(), 1.0, derived=False)[0]
    return plain_ssim(*in_range(image, target))


def photometric_loss(image: Tensor, target: Tensor, dssim_weight: float = 0.2, mask: Tensor | None = None) -> Tensor:
    """(1 - λ)·mean abs(image - target) + λ·(1 - SSIM), differentiable in ``image``, which is clamped to [0, 1] first.

    float32 images take fused kernels for clamping, loss and gradient; everything else is plain torch.

    Args:
        image: Rendered ``[H, W, 3]``; values outside [0, 1] get no gradient.
        target: Photo ``[H, W, 3]``, uint8 or in [0, 1].
        dssim_weight: λ in [0, 1].
        mask: Which pixels count ``[H, W]`` bool, see :mod:`nsvq_lightning.quality.loss`; None if all do.

    Raises:
        ValueError: The shapes differ.
    """
    check_pair(image, target, mask)
    if mask is not None:
        return mean_of_kept(photometric_loss(apply_mask(image, mask), apply_mask(target, mask), dssim_weight), mask)
    kernels = _kernels(image, target)
    if kernels is not None:
        function = _CpuLoss if kernels == "cpu" else _CudaLoss
        loss: Tensor = function.apply(image, target, dssim_weight)  # type: ignore[no-untyped-call]
        return loss
    return plain_loss(image, target, dssim_weight)


def plain_loss(image: Tensor, target: Tensor, dssim_weight: float) -> Tensor:
    """The loss of images ``[H, W, 3]`` in plain torch, in the type of the first one."""
    image, target = in_range(image, target)
    return (1 - dssim_weight) * (image - target).abs().mean() + dssim_weight * (1 - plain_ssim(image, target))


def _kernels(image: Tensor, target: Tensor) -> Literal["cpu", "cuda"] | None:
    """Which fused kernels can take the images; the CPU kernels need rows of at least one vector."""
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
        # With one view per step the scale is 1, and skipping a pass over the image pays.
        return gradient if scale == 1 else gradient * scale, None, None


class _CudaLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, dssim_weight: float) -> Tensor:
        from nsvq_lightning.quality.ssim_cuda import l1_dssim

        image, target = image.contiguous(), target.contiguous()
        loss, derivatives = l1_dssim(image, target, dssim_weight, derived=ctx.needs_input_grad[0])
        ctx.dssim_weight = dssim_weight
        ctx.save_for_backward(image, target, derivatives)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor, None, None]:
        from nsvq_lightning.quality.ssim_cuda import l1_dssim_backward

        image, target, derivatives = ctx.saved_tensors
        return l1_dssim_backward(image, target, ctx.dssim_weight, derivatives, scale), None, None
