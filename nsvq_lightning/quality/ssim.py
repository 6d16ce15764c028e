"""Structural similarity (Wang et al. 2004): its window and constants, and the index itself in plain torch."""

import torch
from torch import Tensor
from torch.nn import functional

SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def ssim_window() -> Tensor:
    """The 11 taps of the Gaussian window with σ = 1.5, summing to 1; float64."""
    offsets = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64)
    taps = torch.exp(-offsets.square() / (2 * SSIM_SIGMA**2))
    return taps / taps.sum()


def check_pair(image: Tensor, target: Tensor, mask: Tensor | None = None) -> None:
    """Refuse pictures that cannot be compared.

    Raises:
        ValueError: They are not both ``[H, W, 3]``, or the mask is not ``[H, W]``.
    """
    if image.shape != target.shape or image.dim() != 3 or image.shape[-1] != 3:
        raise ValueError(f"image and target must both be [H, W, 3], got {list(image.shape)} and {list(target.shape)}")
    if mask is not None and mask.shape != image.shape[:2]:
        raise ValueError(f"the mask of images {list(image.shape)} must be [H, W], got {list(mask.shape)}")


def in_range(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Two pictures as floats: the rendered one clamped to [0, 1], the other scaled to [0, 1] if it is uint8."""
    # Not the gradient of clamp, which at 0 and 1 themselves is 1 before torch 2.14 and 0 from there on.
    inside = torch.where((image < 0) | (image > 1), image.detach().clamp(0.0, 1.0), image)
    return inside, target.to(image.dtype) / 255 if target.dtype == torch.uint8 else target


def plain_ssim(image: Tensor, target: Tensor) -> Tensor:
    """SSIM of two float pictures ``[H, W, 3]``, a scalar: the mean over pixels and RGB, with zero padding."""
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
