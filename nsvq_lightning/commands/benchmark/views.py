"""A workload as a scene to train on: photos of it, with their cameras, in a COLMAP folder."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.workloads import Workload
from nsvq_lightning.data.colmap import import_pycolmap
from nsvq_lightning.data.images import encode_png
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render

__all__ = ["write_views"]

VIEWS = 9
SWEEP = 0.6
"""Radians between the first and the last camera, which stand around the workload's own one."""
FADING = 0.9
"""Photos are darker than the renders by this factor, or there would be no error to train away."""
POINTS = 100


@torch.no_grad()
def write_views(workload: Workload, root: Path, views: int = VIEWS) -> Path:
    """Render photos from around the workload's camera and write them as a COLMAP folder.

    Args:
        workload: What is photographed, on black.
        root: Folder that is written.
        views: Number of photos; every eighth is a test view.

    Returns:
        ``root``.
    """
    (root / "images").mkdir(parents=True)
    (root / "sparse" / "0").mkdir(parents=True)
    pycolmap = import_pycolmap()
    model, camera = pycolmap.Reconstruction(), workload.camera
    lens = pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=list(camera.intrinsics), camera_id=1
    )
    model.add_camera_with_trivial_rig(lens)
    for number, viewmat in enumerate(_around(workload, views), start=1):
        name = f"view_{number:03d}.png"
        image = render(workload.splats, Camera(camera.K, viewmat, camera.width, camera.height)).image
        photo = (255 * FADING * image.clamp(0, 1)).round().byte().numpy()
        (root / "images" / name).write_bytes(encode_png(photo))
        pose = pycolmap.Rigid3d(viewmat[:3].double().numpy())
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=number), pose)
    for point in workload.splats.means[:POINTS].double().numpy():
        model.add_point3D(point, pycolmap.Track(), np.full(3, 128, np.uint8))
    model.write_binary(str(root / "sparse" / "0"))
    return root


def _around(workload: Workload, views: int) -> list[Tensor]:
    """World-to-camera matrices ``[4, 4]`` of cameras on an arc around what the workload's camera looks at."""
    view = workload.camera.viewmat.double()
    depth = float((workload.splats.means.double() @ view[2, :3] + view[2, 3]).median())
    angles = torch.linspace(-SWEEP / 2, SWEEP / 2, views).tolist()
    return [(_turn(angle, depth) @ view).float() for angle in angles]


def _turn(angle: float, depth: float) -> Tensor:
    """Rotation about the vertical axis through the point ``depth`` in front of a camera ``[4, 4]``."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    turn[0, 3], turn[2, 3] = -depth * math.sin(angle), depth - depth * math.cos(angle)
    return turn
