"""Points to start from: those of a ``.ply`` file, or random ones where the cameras look."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.ply import read_ply_columns, read_ply_header
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera


def read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions ``[P, 3]`` and RGB colours ``[P, 3]`` of a ``.ply`` point cloud; points without a colour are grey.

    Raises:
        SceneError: There is no such file, or it is damaged or no point cloud.
    """
    if not path.is_file():
        raise SceneError(f"points {path} do not exist: copy the file, or remove ply_file_path from the transforms file")
    try:
        header = read_ply_header(path)
        if missing := [axis for axis in "xyz" if axis not in header.properties]:
            raise FormatError(f"{path}: its vertices have no {', '.join(missing)}")
        rgb = ("red", "green", "blue")
        colored = set(rgb) <= set(header.properties)
        names = ("x", "y", "z", *(rgb if colored else ()))
        table = np.concatenate([np.zeros((0, len(names)), np.float32), *read_ply_columns(path, header, names)])
    except FormatError as error:
        raise SceneError(f"points {error}") from error
    xyz = table[:, :3].astype(np.float64)
    if not colored:
        return xyz, np.full((len(xyz), 3), 128, np.uint8)
    # Some programs write them in [0, 1].
    scale = 255 if header.dtype["red"].kind == "f" else 1
    return xyz, (np.nan_to_num(table[:, 3:]) * scale).clip(0, 255).round().astype(np.uint8)


def share_seen(points: NDArray[np.float64], cameras: list[Camera]) -> float:
    """Mean share of the cameras that have a point in their picture, walls disregarded."""
    return float(_sightings(points, cameras).mean() / len(cameras)) if len(points) else 0.0


# Points of a scene that comes without.
RANDOM_POINTS = 20_000


def random_points(cameras: list[Camera]) -> NDArray[np.float64]:
    """:data:`RANDOM_POINTS` points ``[P, 3]`` in the volume that the cameras see together, always the same ones.

    Candidates are spread over the views, up to twice as far away as what the cameras look at, which is where their
    optical axes come closest to each other; those that most cameras see are kept.

    Args:
        cameras: At least one.
    """
    draws = generator(0, 0, "random points")
    count = 8 * RANDOM_POINTS
    views = np.stack([camera.viewmat.double().numpy() for camera in cameras])
    rotations = views[:, :3, :3]
    centres = -np.einsum("vji,vj->vi", rotations, views[:, :3, 3])
    chosen = torch.randint(len(cameras), (count,), generator=draws).numpy()
    across, down, away = torch.rand(3, count, generator=draws, dtype=torch.float64).numpy()
    focal = np.array([camera.intrinsics for camera in cameras])[chosen]
    size = np.array([(camera.width, camera.height) for camera in cameras])[chosen]
    depth = 2 * _distance(centres, rotations[:, 2]) * away
    x, y = (across * size[:, 0] - focal[:, 2]) / focal[:, 0], (down * size[:, 1] - focal[:, 3]) / focal[:, 1]
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    points = centres[chosen] + np.einsum("pji,pj->pi", rotations[chosen], rays * depth[:, None])
    order = np.argsort(-_sightings(points, cameras), kind="stable")
    chosen_points: NDArray[np.float64] = points[order[:RANDOM_POINTS]]
    return chosen_points


def _distance(centres: NDArray[np.float64], forward: NDArray[np.float64]) -> float:
    """How far away the cameras look: to where their axes meet, or their own extent if that is farther."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    # Parallel axes meet nowhere; this little weight keeps the solution finite.
    middle = centres.mean(0)
    focus = middle + np.linalg.solve(
        across.sum(0) + 1e-3 * len(centres) * np.eye(3), np.einsum("vij,vj->i", across, centres - middle)
    )
    return max(
        float(np.median(np.linalg.norm(centres - focus, axis=1))),
        float(np.linalg.norm(centres - middle, axis=1).max()),
        1e-6,
    )


def _sightings(points: NDArray[np.float64], cameras: list[Camera]) -> NDArray[np.int64]:
    """Number of cameras ``[P]`` that have each point in their picture."""
    seen = np.zeros(len(points), np.int64)
    for camera in cameras:
        view = camera.viewmat.double().numpy()
        fx, fy, cx, cy = camera.intrinsics
        x, y, z = (points @ view[:3, :3].T + view[:3, 3]).T
        front = np.where(z > 0, z, np.nan)
        with np.errstate(invalid="ignore"):
            u, v = fx * x / front + cx, fy * y / front + cy
            seen += (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return seen
