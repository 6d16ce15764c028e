"""Cameras for a scene without any: around it, looking at where most of its splats are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import SplatTensors

__all__ = ["cameras_around", "decibels", "look_at", "measuring_cameras", "middle_of", "picture_error", "pictures"]

SYNTHETIC_CAMERAS = 8
MOST_CAMERAS = 24
"""Number of train views in which errors are measured, spread evenly over those of the folder."""

ELEVATIONS = (0.1, 0.5)
"""Elevations above the horizon in radians, y down, used in turn."""


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


def cameras_around(means: NDArray[np.float32], count: int, width: int = 800, height: int = 533) -> list[Camera]:
    """Cameras on a ring around a scene, alternately low and high, twice as far as four fifths of its splats reach.

    If the scene is so small that this would be too near, they are farther away, with a narrower field of view.

    Args:
        means: Positions ``[N, 3]``, N > 0.
        count: Number of cameras.
        width: Pixels.
        height: Pixels.
    """
    middle, reach = middle_of(means)
    usual = 2 * reach
    distance = max(usual, reach + 2 * NEAR)
    angle = 2 * math.atan(usual * math.tan(math.radians(30)) / distance)
    cameras = []
    for number in range(count):
        turn, rise = 2 * math.pi * number / count, ELEVATIONS[number % len(ELEVATIONS)]
        direction = (math.cos(rise) * math.sin(turn), -math.sin(rise), -math.cos(rise) * math.cos(turn))
        cameras.append(look_at(middle, middle + distance * np.array(direction), width, height, angle))
    return cameras


def measuring_cameras(root: Path | None, means: NDArray[np.float32]) -> list[Camera]:
    """Views in which errors are measured.

    Args:
        root: COLMAP folder whose train views are used; None for views from around the scene.
        means: Positions ``[N, 3]``, N > 0.

    Raises:
        SceneError: The folder is not a COLMAP scene.
    """
    if root is None:
        return cameras_around(means, SYNTHETIC_CAMERAS)
    from nsvq_lightning.data.scene import load_scene

    scene = load_scene(root)
    chosen = scene.train[:: -(-len(scene.train) // MOST_CAMERAS)]
    return [scene.cameras[index] for index in chosen]


@torch.no_grad()
def pictures(splats: SplatTensors, cameras: Sequence[Camera]) -> list[Tensor]:
    """What each camera sees, ``[H, W, 3]`` in [0, 1]."""
    return [render(splats, camera).image.clamp(0, 1) for camera in cameras]


def picture_error(splats: SplatTensors, cameras: Sequence[Camera], expected: Sequence[Tensor]) -> float:
    """Root mean square difference between the pictures of a scene and expected ones, for channels in [0, 1]."""
    found = zip(pictures(splats, cameras), expected, strict=True)
    return math.sqrt(float(np.mean([float((a - b).double().square().mean()) for a, b in found])))


def decibels(error: float) -> float:
    """A root mean square error as PSNR in dB."""
    return math.inf if error == 0 else -20 * math.log10(error)
