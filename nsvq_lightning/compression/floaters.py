"""Floaters: splats that the photos would rather be without."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from nsvq_lightning.compression.sensitivity import sensitivity
from nsvq_lightning.data.scene import View
from nsvq_lightning.quality.masking import kept
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import RawSplats, SplatTensors

__all__ = ["floaters"]

ROUNDS = 8
"""Most rounds: floaters hide behind each other, and spoil the pixels by which other splats are judged."""
AT_ONCE = 0.5
"""Share of what removals would gain that is taken in one round, the largest gains first."""
LEAST = 4.0
"""Gain from which on a splat is removed, as a multiple of the photos' mean error by splat."""
CERTAINTY = 0.5
"""Standard deviations by which the gain must exceed its estimate's noise."""
STEEP = 1e-4
"""Smallest derivative of an opacity by its logit that is divided by."""


@torch.no_grad()
def floaters(
    splats: RawSplats, views: Callable[[], Iterable[View]], render: Callable[[SplatTensors, Camera], Render]
) -> Tensor:
    """Which splats no photo supports ``[N]``: their removal brings the pictures nearer to the photos, or is not seen.

    A pixel is linear in the opacity o of each splat, so the squared error E of all photos is a parabola in it, and
    removing the splat alone changes it by −o·E' + o²·½E'': the gradient, and the diagonal of the Gauss-Newton matrix
    (:func:`~nsvq_lightning.compression.sensitivity.sensitivity`). Where training has ended E' is small, and every splat
    that shows is supported by its second term. The removals that gain most go first, then all are judged again.

    Args:
        splats: Raw attributes of N splats.
        views: Gives the train photos, all of them: what only photos that are left out support would go.
        render: The rasterizer.
    """
    rows = torch.arange(len(splats.means), device=splats.means.device)
    for number in range(ROUNDS):
        change, unseen, error = _removals(RawSplats(*(tensor[rows] for tensor in splats)), views(), render)
        gains = change.clamp_max(0)
        order = gains.argsort()
        first = gains[order].cumsum(0) >= AT_ONCE * gains.sum()
        gone = torch.zeros_like(unseen)
        gone[order] = first
        gone &= change < -LEAST * error / max(1, len(rows))
        if number == 0:
            gone |= unseen
        rows = rows[~gone]
        if not gone.any():
            break
    removed = torch.ones(len(splats.means), dtype=torch.bool, device=rows.device)
    removed[rows] = False
    return removed


def _removals(
    splats: RawSplats, views: Iterable[View], render: Callable[[SplatTensors, Camera], Render]
) -> tuple[Tensor, Tensor, float]:
    """By how much the error grows without each splat ``[N]``, at least; which no view shows ``[N]``; the error."""
    opacities = splats.opacities.sigmoid()
    by_logit = opacities / (opacities * (1 - opacities)).clamp_min(STEEP)
    slope, bend, noise = (torch.zeros_like(opacities) for _ in range(3))
    error = 0.0
    for view in views:

        def masked(some: SplatTensors, camera: Camera, mask: Tensor | None = view.mask) -> Render:
            rendered = render(some, camera)
            return rendered._replace(image=kept(rendered.image, mask))

        logits = splats.opacities.detach().requires_grad_()
        with torch.enable_grad():
            image = masked(splats._replace(opacities=logits), view.camera).image
            squares = (image - eight_bit(view.image)).square().sum()
        (gradient,) = torch.autograd.grad(squares, logits)
        slope += by_logit * gradient
        shown, _ = sensitivity(splats, view.camera, masked, generator(0, view.index, "signs"))
        curvature = by_logit.square() * shown.opacities
        bend += curvature
        noise += curvature.square()
        error += float(squares.detach())
    return bend - slope + CERTAINTY * noise.sqrt(), (bend == 0) & (slope == 0), error
