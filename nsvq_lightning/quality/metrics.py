"""Image quality as the published tables measure it: PSNR, SSIM, LPIPS; and after colour correction.

Rendered images are rounded to 8 bit first (:func:`eight_bit`), as if read back from a PNG. SSIM is that of the loss,
:func:`nsvq_lightning.quality.loss.ssim`. The figure of a scene is the mean over its images.
"""

import torch
from torch import Tensor, nn

from nsvq_lightning.quality.formulas import check_pair
from nsvq_lightning.quality.loss import apply_mask, mean_of_kept


def color_corrected(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """The image with the quadratic map of its colours that brings it nearest to the photo.

    This is the usual correction before metrics where photos differ in exposure (Mildenhall et al. 2022; NerfBaselines
    and gsplat report it as ``cc_psnr``): each channel becomes a polynomial of degree two in all three, by least squares
    over the pixels that neither picture clips, nor its last estimate, five times over, each time clamped to [0, 1].

    Args:
        image: ``[H, W, 3]`` in [0, 1].
        photo: ``[H, W, 3]`` in [0, 1].
        mask: Which pixels count ``[H, W]`` bool; None if all do. The others are corrected, too.

    Returns:
        ``[H, W, 3]`` in [0, 1], of the image's dtype.
    """
    colors, target = (each.reshape(-1, 3).T.contiguous().double() for each in (image, photo))  # a row a channel
    counting = torch.ones_like(colors[0], dtype=torch.bool) if mask is None else mask.ravel()
    dark, bright = 0.5 / 255, 1 - 0.5 / 255  # beyond these, a pixel is clipped and says nothing about the map
    seen = counting & (target >= dark) & (target <= bright) & (colors >= dark) & (colors <= bright)
    parts = [slice(start, start + AT_ONCE) for start in range(0, len(counting), AT_ONCE)]
    for _ in range(5):
        normal = colors.new_zeros(3, TERMS, TERMS)
        moment = colors.new_zeros(3, TERMS, 1)
        for part in parts:
            some = colors[:, part]
            terms = _terms(some)
            weighted = terms * (seen[:, part] & (some >= dark) & (some <= bright))[:, None]  # [channel, term, pixels]
            normal += weighted @ terms.T
            moment += weighted @ target[:, part, None]
        # A picture of few colours leaves coefficients open; the pseudo-inverse takes the smallest.
        weights = (torch.linalg.pinv(normal, hermitian=True) @ moment)[..., 0]
        corrected = torch.cat([weights @ _terms(colors[:, part]) for part in parts], 1)
        colors = torch.where(normal[:, -1, -1:] > 0, corrected, colors).clamp(0, 1)
    return colors.T.contiguous().reshape(image.shape).to(image.dtype)


# Terms of a polynomial of degree two in three colours, the constant last; pixels that fit the caches of a processor.
TERMS = 10
AT_ONCE = 1 << 14


def _terms(colors: Tensor) -> Tensor:
    """The terms ``[10, N]`` of colours ``[3, N]``."""
    first, second = torch.triu_indices(3, 3)  # each pair of channels once
    return torch.cat([colors[first] * colors[second], colors, torch.ones_like(colors[:1])])


def eight_bit(image: Tensor) -> Tensor:
    """A float image ``[H, W, 3]`` clamped to [0, 1] and rounded to multiples of 1/255; uint8 is only rescaled."""
    if image.dtype == torch.uint8:
        return image.float() / 255
    return image.clamp(0.0, 1.0).mul_(255).round_().div_(255)


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Peak signal-to-noise ratio in dB from the squared error pooled over pixels and RGB.

    PSNR = -10 · log10(mean((image - target)²)), summed in float64; equal images give infinity.

    Args:
        image: ``[H, W, 3]`` in [0, 1].
        target: ``[H, W, 3]``, uint8 or in [0, 1].
        mask: Which pixels count ``[H, W]`` bool; None if all do.

    Raises:
        ValueError: The shapes differ, or the image is none of floats.
    """
    check_pair(image, target, mask)
    if target.dtype == torch.uint8:
        target = eight_bit(target)
    # The norm sums in float64 without making a float64 copy of the images.
    error = torch.linalg.vector_norm(apply_mask(image - target, mask), dtype=torch.float64)
    return -10.0 * torch.log10(mean_of_kept(error.square() / image.numel(), mask))


def build_lpips() -> tuple[nn.Module | None, str | None]:
    """LPIPS with VGG features as the tables of 3D Gaussian splatting compute it: images in [0, 1], not rescaled.

    Returns:
        The metric (images ``[1, 3, H, W]``) and None, or None and the reason why it is not available here.
    """
    obstacle = "needs torchvision (pip install 'nsvq-lightning[lpips]')"
    try:
        import torchvision  # noqa: F401
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        obstacle = "could not load the VGG-16 weights (a download of 528 MB)"
        return LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=False), None
    except (ImportError, RuntimeError, OSError) as error:
        first, *_ = str(error).splitlines() or [type(error).__name__]
        return None, f"LPIPS {obstacle}: {first}"
