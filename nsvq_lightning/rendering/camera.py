"""A pinhole camera; what several have in common (where up is, what they look at); and cameras along a path."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from nsvq_lightning.rendering.constants import FRUSTUM_MARGIN


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera in COLMAP's conventions: x right, y down, z forward; pixel centres at .5.

    Attributes:
        K: Intrinsics ``[3, 3]`` in pixels, principal point included; skew must be 0.
        viewmat: World to camera, rigid, ``[4, 4]``, scene units.
        width: Image width in pixels.
        height: Image height in pixels.

    Raises:
        ValueError: A matrix has another shape, the image is empty, the focal lengths are not positive and finite, or
            there is skew.
    """

    K: Tensor
    viewmat: Tensor
    width: int
    height: int
    _intrinsics: tuple[float, float, float, float] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        for name, matrix, side in (("K", self.K, 3), ("viewmat", self.viewmat, 4)):
            if tuple(matrix.shape) != (side, side):
                raise ValueError(f"Camera.{name} must have shape [{side}, {side}], got {list(matrix.shape)}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"Camera needs at least one pixel, got {self.width}x{self.height}")
        if self._intrinsics is not None:
            return
        fx, fy = float(self.K[0, 0]), float(self.K[1, 1])
        # Kept as Python floats: reading them from an accelerator would stall it at every render.
        object.__setattr__(self, "_intrinsics", (fx, fy, float(self.K[0, 2]), float(self.K[1, 2])))
        if not (0 < fx < math.inf and 0 < fy < math.inf):
            raise ValueError(f"Camera.K needs positive, finite focal lengths, got fx={fx}, fy={fy}")
        if self.K[0, 1] != 0:
            raise ValueError(f"Camera.K must be without skew, got {float(self.K[0, 1])}: no back-end renders it")

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """``(fx, fy, cx, cy)`` in pixels."""
        assert self._intrinsics is not None  # set by __post_init__
        return self._intrinsics

    @property
    def slope_limits(self) -> tuple[float, float, float, float]:
        """Lowest and highest x/z, then y/z, at which a Jacobian is evaluated: a margin beyond the image."""
        fx, fy, cx, cy = self.intrinsics
        margin_x, margin_y = 0.5 * FRUSTUM_MARGIN * self.width / fx, 0.5 * FRUSTUM_MARGIN * self.height / fy
        return (
            -cx / fx - margin_x, (self.width - cx) / fx + margin_x,
            -cy / fy - margin_y, (self.height - cy) / fy + margin_y,
        )  # fmt: skip

    @property
    def packed_view(self) -> list[float]:
        """Rotation row by row, translation and camera position: 15 numbers in float64, the same on every machine."""
        *rows, _ = self.viewmat.detach().to("cpu", torch.float64).tolist()
        rotation, translation = [row[:3] for row in rows], [row[3] for row in rows]
        position = [-sum(row[k] * t for row, t in zip(rotation, translation, strict=True)) for k in range(3)]
        return [*(x for row in rotation for x in row), *translation, *position]

    @property
    def position(self) -> Tensor:
        """Camera centre ``[3]`` in world coordinates."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None, **_: object) -> "Camera":
        """The camera with both matrices on ``device`` and in ``dtype``; the same object if they already are."""
        K, viewmat = (matrix.to(device=device, dtype=dtype) for matrix in (self.K, self.viewmat))
        if K is self.K and viewmat is self.viewmat:
            return self
        return Camera(K, viewmat, self.width, self.height, self._intrinsics)


# Weight of what decides where cameras that all look the same way leave a direction open.
LITTLE = 1e-5


def poses(cameras: Sequence[Camera]) -> tuple[NDArray[np.float64], Rotation]:
    """Positions ``[N, 3]``, and rotations from camera to world."""
    packed = np.array([camera.packed_view for camera in cameras])
    return packed[:, 12:], Rotation.from_matrix(packed[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1))


def looked_at(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """The point ``[3]`` nearest to all lines of sight; where they are parallel, one in front of the cameras."""
    positions, rotations = poses(cameras)
    forward = rotations.as_matrix()[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    spread = np.linalg.norm(positions - positions.mean(0), axis=1).max() or 1.0
    ahead = positions.mean(0) + 2 * spread * forward.mean(0)
    weight = LITTLE * len(positions)
    total = across.sum(0) + weight * np.eye(3)
    return np.linalg.solve(total, np.einsum("nij,nj->i", across, positions) + weight * ahead)


def up_of(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """The direction ``[3]`` that is up for cameras most of which are held level, unit length.

    It is at right angles to where their right is, the sum of the sines of their rolls being least, so that a minority
    of photos in portrait format or askew does not count; where that leaves a choice, it is near their upper edges.
    Looking up or down does not matter.
    """
    axes = poses(cameras)[1].as_matrix()
    right, upper = axes[:, :, 0], -axes[:, :, 1].mean(0)
    if np.linalg.norm(upper) < 0.1:  # they are turned in all directions
        return np.asarray(-axes[0, :, 1])
    weights = np.ones(len(axes))
    for _ in range(20):  # weighted again by how level they are
        level = (weights * right.T) @ right / weights.sum()
        up = np.linalg.solve(level + LITTLE * np.eye(3), upper)
        up /= np.linalg.norm(up)
        weights = 1 / np.maximum(np.abs(right @ up), 0.02)  # sine of the roll below which a camera counts as level
    return up


def reframed(camera: Camera, width: int, height: int) -> Camera:
    """The camera with another picture size: all that it sees stays in view, centred."""
    fx, fy, cx, cy = camera.intrinsics
    factor = min(width / camera.width, height / camera.height)
    centre = width / 2 + factor * (cx - camera.width / 2), height / 2 + factor * (cy - camera.height / 2)
    return _camera(camera.viewmat, (factor * fx, factor * fy, *centre), width, height)


def smooth_path(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A smooth path through cameras, in their order, at even speed.

    Positions follow a cubic spline and rotations one with continuous angular acceleration; speed counts both, a turn by
    one radian as much as the typical distance between the cameras and the middle of them.

    Args:
        cameras: At least one, all of the same size; those that repeat the one before are left out.
        frames: Number of cameras to return, the first and the last of which are the first and the last given.

    Raises:
        ValueError: There are no cameras, or they have different sizes.
    """
    if not cameras or frames < 1:
        raise ValueError(f"a path needs at least one camera and one frame, got {len(cameras)} and {frames}")
    width, height = cameras[0].width, cameras[0].height
    if any((camera.width, camera.height) != (width, height) for camera in cameras):
        raise ValueError("cameras of a path must have one size; reframe them first")
    positions, rotations = poses(cameras)
    unit = float(np.median(np.linalg.norm(positions - positions.mean(0), axis=1))) or 1.0
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1) / unit
    steps += (rotations[:-1].inv() * rotations[1:]).magnitude() if len(cameras) > 1 else 0.0
    kept = np.concatenate([[True], steps > 1e-6])
    positions, rotations = positions[kept], rotations[kept]
    intrinsics = np.array([camera.intrinsics for camera in cameras])[kept]
    if len(positions) == 1:
        return [cameras[0]] * frames
    at = np.concatenate([[0.0], np.cumsum(steps[kept[1:]])])
    place = CubicSpline(at, positions, bc_type="natural")
    turn = RotationSpline(at, rotations)
    fine = np.linspace(0.0, at[-1], 16 * frames + 1)  # where the speed is measured
    moved = np.linalg.norm(np.diff(place(fine), axis=0), axis=1) / unit
    turned = turn(fine)
    moved += (turned[:-1].inv() * turned[1:]).magnitude()
    way = np.concatenate([[0.0], np.cumsum(moved)])
    times = np.interp(np.linspace(0.0, way[-1], frames), way, fine)
    lenses = np.stack([np.interp(times, at, column) for column in intrinsics.T], axis=1)
    matrices = turn(times).as_matrix()
    return [
        _camera(_view(matrix, position), tuple(lens), width, height)
        for matrix, position, lens in zip(matrices, place(times), lenses, strict=True)
    ]


def orbit(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A closed path around the point that cameras look at, at their median distance, height and focal length.

    Cameras that leave a gap of more than a quarter of the circle have not seen that side: the path then swings along
    the arc that they fill instead of going all the way round.

    Args:
        cameras: At least one, most of them held level.
        frames: Number of cameras to return, evenly spaced in time on the loop.

    Raises:
        ValueError: There are no cameras.
    """
    if not cameras or frames < 1:
        raise ValueError(f"an orbit needs at least one camera and one frame, got {len(cameras)} and {frames}")
    positions, _ = poses(cameras)
    middle, up = looked_at(cameras), up_of(cameras)
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    ahead = np.cross(up, across)
    arms = positions - middle
    height, radius = float(np.median(arms @ up)), float(np.median(np.hypot(arms @ across, arms @ ahead)))
    start, arc = _arc(np.arctan2(arms @ ahead, arms @ across))
    share = np.arange(frames) / frames
    swing = 0.5 + 0.5 * np.sin(2 * math.pi * share)
    angles = start + (2 * math.pi * share if arc >= math.radians(270) else arc * swing)
    lens = tuple(np.median([camera.intrinsics for camera in cameras], axis=0))
    path = []
    for angle in angles:
        eye = middle + height * up + radius * (math.cos(angle) * across + math.sin(angle) * ahead)
        path.append(_camera(view_towards(middle, eye, up), lens, cameras[0].width, cameras[0].height))
    return path


def view_towards(target: NDArray[np.float64], eye: NDArray[np.float64], up: NDArray[np.float64]) -> Tensor:
    """World to camera ``[4, 4]`` float32: from ``eye [3]`` a camera looks at ``target [3]``, with ``up [3]`` above."""
    forward = (target - eye) / (np.linalg.norm(target - eye) or 1.0)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right) or 1.0
    return _view(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


def read_camera_path(path: Path, width: int | None = None, height: int | None = None) -> tuple[list[Camera], float]:
    """The cameras of nerfstudio's camera path, and its frames per second.

    Of a file that has only ``keyframes``, these are the cameras. Poses are those of the scene: nerfstudio's own files
    fit where it has neither moved nor scaled the scene.

    Args:
        path: JSON with ``camera_path`` (``camera_to_world``, 16 numbers row by row; ``fov``, vertical, degrees), or
            ``keyframes`` (``matrix``, row by row or column by column).
        width: Pixels; by default the file's.
        height: Pixels; by default the file's.

    Raises:
        ValueError: It is not such a file, or has no size and none is given.
        OSError: It cannot be read.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        entries = content.get("camera_path") or content["keyframes"]
        width, height = width or int(content["render_width"]), height or int(content["render_height"])
        cameras = [_entry_camera(entry, width, height) for entry in entries]
        if not cameras:
            raise ValueError("it has no cameras")
        return cameras, float(content.get("fps", 24))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is not a camera path as nerfstudio and the viewer write them: {reason}") from None


def _entry_camera(entry: Mapping[str, Any], width: int, height: int) -> Camera:
    numbers = entry["camera_to_world"] if "camera_to_world" in entry else entry["matrix"]
    pose = np.array(json.loads(numbers) if isinstance(numbers, str) else numbers, np.float64).reshape(4, 4)
    if np.abs(pose[3, :3]).max() > np.abs(pose[:3, 3]).max():
        pose = pose.T
    rotation, field = pose[:3, :3], float(entry["fov"])
    if not (np.isfinite(pose).all() and np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6)):
        raise ValueError("a pose is not a rigid matrix of 4x4")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError("a pose is not a rotation and a position")
    if not 0 < field < 180:
        raise ValueError(f"a field of view is {field} degrees")
    focal = 0.5 * height / math.tan(math.radians(field) / 2)
    rotation = rotation * [1, -1, -1]  # from y up, looking along -z, to y down, looking along z
    return _camera(_view(rotation, pose[:3, 3]), (focal, focal, width / 2, height / 2), width, height)


def _arc(angles: NDArray[np.float64]) -> tuple[float, float]:
    """Start and length of the arc that angles fill: the circle without their largest gap."""
    ordered = np.sort(angles)
    gaps = np.diff(np.concatenate([ordered, ordered[:1] + 2 * math.pi]))
    widest = int(np.argmax(gaps))
    return float(ordered[(widest + 1) % len(ordered)]), float(2 * math.pi - gaps[widest])


def _view(rotation: NDArray[np.float64], position: NDArray[np.float64]) -> torch.Tensor:
    """World to camera ``[4, 4]`` float32, from the rotation to the world and the position in it."""
    view = np.eye(4)
    view[:3, :3] = rotation.T
    view[:3, 3] = -rotation.T @ position
    return torch.from_numpy(view.astype(np.float32))


def _camera(viewmat: torch.Tensor, lens: tuple[float, ...], width: int, height: int) -> Camera:
    fx, fy, cx, cy = (float(number) for number in lens)
    return Camera(torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), viewmat, width, height)
