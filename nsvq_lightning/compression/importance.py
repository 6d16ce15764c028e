"""How much each splat matters for the photos: its total blending weight in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.rendering.sh import C0
from nsvq_lightning.splats.splats import RawSplats, SplatTensors

__all__ = ["contributions", "least_contributing", "most_contributing", "row_weights"]


def contributions(
    splats: SplatTensors, cameras: Iterable[Camera], render: Callable[[SplatTensors, Camera], Render]
) -> Tensor:
    """Blending weight T·α of each splat, summed over all pixels of all cameras: ``[N]``, in pixels.

    An image is linear in the colours of its splats, so the weight is the derivative of the sum of the pixels with
    respect to the splat's colour: one backward pass per view gives it for all splats, and what the rasterizer skips is
    skipped here too.

    Args:
        splats: Raw attributes.
        cameras: The views; they may be divided among processes, and the results added.
        render: The rasterizer.
    """
    base = RawSplats(*(getattr(splats, name).detach() for name in RawSplats._fields))
    # Any colour above 0, where it is not clamped, will do: sh0 = 0 is grey.
    sh0 = torch.zeros_like(base.sh0).requires_grad_()
    grey = base._replace(sh0=sh0, shN=base.shN[:, :0])
    total = torch.zeros_like(base.opacities)
    for camera in cameras:
        with torch.enable_grad():
            red = render(grey, camera).image[..., 0].sum()
        (gradient,) = torch.autograd.grad(red, sh0)
        total += gradient[:, 0, 0] / C0
    return total


def least_contributing(contribution: Tensor, share: float) -> Tensor:
    """Mask ``[N]`` of the least contributing splats: as many as together have at most ``share`` of the sum.

    Args:
        contribution: Contribution ``[N]``, not negative.
        share: Share of the sum, in [0, 1); splats that contribute nothing are always in the mask.
    """
    ascending, order = contribution.sort(stable=True)
    # One after the other, on the CPU: a GPU may add in any order, and replicas would then drop different splats.
    sums = ascending.cpu().double().cumsum(0)
    mask = torch.empty_like(order, dtype=torch.bool)
    mask[order] = (sums <= share * sums[-1:]).to(mask.device)
    return mask


def most_contributing(contribution: Tensor, count: int) -> Tensor:
    """Mask ``[N]`` of the ``count`` splats that contribute most; ties go to the first.

    Args:
        contribution: Contribution ``[N]``.
        count: Number of splats, at most N.
    """
    mask = torch.zeros_like(contribution, dtype=torch.bool)
    mask[contribution.argsort(descending=True, stable=True)[:count]] = True
    return mask


def row_weights(contribution: Tensor, least: float = 0.01) -> Tensor:
    """Weights ``[N]`` of splats with ``contribution [N]``: never 0, as test views may see what no photo saw.

    The smallest weight is ``least`` times the mean contribution.
    """
    return contribution + (least * contribution.mean()).clamp_min(torch.finfo(contribution.dtype).tiny)
