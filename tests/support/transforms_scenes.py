"""Scene folders with a ``transforms.json``, written from a COLMAP folder."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from nsvq_lightning.data.colmap import ColmapModel, read_model

__all__ = ["opengl_matrix", "write_blender", "write_nerfstudio"]

APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""What nerfstudio applies to COLMAP's world: z up."""


def opengl_matrix(viewmat: Any, applied: Any = None) -> list[list[float]]:
    """Camera to world with y up and z backward, from COLMAP's world to camera."""
    matrix = np.linalg.inv(viewmat) @ np.diag([1.0, -1, -1, 1])
    if applied is not None:
        matrix = np.vstack([applied, [0, 0, 0, 1]]) @ matrix
    return [[float(x) for x in row] for row in matrix]


def write_nerfstudio(colmap: Path, root: Path, applied: Any = None, moved_points: bool = True, **head: Any) -> Path:
    """``transforms.json``, ``images/`` and ``points.ply``; ``head`` adds to the file's values, None removes one."""
    model = read_model(colmap)
    shutil.copytree(colmap / "images", root / "images")
    (camera,) = model.cameras.values()
    fx, fy, cx, cy = camera.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    values = {
        "camera_model": "OPENCV", "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": camera.width, "h": camera.height,
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "ply_file_path": "points.ply", **head,
    }  # fmt: skip
    if applied is not None:
        values["applied_transform"] = applied.tolist()
    values = {key: value for key, value in values.items() if value is not None}
    frames = [
        {"file_path": f"images/{image.name}", "transform_matrix": opengl_matrix(image.viewmat, applied)}
        for image in reversed(model.images)
    ]
    (root / "transforms.json").write_text(json.dumps({**values, "frames": frames}))
    write_points(root / "points.ply", model, applied if moved_points else None)
    return root


def write_points(path: Path, model: ColmapModel, applied: Any = None) -> None:
    """An ascii point cloud as nerfstudio writes it."""
    points = model.points if applied is None else model.points @ applied[:, :3].T + applied[:, 3]
    head = "".join(f"property {kind} {name}\n" for kind, names in (("float", "x y z"), ("uint8", "red green blue"))
                   for name in names.split())  # fmt: skip
    rows = "".join(
        " ".join([*(repr(float(x)) for x in xyz), *map(str, rgb)]) + "\n"
        for xyz, rgb in zip(points, model.colors.tolist(), strict=True)
    )
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{head}end_header\n{rows}")


def write_blender(colmap: Path, root: Path) -> Path:
    """NeRF-synthetic: square RGBA photos in ``train/`` and ``test/``, without suffix in the files, and no points.

    The left third of each photo is transparent.
    """
    model = read_model(colmap)
    (camera,) = model.cameras.values()
    side = camera.height
    for part in ("train", "test"):
        (root / part).mkdir(parents=True)
        frames = []
        for number, image in enumerate(i for k, i in enumerate(model.images) if (k % 4 == 0) == (part == "test")):
            photo = cv2.imread(str(colmap / "images" / image.name))[:, :side]
            alpha = np.full(photo.shape[:2], 255, np.uint8)
            alpha[:, : side // 3] = 0
            assert cv2.imwrite(str(root / part / f"r_{number}.png"), np.dstack([photo, alpha]))
            frames.append({"file_path": f"./{part}/r_{number}", "rotation": 0.01,
                           "transform_matrix": opengl_matrix(image.viewmat)})  # fmt: skip
        angle = 2 * float(np.arctan(side / 2 / camera.calibration_matrix()[0, 0]))
        (root / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return root
