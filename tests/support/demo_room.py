"""The demo scene: a textured room with boxes, balls and pictures, its lamp and its cameras, as a COLMAP folder.

``python tests/support/demo_room.py`` writes what the package contains of it; tests make smaller ones. Textures are
photographs in the public domain that come with scikit-image. World axes follow COLMAP's camera axes: y points down, the
floor is y = 0, one unit is a metre.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import torch
from numpy.typing import NDArray
from raytrace import Array, Lamp, Quad, Room, Sphere, Surface
from skimage import data as photos

from nsvq_lightning.data.colmap import import_pycolmap
from nsvq_lightning.random import generator

_SUPERSAMPLING = 2
_POINT_NOISE = 0.002  # metres; about the error of a triangulated point at this size
_VIEWS_A_POINT = 3  # COLMAP's mapper does not keep points with shorter tracks

HALF, HEIGHT = 3.0, 2.7
"""Half the side of the room and its height."""
TEXELS = 140
"""Texture resolution, texels per metre: about one per sample of a 320-pixel picture across the room."""


def to_srgb(linear: Array) -> NDArray[np.uint8]:
    """Linear light ``[..., 3]`` to 8-bit sRGB."""
    linear = linear.clip(0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (encoded * 255 + 0.5).astype(np.uint8)


@cache
def demo_room() -> Room:
    """The room with its baked light."""
    lamp = Lamp(_vector(0.5, -HEIGHT + 0.03, -0.4), side=1.0, power=7.5, ambient=0.34)
    return Room([*_shell(), *_pictures(), *_furniture(), *_balls(), _panel(lamp)], lamp)


def demo_poses(views: int) -> NDArray[np.float64]:
    """World-to-camera matrices ``[views, 4, 4]`` on an undulating orbit inside the room, looking across its middle."""
    turn = 2 * np.pi * np.arange(views) / views
    radius = 2.25 + 0.25 * np.cos(3 * turn)
    centres = np.stack([radius * np.cos(turn), -1.3 - 0.4 * np.sin(2 * turn), radius * np.sin(turn)], -1)
    targets = np.stack([0.25 * np.sin(5 * turn), -0.8 + 0.1 * np.cos(4 * turn), 0.25 * np.cos(5 * turn)], -1)
    forward = _unit(targets - centres)
    right = _unit(np.cross([0.0, 1.0, 0.0], forward))
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    poses[:, :3, 3] = -np.einsum("vij,vj->vi", poses[:, :3, :3], centres)
    return poses


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def _vector(*xyz: float) -> Array:
    return np.array(xyz, np.float32)


def _linear(image: NDArray[np.uint8], tint: tuple[float, float, float] = (1, 1, 1)) -> Array:
    """8-bit sRGB (or grey) picture to linear albedo ``[h, w, 3]``, darkened to the range of real paint."""
    rgb = np.repeat(image[..., None], 3, axis=-1) if image.ndim == 2 else image[..., :3]
    encoded = rgb.astype(np.float32) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return (0.85 * linear).astype(np.float32) * _vector(*tint)


def _resized(texture: Array, width: float, height: float) -> Array:
    """Texture at the resolution it is seen at, so that sampling it does not alias."""
    size = (max(2, round(width * TEXELS)), max(2, round(height * TEXELS)))
    shrinks = size[0] < texture.shape[1]
    return cv2.resize(texture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC).clip(0, 1)  # type: ignore[no-any-return]


def _tiled(texture: Array, width: float, height: float, tile: float) -> Array:
    """A square texture of side ``tile`` metres repeated over ``width`` × ``height`` metres, mirrored at the seams."""
    piece = _resized(texture, tile, tile)
    piece = np.concatenate([piece, piece[:, ::-1]], axis=1)
    piece = np.concatenate([piece, piece[::-1]], axis=0)
    rows, columns = round(height * TEXELS), round(width * TEXELS)
    repeats = (-(-rows // piece.shape[0]), -(-columns // piece.shape[1]), 1)
    return np.tile(piece, repeats)[:rows, :columns]


def _chequered(light: Array, dark: Array, squares_x: int, squares_y: int) -> Array:
    """Two textures ``[h, w, 3]`` of the same size in alternating squares."""
    y = np.arange(light.shape[0]) * squares_y // light.shape[0]
    x = np.arange(light.shape[1]) * squares_x // light.shape[1]
    return np.where(((y[:, None] + x) % 2 == 0)[..., None], light, dark)


def _shell() -> list[Surface]:
    """Floor, ceiling and four walls, facing inwards."""
    side, a = 2 * HALF, HALF
    gravel, brick = _linear(photos.gravel()), _linear(np.rot90(photos.brick()), (1.0, 0.62, 0.46))
    stone = _tiled(gravel, side, side, 1.5)
    tiles = _chequered(stone**0.5 * _vector(0.8, 0.76, 0.68), stone**0.7 * _vector(0.4, 0.3, 0.24), 10, 10)
    plaster = 0.55 + 0.5 * _tiled(gravel, side, HEIGHT, 2.0)
    up, x, z = _vector(0, HEIGHT, 0), _vector(side, 0, 0), _vector(0, 0, side)
    return [
        Quad(_vector(-a, 0, a), x, -z, tiles),
        Quad(_vector(-a, -HEIGHT, -a), x, z, (0.55 + 0.5 * _tiled(gravel, side, side, 2.0)) * _vector(0.8, 0.8, 0.78)),
        Quad(_vector(a, -HEIGHT, -a), -x, up, _tiled(1.3 * brick, side, HEIGHT, 1.6)),
        Quad(_vector(-a, -HEIGHT, a), x, up, plaster * _vector(0.42, 0.62, 0.72)),
        Quad(_vector(a, -HEIGHT, a), -z, up, plaster * _vector(0.78, 0.66, 0.42)),
        Quad(_vector(-a, -HEIGHT, -a), z, up, plaster * _vector(0.55, 0.68, 0.45)),
    ]


def _framed(photo: NDArray[np.uint8], width: float, height: float) -> Array:
    """A photograph behind a dark wooden frame."""
    picture = _resized(_linear(photo), width, height)
    border = round(0.05 * TEXELS)
    framed = np.broadcast_to(_vector(0.09, 0.05, 0.03), picture.shape).copy()
    framed[border:-border, border:-border] = picture[border:-border, border:-border]
    return framed


def _pictures() -> list[Surface]:
    """Photographs on the walls, one centimetre in front of them."""
    d, top = HALF - 0.01, -2.0

    def hang(photo: Callable[[], NDArray[np.uint8]], corner: Array, across: Array, height: float) -> Quad:
        texture = _framed(photo(), float(np.linalg.norm(across)), height)
        return Quad(corner, across, _vector(0, height, 0), texture)

    return [
        hang(photos.astronaut, _vector(1.9, top, -d), _vector(-1.3, 0, 0), 1.3),
        hang(photos.rocket, _vector(-0.4, top, -d), _vector(-1.5, 0, 0), 1.0),
        hang(photos.coffee, _vector(-2.1, top, d), _vector(1.8, 0, 0), 1.2),
        hang(photos.colorwheel, _vector(0.5, top, d), _vector(1.5, 0, 0), 1.3),
        hang(photos.chelsea, _vector(d, top, 1.9), _vector(0, 0, -1.8), 1.2),
        hang(photos.retina, _vector(d, top, -0.5), _vector(0, 0, -1.2), 1.2),
        hang(photos.immunohistochemistry, _vector(-d, top, -1.9), _vector(0, 0, 1.3), 1.3),
        hang(photos.camera, _vector(-d, top, 0.3), _vector(0, 0, 1.3), 1.3),
    ]


def _box(centre: tuple[float, float], size: tuple[float, float, float], turn: float, texture: Array) -> list[Surface]:
    """Four sides and the lid of a box on the floor, its middle at x and z; the texture is stretched over each face."""
    width, height, depth = size
    right = _vector(np.cos(turn), 0, np.sin(turn)) * width
    away = _vector(-np.sin(turn), 0, np.cos(turn)) * depth
    down = _vector(0, height, 0)
    corner = (_vector(centre[0], -height, centre[1]) - 0.5 * (right + away)).astype(np.float32)
    side, end = _resized(texture, width, height), _resized(texture, depth, height)
    return [
        Quad(corner, right, down, side),
        Quad(corner + right, away, down, end),
        Quad(corner + right + away, -right, down, side),
        Quad(corner + away, -away, down, end),
        Quad(corner + away, right, -away, _resized(texture, width, depth)),
    ]


def _furniture() -> list[Surface]:
    """Three boxes and a rug."""
    grass = _tiled(_linear(photos.grass(), (0.75, 1.0, 0.45)), 2.6, 1.8, 0.9)
    rug = Quad(_vector(-1.2, -0.01, 0.9), _vector(2.6, 0, 0), _vector(0, 0, -1.8), (grass**0.7).astype(np.float32))
    gravel = _linear(photos.gravel())
    column = _chequered(gravel**0.5 * _vector(0.9, 0.62, 0.1), gravel**0.6 * _vector(0.1, 0.32, 0.3), 2, 5)
    return [
        rug,
        *_box((-0.55, -0.35), (0.75, 0.8, 0.75), 0.5, _linear(photos.coins(), (1.0, 0.72, 0.35))),
        *_box((0.75, 0.45), (0.6, 0.45, 0.9), -0.35, _linear(photos.page())),
        *_box((0.45, -0.75), (0.4, 1.0, 0.4), 0.2, column),
    ]


def _balls() -> list[Surface]:
    """A glossy red ball, and matt ones with a texture."""
    plain = np.broadcast_to(_vector(0.55, 0.03, 0.03), (4, 8, 3)).copy()
    white, blue = (np.broadcast_to(_vector(*c), (256, 512, 3)) for c in ((0.8, 0.8, 0.75), (0.05, 0.12, 0.5)))
    moon = _linear(photos.moon())
    moon = cv2.resize(np.concatenate([moon, moon[:, ::-1]], axis=1), (512, 256), interpolation=cv2.INTER_AREA)
    return [
        Sphere(_vector(-0.5, -1.08, -0.35), 0.28, plain, gloss=0.8),
        Sphere(_vector(-0.45, -0.33, 0.6), 0.33, _chequered(white, blue, 12, 6)),
        Sphere(_vector(0.8, -0.7, 0.5), 0.25, (1.6 * moon).clip(0, 0.9)),
    ]


def _panel(lamp: Lamp) -> Surface:
    """The visible panel of the lamp."""
    s = lamp.side
    corner = lamp.centre + _vector(-s / 2, -0.01, -s / 2)
    return Quad(corner, _vector(s, 0, 0), _vector(0, 0, s), np.ones((2, 2, 3), np.float32), glow=1.0)


@dataclass(frozen=True)
class Lens:
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
    root: Path,
    views: int = 40,
    width: int = 320,
    height: int = 240,
    points: int = 4000,
    suffix: str = ".png",
    tracks: bool = True,
) -> Path:
    """Render the demo room and write it as a COLMAP scene, with or without tracks, to ``root``, which is returned."""
    room, lens, poses = demo_room(), Lens(width, height), demo_poses(views)
    names = [f"view_{i:03d}{suffix}" for i in range(views)]
    (root / "images").mkdir(parents=True)
    for name, pose in zip(names, poses, strict=True):
        picture = PIL.Image.fromarray(render_view(room, pose, width, height))
        picture.save(root / "images" / name, quality=92, method=6)  # as WebP; PNG knows no quality
    found = surface_points(room, lens, poses, points)
    found.seen[:] &= tracks
    _write_model(root / "sparse" / "0", lens, names, poses, found)
    return root


def render_view(room: Room, pose: NDArray[np.float64], width: int, height: int) -> NDArray[np.uint8]:
    """Anti-aliased sRGB picture ``[H, W, 3]`` of the room from a world-to-camera ``pose [4, 4]``."""
    n = _SUPERSAMPLING
    linear = room.colours(*Lens(width, height).rays(pose, n)).clip(0, 1)
    return to_srgb(linear.reshape(height, n, width, n, 3).mean(axis=(1, 3)))


def _centre(pose: NDArray[np.float64]) -> Array:
    return (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)


def surface_points(room: Room, lens: Lens, poses: NDArray[np.float64], count: int) -> _Points:
    """Random surface points that at least three views see (or all views, if there are fewer)."""
    rng = generator(0, 0, "demo points")
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


def _sight(room: Room, lens: Lens, pose: Any, xyz: Array) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels ``[P, 2]`` of points ``[P, 3]``, and whether the view sees them unoccluded."""
    pixels, inside = lens.project(pose, xyz)
    centre = _centre(pose)
    inside[inside] = room.trace(centre, xyz[inside] - centre)[0] > 0.995
    return pixels, inside


def _write_model(folder: Path, lens: Lens, names: list[str], poses: NDArray[np.float64], points: _Points) -> None:
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
    for xyz, rgb, elements in zip(points.xyz, points.rgb, tracks, strict=True):
        track = pycolmap.Track()
        for image, point in elements:
            track.add_element(image, point)
        model.add_point3D(xyz.astype(np.float64), track, rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def main() -> None:
    """Write the scene that the package contains."""
    from nsvq_lightning.data.datamodule import DEMO  # imports Lightning, which most tests can do without

    shutil.rmtree(DEMO, ignore_errors=True)
    write_synthetic_scene(DEMO, suffix=".webp", tracks=False)
    for table in ("rigs", "frames"):  # repeat what the other tables say, for COLMAP 4
        (DEMO / "sparse" / "0" / f"{table}.bin").unlink()


if __name__ == "__main__":
    main()
