"""Score rendered views against their photos."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.data.scene import View
from nsvq_lightning.quality.loss import apply_mask
from nsvq_lightning.quality.metrics import image_metrics
from nsvq_lightning.rendering.camera import Camera


@dataclass(frozen=True)
class ViewScore:
    """Quality of one view: PSNR in dB, SSIM, LPIPS where it was measured.

    ``cc_psnr`` and ``cc_ssim`` are those after a colour correction to the photo, where that was measured.
    """

    name: str
    psnr: float
    ssim: float
    lpips: float | None = None
    cc_psnr: float | None = None
    cc_ssim: float | None = None


class Quality(NamedTuple):
    """Mean quality over the views of all processes."""

    psnr: float
    ssim: float


@torch.no_grad()
def evaluate(
    render_image: Callable[[Camera], Tensor],
    views: Iterable[View],
    device: torch.device,
    show: Callable[[Tensor, Tensor], None] | None = None,
) -> Quality:
    """Render every view and compare it with its photo.

    Args:
        render_image: Image ``[H, W, 3]`` of a camera.
        views: What to compare with.
        device: Where the splats are.
        show: Called with the first image and its photo.

    Raises:
        ValueError: There are no views.
    """
    metrics, shown = image_metrics().to(device), False
    for view in views:
        photo = view.to(device)
        image = apply_mask(render_image(photo.camera), photo.mask)
        if show is not None and not shown:
            show(image, photo.image)
        shown = True
        metrics.update(image, photo.image, photo.mask)
    if not shown:
        raise ValueError("there are no views to evaluate; the scene needs at least one test view")
    mean = metrics.compute()
    return Quality(float(mean["psnr"]), float(mean["ssim"]))
