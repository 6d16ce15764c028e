"""How far the pictures of a scene are from those of the scene it was made from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import SplatTensors

__all__ = ["decibels", "picture_error", "pictures"]


@torch.no_grad()
def pictures(splats: SplatTensors, cameras: Sequence[Camera]) -> list[Tensor]:
    """What each camera sees, ``[H, W, 3]`` in [0, 1]."""
    return [render(splats, camera).image.clamp(0, 1) for camera in cameras]


def picture_error(splats: SplatTensors, cameras: Sequence[Camera], expected: Sequence[Tensor]) -> float:
    """Root mean square difference between the pictures of a scene and expected ones, of channels in [0, 1]."""
    found = zip(pictures(splats, cameras), expected, strict=True)
    return math.sqrt(float(np.mean([float((a - b).double().square().mean()) for a, b in found])))


def decibels(error: float) -> float:
    """An error as PSNR."""
    return math.inf if error == 0 else -20 * math.log10(error)
