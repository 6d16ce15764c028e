"""How much each splat matters to the pictures: its weight, the effect of its attributes and of its removal."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Generator, Tensor

from nsvq_lightning.data.scene import View
from nsvq_lightning.quality.loss import apply_mask
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import ALPHA_MAX
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.rendering.sh import C0
from nsvq_lightning.splats.splats import RawSplats, SplatTensors, detached
from nsvq_lightning.top_level import log

# The rasterizer with its settings.
Renderer = Callable[[SplatTensors, Camera], Render]


def contributions(splats: SplatTensors, cameras: Iterable[Camera], render: Renderer) -> Tensor:
    """Blending weight T·α of each splat, summed over all pixels of all cameras: ``[N]``, in pixels.

    An image is linear in the colours of its splats, so the weight is the derivative of the sum of the pixels with
    respect to the splat's colour: one backward pass per view gives it for all splats, and what the rasterizer skips is
    skipped here too.

    Args:
        splats: Raw attributes.
        cameras: The views; they may be divided among processes, and the results added.
        render: The rasterizer.
    """
    base = detached(splats)
    # Any colour above 0, where it is not clamped, will do: sh0 = 0 is grey.
    sh0 = torch.zeros_like(base.sh0).requires_grad_()
    grey = base._replace(sh0=sh0, shN=base.shN[:, :0])
    total = torch.zeros_like(base.opacities)
    for camera in cameras:
        with torch.enable_grad():
            # The graph goes at once, and the next view takes its memory.
            (gradient,) = torch.autograd.grad(render(grey, camera).image[..., 0].sum(), sh0)
        total += gradient[:, 0, 0] / C0
    return total


def row_weights(contribution: Tensor, least: float = 0.01) -> Tensor:
    """Weights ``[N]`` of splats with ``contribution [N]``: never 0, as test views may see what no photo saw.

    The smallest weight is ``least`` times the mean contribution.
    """
    # Not torch's mean, whose last bits depend on the number of threads.
    mean = float(contribution.numpy(force=True).mean(dtype=np.float64))
    return contribution + max(least * mean, torch.finfo(contribution.dtype).tiny)


def sensitivity(
    splats: SplatTensors, camera: Camera, render: Renderer, signs: Generator, mask: Tensor | None = None
) -> tuple[RawSplats, Tensor]:
    """Σ (∂I/∂θ)² over the pixels and channels I of a picture, for every number θ of every splat, and the picture.

    It is the diagonal of the Gauss-Newton matrix of the squared error: an error δ in θ alone changes the picture by
    δ² times that. One backward pass estimates it without bias for all numbers at once: the gradient of Σ ±I, with a
    random sign for each I, has it as its mean square (Hutchinson 1990).

    Args:
        splats: Raw attributes of N splats.
        camera: The view.
        render: The rasterizer.
        signs: Generator of the signs, on the CPU.
        mask: Which pixels count ``[H, W]`` bool; None if all do.

    Returns:
        The estimate, shaped as the raw attributes, in squared channel values over squared units of the attribute; and
        the picture ``[H, W, 3]``, detached.
    """
    raw = RawSplats(*(tensor.requires_grad_() for tensor in detached(splats)))
    with torch.enable_grad():
        image = render(raw, camera).image
    gradients = torch.autograd.grad(image, raw, apply_mask(_drawn(signs, image), mask), materialize_grads=True)
    return RawSplats(*(gradient.square_() for gradient in gradients)), image.detach()


def _drawn(signs: Generator, image: Tensor) -> Tensor:
    """1 or -1 for each channel of a picture, equally likely."""
    return torch.randint(0, 2, image.shape, generator=signs, dtype=torch.int8).to(image) * 2 - 1


def below_cap(splats: SplatTensors) -> RawSplats:
    """The splats, detached, with opacities below the rasterizer's cap, where pixels have no gradient."""
    raw = detached(splats)
    return raw._replace(opacities=raw.opacities.clamp_max(torch.logit(torch.tensor(ALPHA_MAX - 0.01)).item()))


def by_opacity(opacities: Tensor) -> Tensor:
    """Factors ``[N]`` from ∂I/∂x, with an opacity logit x, to α ∂I/∂α of its opacity α = σ(x) · G in a pixel."""
    return 1 / torch.sigmoid(-opacities)


# Other views need what these do not show, and an estimate from few signs is noise: no effect counts as less than this
# share of a splat's typical one, ...
MIN_EFFECT = 0.1
# ... and what counts is this power of it, the typical one having the rest.
TRUST = 0.75


def likely_effects(splats: RawSplats, squares: Tensor) -> Tensor:
    """How much pictures are likely to change without each splat, moved towards what is typical of it: ``[N]``.

    Args:
        splats: Raw attributes of N splats below the cap (:func:`below_cap`).
        squares: Their :func:`sensitivity` to opacities ``[N]``, summed over pictures.
    """
    effects = squares * by_opacity(splats.opacities).square()
    # An opaque splat shows more, a large one hardly: where splats are large, photos were taken from far away.
    size = (splats.scales.topk(2).values.sum(1) / 3).exp()
    typical = splats.opacities.sigmoid().square() * size
    typical *= (effects / typical)[effects > 0].median().nan_to_num(1.0)  # where nothing has an effect
    return effects.fmax(MIN_EFFECT * typical) ** TRUST * typical ** (1 - TRUST)


def floaters(splats: SplatTensors, views: Callable[[], Iterable[View]], render: Renderer) -> Tensor:
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
    mask = torch.ones_like(left, dtype=torch.bool)
    threshold = torch.inf
    for number in range(12):
        slope, curvature, error = removal_effects(raw.take(left), views(), render, generator(0, number, "floaters"))
        # Of a floater's opacity, the photos want at most a third; 0 of one in front of a finished scene.
        gain = torch.where(slope < 2 * (1 / 3 - 1) * curvature, -slope - curvature, 0)
        # A gain below this share of the squared error is not seen, and is noise.
        least = 1e-4 * error
        # Of splats in the same pixels, the worst goes first.
        threshold = max(least, 0.25 * min(threshold, float(gain.amax())))
        gone = (gain > threshold) | (curvature == 0)
        log.info(f"round {number + 1}: {int(gone.sum())} of {len(left)} splats go")
        left = left[~gone]
        if threshold == least or len(left) == 0:
            break
    mask[left] = False
    return mask


# Draws of signs for each view: the estimate of a splat seen in five views has a relative error of 0.3.
PROBES = 4


def removal_effects(
    splats: SplatTensors, views: Iterable[View], render: Renderer, signs: Generator
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

    Returns:
        Both sums ``[N]``, and Σ e².
    """
    raw = below_cap(splats)
    scale = -by_opacity(raw.opacities)
    opacities = raw.opacities.requires_grad_()
    slope = torch.zeros_like(scale)
    curvature = torch.zeros_like(scale)
    error = 0.0
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
        for _ in range(PROBES):
            (gradient,) = torch.autograd.grad(image, opacities, _drawn(signs, image), retain_graph=True)
            curvature += (scale * gradient).square_() / PROBES
    return slope, curvature, error
