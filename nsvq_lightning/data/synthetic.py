"""Writes the demo scene as a real COLMAP folder: pictures, cameras, poses, points with tracks."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nsvq_lightning.data.colmap import import_pycolmap
from nsvq_lightning.data.demo_room import demo_poses, demo_room, to_srgb
from nsvq_lightning.data.images import encode_png
from nsvq_lightning.data.raytrace import Room
from nsvq_lightning.data.surfaces import Array
from nsvq_lightning.random import generator

__all__ = ["render_view", "write_synthetic_scene"]

_SUPERSAMPLING = 2
_POINT_NOISE = 0.002  # metres; about the error of a triangulated point at this size
_VIEWS_A_POINT = 3  # COLMAP's mapper does not keep points with shorter tracks


@dataclass(frozen=True)
class _Lens:
    """Pinhole camera of all views; its principal point is off-centre, as in a real camera."""

    width: int
    height: int

    @property
    def params(self) -> tuple[float, float, float, float]:
        """``fx, fy, cx, cy`` in pixels."""
        focal = 0.78 * self.width
        return focal, focal, 0.5 * self.width + 0.011 * self.width, 0.5 * self.height - 0.009 * self.height

    def rays(self, pose: NDArray[np.float64], oversample: int) -> tuple[Array, Array]:
        """Centre ``[3]`` and unit directions ``[height·width·oversample², 3]`` in world coordinates."""
        fx, fy, cx, cy = self.params
        x = ((np.arange(self.width * oversample) + 0.5) / oversample - cx) / fx
        y = ((np.arange(self.height * oversample) + 0.5) / oversample - cy) / fy
        grid = np.meshgrid(x, y)
        directions = np.stack([*grid, np.ones_like(grid[0])], -1).reshape(-1, 3) @ pose[:3, :3]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return _centre(pose), directions.astype(np.float32)

    def project(self, pose: NDArray[np.float64], points: Array) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels ``[P, 2]`` of world points ``[P, 3]``, and whether they are in the picture."""
        local = points @ pose[:3, :3].T + pose[:3, 3]
        fx, fy, cx, cy = self.params
        depth = np.maximum(local[:, 2], 1e-6)
        pixels = np.stack([fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy], axis=-1)
        inside = (local[:, 2] > 0.1) & (pixels > 0).all(1) & (pixels < (self.width, self.height)).all(1)
        return pixels, inside


@dataclass(frozen=True, eq=False)
class _Points:
    """Surface points ``xyz``, ``rgb`` (``[P, 3]``), seen by the views at ``pixels [V, P, 2]`` where ``seen [V, P]``."""

    xyz: Array
    rgb: NDArray[np.uint8]
    pixels: NDArray[np.float64]
    seen: NDArray[np.bool_]


def write_synthetic_scene(
    root: str | Path, views: int = 40, width: int = 320, height: int = 240, points: int = 4000, seed: int = 0
) -> Path:
    """Render the demo room and write it as a COLMAP scene (``images/*.png``, ``sparse/0/*.bin``).

    The folder is built next to ``root`` and renamed when complete, so an interrupted run leaves no partial scene. The
    same arguments give the same bytes.

    Args:
        root: Folder to create.
        views: Number of views on an orbit around the room's middle.
        width: Image width in pixels.
        height: Image height in pixels.
        points: Number of sparse points.
        seed: Seed of the points; the pictures do not depend on it.

    Returns:
        ``root`` as a path.

    Raises:
        ValueError: A number is out of range.
        FileExistsError: ``root`` exists and is not an empty folder.
    """
    if views < 2 or width < 8 or height < 8 or points < 1:
        raise ValueError(
            f"needs views >= 2, width and height >= 8, points >= 1; got {views}, {width}x{height}, {points}"
        )
    root = Path(root)
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise FileExistsError(f"{root} exists: remove it or give another folder")
    root.parent.mkdir(parents=True, exist_ok=True)
    room, lens, poses = demo_room(), _Lens(width, height), demo_poses(views)
    with tempfile.TemporaryDirectory(prefix=f".{root.name}.", dir=root.parent) as temporary:
        scene = Path(temporary) / "scene"
        names = [f"view_{i:03d}.png" for i in range(views)]
        (scene / "images").mkdir(parents=True)
        for name, pose in zip(names, poses, strict=True):
            (scene / "images" / name).write_bytes(encode_png(render_view(room, pose, width, height)))
        _write_model(scene / "sparse" / "0", lens, names, poses, _surface_points(room, lens, poses, points, seed))
        scene.rename(root)
    return root


def render_view(room: Room, pose: NDArray[np.float64], width: int, height: int) -> NDArray[np.uint8]:
    """Anti-aliased sRGB picture ``[H, W, 3]`` of the room from a world-to-camera ``pose [4, 4]``."""
    n = _SUPERSAMPLING
    linear = room.colours(*_Lens(width, height).rays(pose, n)).clip(0, 1)
    return to_srgb(linear.reshape(height, n, width, n, 3).mean(axis=(1, 3)))


def _centre(pose: NDArray[np.float64]) -> Array:
    return (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)


def _surface_points(room: Room, lens: _Lens, poses: NDArray[np.float64], count: int, seed: int) -> _Points:
    """Random surface points that at least three views see (or all views, if there are fewer)."""
    rng = generator(seed, 0, "demo points")
    candidates = 3 * count
    areas = torch.tensor([s.size[0] * s.size[1] * (0.0 if s.glow else 1.0) for s in room.surfaces])
    # the square root favours small things, as corners and texture do in a real reconstruction
    number = torch.multinomial(areas.sqrt(), candidates, replacement=True, generator=rng).numpy()
    uv = torch.rand(candidates, 2, generator=rng).numpy()
    noise = (_POINT_NOISE * torch.randn(candidates, 3, generator=rng)).numpy()
    xyz, rgb = np.zeros((candidates, 3), np.float32), np.zeros((candidates, 3), np.uint8)
    for i, surface in enumerate(room.surfaces):
        mine = number == i
        xyz[mine] = surface.points(uv[mine])
        rgb[mine] = to_srgb(room.diffuse(i, uv[mine]))
    sightings = [_sight(room, lens, pose, xyz) for pose in poses]
    pixels, seen = np.stack([s[0] for s in sightings]), np.stack([s[1] for s in sightings])
    chosen = np.flatnonzero(seen.sum(0) >= min(_VIEWS_A_POINT, len(poses)))[:count]
    return _Points(xyz[chosen] + noise[chosen], rgb[chosen], pixels[:, chosen], seen[:, chosen])


def _sight(
    room: Room, lens: _Lens, pose: NDArray[np.float64], xyz: Array
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels ``[P, 2]`` of points ``[P, 3]``, and whether the view sees them unoccluded."""
    pixels, inside = lens.project(pose, xyz)
    centre = _centre(pose)
    inside[inside] = room.trace(centre, xyz[inside] - centre).t > 0.995
    return pixels, inside


def _write_model(folder: Path, lens: _Lens, names: list[str], poses: NDArray[np.float64], points: _Points) -> None:
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=lens.width, height=lens.height, params=list(lens.params), camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    tracks: list[list[tuple[int, int]]] = [[] for _ in points.xyz]
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
        rows = np.flatnonzero(points.seen[number - 1])
        for column, row in enumerate(rows):
            tracks[row].append((number, column))
        image = pycolmap.Image(name=name, keypoints=points.pixels[number - 1, rows], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    for xyz, rgb, track in zip(points.xyz, points.rgb, tracks, strict=True):
        model.add_point3D(xyz.astype(np.float64), _track(pycolmap, track), rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def _track(pycolmap: Any, elements: list[tuple[int, int]]) -> Any:
    track = pycolmap.Track()
    for image, point in elements:
        track.add_element(image, point)
    return track
