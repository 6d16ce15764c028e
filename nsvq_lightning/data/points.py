"""Points to start from: those of ``.ply`` files of any program, with colours of any kind, or random ones."""

import re
from pathlib import Path

import numpy as np
import torch

from nsvq_lightning.data.colmap import SceneError, rgb_bytes
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.ply import read_ply_columns, read_ply_header
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.poses import looked_at, poses, transformed
from nsvq_lightning.splats.conventions import SH_C0, Bools, Float64s, Uint8s


def read_points(path: Path) -> tuple[Float64s, Uint8s]:
    """Positions ``[P, 3]`` and RGB colours ``[P, 3]`` of a ``.ply`` point cloud; points without a colour are grey.

    Raises:
        SceneError: There is no such file, or it is damaged or no point cloud.
    """
    if not path.is_file():
        raise SceneError(f"points {path} do not exist: copy the file, or remove ply_file_path from the transforms file")
    try:
        header = read_ply_header(path)
        # By their names in lower case, also without what some programs put before these.
        known = {re.sub("^(scalar|diffuse|vertex)_", "", name.lower()): name for name in header.properties}
        known |= {name.lower(): name for name in header.properties}
        if missing := [axis for axis in "xyz" if axis not in known]:
            raise FormatError(f"{path}: its vertices have no {', '.join(missing)}")
        rgb = next((names for names in _COLORS if known.keys() >= {*names}), ())
        names = [known[name] for name in (*"xyz", *rgb)]
        table = np.concatenate([*read_ply_columns(path, header, names, np.float64)])
    except FormatError as error:
        raise SceneError(f"points {error}") from error
    xyz, values = table[:, :3], table[:, 3:]
    if not rgb:
        return xyz, np.full_like(xyz, 128, np.uint8)
    if rgb == _COLORS[2]:
        values = (0.5 + SH_C0 * values).clip(0, 1)
    return xyz, rgb_bytes(values, floats=header.dtype[names[3]].kind == "f")


# Names of three properties that are a colour, in the order in which they are looked for: those of splats come third.
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("intensity",) * 3)


# Point clouds of other programs, in the folder that their cameras are in.
_CLOUDS = ("points3d", "sparse_pc", "sparse_pcd", "point_cloud", "pointcloud", "points")


def cloud_in(folders: list[Path]) -> Path | None:
    """The ``.ply`` file of points in the first of some folders that has one: with a usual name, or the only one.

    Raises:
        SceneError: There are several.
    """
    for folder in folders:
        files = sorted(path for path in folder.glob("[!.]*") if path.suffix.lower() == ".ply")
        usual = [path for path in files if path.stem.lower() in _CLOUDS] or files
        if len(usual) > 1:
            raise SceneError(f"{usual[0]} and {usual[1]} may be the points to start from: leave one of them there")
        if usual:
            return usual[0]
    return None


def share_seen(points: Float64s, cameras: list[Camera]) -> float:
    """Mean share of the cameras that have a point in their picture, walls disregarded."""
    return float(np.mean([in_picture(points, camera).mean() for camera in cameras]))


# Points of a scene that comes without.
RANDOM_POINTS = 20_000
# Where cameras look away from each other, as from the middle of a room, they show what is so many times as far away.
OUTWARD = 10


def random_points(cameras: list[Camera]) -> Float64s:
    """:data:`RANDOM_POINTS` points ``[P, 3]`` in the volume that the cameras see together, always the same ones.

    Candidates are spread over the views, up to twice as far away as what the cameras look at, which is where their
    optical axes come closest to each other, or :data:`OUTWARD` times as far; those that most cameras see are kept.

    Args:
        cameras: At least one.
    """
    draws = generator(0, 0, "random points")
    count = 8 * RANDOM_POINTS
    centres, rotations = poses(cameras)
    # The cameras look at where their axes meet, or as far away as their own extent if that is farther.
    towards = looked_at(cameras) - centres
    typical = np.median(np.linalg.norm(towards, axis=1))
    distance = max(typical, np.linalg.norm(centres - centres.mean(0), axis=1).max(), 1e-6)
    # In eight rooms, two fifths of the cameras look away from their middle.
    if np.quantile((towards * rotations.as_matrix()[:, :, 2]).sum(1), 0.8) < 0:
        distance *= OUTWARD
    chosen = torch.randint(len(cameras), (count,), generator=draws).numpy()
    across, down, away = torch.rand(3, count, generator=draws, dtype=torch.float64).numpy()
    fx, fy, cx, cy = np.array([camera.intrinsics for camera in cameras])[chosen].T
    width, height = np.array([camera.size for camera in cameras])[chosen].T
    rays = np.c_[(across * width - cx) / fx, (down * height - cy) / fy, np.ones(count)]
    points = centres[chosen] + rotations[chosen].apply(rays * (2 * distance * away)[:, None])
    # One after another: all pictures at once would take a byte for each point and camera.
    sightings = sum(in_picture(points, camera).astype(int) for camera in cameras)
    return points[np.argsort(-sightings, kind="stable")[:RANDOM_POINTS]]  # type: ignore[no-any-return]


def in_picture(points: Float64s, camera: Camera) -> Bools:
    """Which points ``[P, 3]`` are in the picture of a camera ``[P]``, walls disregarded."""
    column, row, _ = projected(points, camera)
    return (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)


def projected(points: Float64s, camera: Camera) -> tuple[Float64s, Float64s, Float64s]:
    """Column and row in a camera's picture, pixels, and depth ``[P]`` of points ``[P, 3]``; NaN of those behind it."""
    view = camera.viewmat.double().numpy()
    fx, fy, cx, cy = camera.intrinsics
    x, y, z = transformed(points, view).T
    depth = np.where(z > 0, z, np.nan)
    with np.errstate(invalid="ignore"):
        return fx * x / depth + cx, fy * y / depth + cy, depth
