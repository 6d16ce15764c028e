"""Small scenes with tracks, made from the photos of the package's demo scene."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from nsvq_lightning.data import colmap
from nsvq_lightning.data.colmap import import_pycolmap, read_model
from nsvq_lightning.data.images import read_image

DEMO = Path(colmap.__file__).parent / "demo"


def write_small_demo(root: Path, views: int, width: int, height: int, points: int) -> Path:
    """Write some of the demo scene's views, evenly spaced and of another size, as a COLMAP scene to ``root``.

    A point is in the tracks of all views whose picture it is in; points with fewer than three views are left out.
    """
    pycolmap, demo = import_pycolmap(), read_model(DEMO)
    chosen = [demo.images[round(len(demo.images) * view / views)] for view in range(views)]
    full = demo.cameras[chosen[0].camera_id]
    factors = np.array([width / full.width, height / full.height])
    lens = full.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]] * np.tile(factors, 2)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=lens.tolist(), camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    tracks: list[list[tuple[int, int]]] = [[] for _ in demo.points]
    (root / "images").mkdir(parents=True)
    for number, image in enumerate(chosen, start=1):
        local = demo.points @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * lens[:2] + lens[2:]
        rows = np.flatnonzero((local[:, 2] > 0.1) & (pixels > 0).all(1) & (pixels < (width, height)).all(1))
        for column, row in enumerate(rows):
            tracks[row].append((number, column))
        name = f"view_{number - 1:03d}.png"
        posed = pycolmap.Image(name=name, keypoints=pixels[rows], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(posed, pycolmap.Rigid3d(image.viewmat[:3]))
        picture = cv2.resize(read_image(DEMO / "images" / image.name), (width, height), interpolation=cv2.INTER_AREA)
        PIL.Image.fromarray(np.asarray(picture, np.uint8)).save(root / "images" / name)
    seen = [row for row, track in enumerate(tracks) if len(track) >= min(3, views)]
    for row in seen[:: max(1, len(seen) // points)][:points]:
        track = pycolmap.Track()
        for element in tracks[row]:
            track.add_element(*element)
        model.add_point3D(demo.points[row].astype(np.float64), track, demo.colors[row])
    model.update_point_3d_errors()
    (root / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(root / "sparse" / "0"))
    return root
