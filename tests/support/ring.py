"""Cameras on a ring around a scene."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.compression.viewpoints import look_at
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR

ELEVATIONS = (0.1, 0.5)
"""Elevations above the horizon in radians, y down, used in turn."""


def cameras_around(means: NDArray[np.float32], count: int, width: int = 800, height: int = 533) -> list[Camera]:
    """Cameras on a ring around a scene, alternately low and high, twice as far as four fifths of its splats reach.

    If the scene is so small that this would be too near, they are farther away, with a narrower field of view.

    Args:
        means: Positions ``[N, 3]``, N > 0.
        count: Number of cameras.
        width: Pixels.
        height: Pixels.
    """
    points = means.astype(np.float64)
    middle = np.median(points, axis=0)
    reach = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.8)) or 1.0
    usual = 2 * reach
    distance = max(usual, reach + 2 * NEAR)
    angle = 2 * math.atan(usual * math.tan(math.radians(30)) / distance)
    cameras = []
    for number in range(count):
        turn, rise = 2 * math.pi * number / count, ELEVATIONS[number % len(ELEVATIONS)]
        direction = (math.cos(rise) * math.sin(turn), -math.sin(rise), -math.cos(rise) * math.cos(turn))
        cameras.append(look_at(middle, middle + distance * np.array(direction), width, height, angle))
    return cameras
