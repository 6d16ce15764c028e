"""How much the numbers of each splat show: what an error in one of them does to a picture."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import RawSplats, SplatTensors

__all__ = ["sensitivity"]


def sensitivity(
    splats: SplatTensors, camera: Camera, render: Callable[[SplatTensors, Camera], Render], signs: torch.Generator
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

    Returns:
        The estimate, shaped as the raw attributes, in squared channel values over squared units of the attribute; and
        the picture ``[H, W, 3]``, detached.
    """
    raw = RawSplats(*(getattr(splats, name).detach().requires_grad_() for name in RawSplats._fields))
    with torch.enable_grad():
        image = render(raw, camera).image
    draws = torch.randint(0, 2, image.shape, generator=signs, dtype=torch.int8).to(image) * 2 - 1
    gradients = torch.autograd.grad(image, raw, draws, allow_unused=True)
    squares = (
        torch.zeros_like(tensor) if gradient is None else gradient.square_()
        for tensor, gradient in zip(raw, gradients, strict=True)
    )
    return RawSplats(*squares), image.detach()
