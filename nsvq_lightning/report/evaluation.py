"""Score rendered views against their photos."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nsvq_lightning.data.scene import View
from nsvq_lightning.quality.loss import apply_mask
from nsvq_lightning.quality.metrics import image_metrics
from nsvq_lightning.rendering.camera import Camera

__all__ = ["Quality", "ViewScore", "evaluate"]


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


@dataclass(frozen=True)
class Quality:
    """Mean quality over the views of all processes; ``views`` are those of this process."""

    psnr: float
    ssim: float
    views: list[ViewScore] = field(default_factory=list)


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
    metrics = image_metrics().to(device)
    scores: list[ViewScore] = []
    for view in views:
        on_device = view.to(device)
        image = apply_mask(render_image(on_device.camera), on_device.mask)
        if show is not None and not scores:
            show(image, on_device.image)
        values = metrics(image, on_device.image, on_device.mask)
        scores.append(ViewScore(view.name, float(values["psnr"]), float(values["ssim"])))
    if not scores:
        raise ValueError("there are no views to evaluate; the scene needs at least one test view")
    mean = metrics.compute()
    return Quality(float(mean["psnr"]), float(mean["ssim"]), scores)
