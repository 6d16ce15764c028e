"""What the losses are: in plain torch, which is their definition, and for kernels.

The algebra of kernels is the same code on a CPU and on a GPU (:mod:`nsvq_lightning.compute.formulas`). There, p is the
image, q the target, in [0, 1]. Their *moments* are p, q, p² + q² and p·q.
"""

import torch
from torch import Tensor
from torch.nn import functional

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline

# Structural similarity (Wang et al. 2004): its window, and its constants.
SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
# Where the loss is for PSNR: weight of the logarithm of the mean squared error, 0.0037 for a decibel; and what is added
# to that error, as nobody sees what is beyond 50 dB.
LOG_WEIGHT, MIN_ERROR = 0.016, 1e-5
C1, C2 = F(SSIM_C1), F(SSIM_C2)
# Planes of the moments; of the derivatives of SSIM by three of them, blurred p, p² and p·q.
MOMENTS, DERIVATIVES = 4, 3


@inline
def clamped(raw):
    """The image clamped to [0, 1]; not by minimum and maximum, since NaN must stay NaN."""
    return simd.where(raw < 0, 0.0, simd.where(raw > 1, 1.0, raw))


@inline
def moments(tap, p, q):
    """The moments of the middle row, times its tap."""
    return tap * p, tap * q, tap * simd.fma(p, p, q * q), tap * (p * q)


@inline
def add_moments(sums, tap, p, q, r, s):
    """Add the moments of two rows that share a tap: (p, q) above and (r, s) below."""
    return (
        simd.fma(tap, p + r, sums[0]),
        simd.fma(tap, q + s, sums[1]),
        simd.fma(tap, simd.fma(p, p, r * r) + simd.fma(q, q, s * s), sums[2]),
        simd.fma(tap, simd.fma(p, q, r * s), sums[3]),
    )


@inline
def similarity(m1, m2, squares, product):
    """SSIM from the blurred moments, and its derivatives with respect to blurred p, p² and p·q."""
    m12 = m1 * m2
    means = simd.fma(m1, m1, m2 * m2)
    variances = squares - means
    covariance = product - m12
    a = simd.fma(2.0, m12, C1)
    d = simd.fma(2.0, covariance, C2)
    e = means + C1
    f = variances + C2
    ef = 1 / (e * f)
    e, f = f * ef, e * ef
    value = a * d * ef
    by_product = 2 * a * ef
    by_square = -(value * f)
    by_mean = 2 * (m2 * d * ef - m1 * value * e - m1 * by_square) - m2 * by_product
    return value, (by_mean, by_square, by_product)


@inline
def pixel_gradient(raw, p, q, derivatives, steps):
    """Gradient of the loss, 0 where the image was clamped, from the blurred derivatives of SSIM.

    ``steps`` are the weights of the sums of absolute differences, of half the squared differences, and of SSIM.
    """
    l1_step, l2_step, ssim_step = steps
    by_mean, by_square, by_product = derivatives
    g = simd.fma(q, by_product, simd.fma(2 * p, by_square, by_mean))
    sign = simd.where(p > q, l1_step, simd.where(p < q, -l1_step, 0.0))
    slope = simd.fma(l2_step, p - q, sign)
    return simd.where((raw >= 0) & (raw <= 1), simd.fma(-ssim_step, g, slope), 0.0)


def ssim_window() -> Tensor:
    """The 11 taps of the Gaussian window with σ = 1.5, summing to 1; float64."""
    taps = torch.exp(-torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64).square() / (2 * SSIM_SIGMA**2))
    return taps / taps.sum()


def check_pair(image: Tensor, target: Tensor, mask: Tensor | None = None) -> None:
    """Refuse pictures that cannot be compared.

    Raises:
        ValueError: They are not both ``[H, W, 3]``, the image is none of floats, the target none of floats or bytes,
            or the mask is not ``[H, W]`` bool.
    """
    if image.shape != target.shape or image.dim() != 3 or image.shape[-1] != 3:
        raise ValueError(f"image and target must both be [H, W, 3], got {list(image.shape)} and {list(target.shape)}")
    if not (image.is_floating_point() and (target.is_floating_point() or target.dtype == torch.uint8)):
        types = f"{image.dtype}; only the target may be of bytes, got {target.dtype}"
        raise ValueError(f"the image must be of floats in [0, 1], got {types}")
    if mask is not None and (mask.shape, mask.dtype) != (image.shape[:2], torch.bool):
        raise ValueError(f"masks of {list(image.shape)} must be [H, W], got {list(mask.shape)}, and bool: {mask.dtype}")


def in_range(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Two pictures of one float type: the rendered one clamped to [0, 1], the other scaled to [0, 1] if it is uint8."""
    # Not the gradient of clamp, which at 0 and 1 themselves is 1 before torch 2.14 and 0 from there on.
    inside = torch.where((image < 0) | (image > 1), image.detach().clamp(0.0, 1.0), image)
    return inside, target.to(image.dtype) / (255 if target.dtype == torch.uint8 else 1)


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
