"""Pictures of a scene, and how they differ from others."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import SplatTensors

__all__ = ["decibels", "look_at", "middle_of", "picture_error", "pictures"]


def look_at(target: NDArray[np.float64], eye: NDArray[np.float64], width: int, height: int, angle: float) -> Camera:
    """A camera at ``eye [3]`` that has ``target [3]`` in its centre, y down.

    Args:
        target: World position.
        eye: World position, not straight above or below the target.
        width: Pixels.
        height: Pixels.
        angle: Horizontal field of view, radians.
    """
    forward = target - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = -rotation @ eye
    focal = 0.5 * width / math.tan(angle / 2)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(intrinsics, torch.from_numpy(view.astype(np.float32)), width, height)


def middle_of(means: NDArray[np.float32]) -> tuple[NDArray[np.float64], float]:
    """The median ``[3]`` of positions ``[N, 3]``, N > 0, and the distance from it within which four fifths lie."""
    points = means.astype(np.float64)
    middle = np.median(points, axis=0)
    return middle, max(float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.8)), 1e-3)


@torch.no_grad()
def pictures(splats: SplatTensors, cameras: Sequence[Camera], antialiased: bool = False) -> list[Tensor]:
    """What each camera sees, ``[H, W, 3]`` in [0, 1]."""
    return [render(splats, camera, antialiased=antialiased).image.clamp(0, 1) for camera in cameras]


def picture_error(
    splats: SplatTensors, cameras: Sequence[Camera], expected: Sequence[Tensor], antialiased: bool = False
) -> float:
    """Root mean square difference between the pictures of a scene and expected ones, for channels in [0, 1]."""
    found = zip(pictures(splats, cameras, antialiased), expected, strict=True)
    return math.sqrt(float(np.mean([float((a - b).double().square().mean()) for a, b in found])))


def decibels(error: float) -> float:
    """A root mean square error as PSNR in dB."""
    return math.inf if error == 0 else -20 * math.log10(error)
