"""Find the splats that the photos speak against: floaters."""

import logging
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from nsvq_lightning.data.scene import View
from nsvq_lightning.quality.loss import apply_mask
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import ALPHA_MAX
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import RawSplats, SplatTensors, detached

log = logging.getLogger(__name__)


def floaters(
    splats: SplatTensors, views: Callable[[], Iterable[View]], render: Callable[[SplatTensors, Camera], Render]
) -> Tensor:
    """Mask ``[N]`` of the splats that no train view supports, as removing them lowers the error or changes nothing.

    A floater hides what is behind it, so removing that, too, would seem to help; therefore the worst ones are removed
    first, and the others are judged again.

    Args:
        splats: Raw attributes of N splats, positions in the coordinates of the views.
        views: Gives the train views, all of them: what only photos that are left out support would go.
        render: The rasterizer.
    """
    raw = detached(splats)
    left = torch.arange(len(raw.means), device=raw.means.device)
    threshold = torch.inf
    for number in range(12):
        rest = RawSplats(*(tensor[left] for tensor in raw))
        slope, curvature, error = removal_effects(rest, views(), render, generator(0, number, "floaters"))
        # Of a floater's opacity, the photos want at most a third; 0 of one in front of a finished scene.
        gain = torch.where(slope < 2 * (1 / 3 - 1) * curvature, -slope - curvature, 0)
        # A gain below this share of the squared error is not seen, and is noise.
        least = 1e-4 * error
        # Of splats in the same pixels, the worst goes first.
        threshold = max(least, 0.25 * min(threshold, float(gain.amax())))
        gone = (gain > threshold) | (curvature == 0)
        log.info("round %d: %d of %d splats go", number + 1, int(gone.sum()), len(left))
        left = left[~gone]
        if threshold == least or len(left) == 0:
            break
    mask = torch.ones(len(raw.means), dtype=torch.bool, device=raw.means.device)
    mask[left] = False
    return mask


def removal_effects(
    splats: SplatTensors,
    views: Iterable[View],
    render: Callable[[SplatTensors, Camera], Render],
    signs: torch.Generator,
    probes: int = 4,
) -> tuple[Tensor, Tensor, float]:
    """What removing each splat, and no other one, does to the squared error of pictures.

    A pixel is affine in each splat's opacity there: without the splat, the difference e between picture and photo is
    e + Δ, with Δ = -α ∂I/∂α. So Σ e² changes by Σ 2 e Δ + Σ Δ² over all pixels and channels, exactly. One backward
    pass has the first sum for all splats; the second one is estimated without bias as the mean square of Σ ±Δ, with
    random signs (Hutchinson 1990). If its opacity were a share t of what it is, the error would be least at
    t = 1 + (first sum) / (2 · second sum).

    Args:
        splats: Raw attributes of N splats.
        views: Cameras and photos; pixels that do not count have no error.
        render: The rasterizer.
        signs: Generator of the signs, on the CPU.
        probes: Draws of signs for each view; with 4, the estimate of a splat seen in five views has a relative error
            of 0.3.

    Returns:
        Both sums ``[N]``, and Σ e².
    """
    # No opacity reaches the rasterizer's cap, which has no gradient.
    cap = torch.logit(torch.tensor(ALPHA_MAX - 0.01)).item()
    opacities = splats.opacities.detach().clamp_max(cap).requires_grad_()
    raw = detached(splats)._replace(opacities=opacities)
    # α ∂/∂α of a pixel's opacity α = σ(x) · G, from ∂/∂x.
    scale = -1 / torch.sigmoid(-opacities.detach())
    slope, curvature, error = torch.zeros_like(scale), torch.zeros_like(scale), 0.0
    for view in views:
        with torch.enable_grad():
            image = apply_mask(render(raw, view.camera).image, view.mask)
        photo = eight_bit(view.image).to(image)
        difference = image.detach() - photo
        # A channel of a photo that is all but white agrees with every brighter one.
        difference.masked_fill_((photo >= 250 / 255) & (difference > 0), 0)
        error += float(difference.double().square().sum())
        (gradient,) = torch.autograd.grad(image, opacities, 2 * difference, retain_graph=True)
        slope += scale * gradient
        for _ in range(probes):
            draws = torch.randint(0, 2, image.shape, generator=signs, dtype=torch.int8).to(image) * 2 - 1
            (gradient,) = torch.autograd.grad(image, opacities, draws, retain_graph=True)
            curvature += (scale * gradient).square_() / probes
    return slope, curvature, error
