"""Cameras along a path: through given ones, around what they look at; and those that JSON files list."""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.linalg import norm
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from nsvq_lightning.rendering.camera import Camera, camera_of
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.poses import looked_at, poses, up_of, view_from, view_towards
from nsvq_lightning.splats.conventions import Float64s

# File beside the scene of a run, or of INRIA's trainer, or two folders above it.
CAMERAS = "cameras.json"


def reframed(camera: Camera, width: int, height: int) -> Camera:
    """The camera with another picture size: all that it sees stays in view, centred, and looks as before."""
    fx, fy, cx, cy = camera.intrinsics
    factor = min(width / camera.width, height / camera.height)
    centre = width / 2 + factor * (cx - camera.width / 2), height / 2 + factor * (cy - camera.height / 2)
    lens = factor * fx, factor * fy, *centre
    return camera_of(camera.viewmat, lens, width, height, camera.near, camera.slope_limits)


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
    if len({camera.size for camera in cameras}) > 1:
        raise ValueError("cameras of a path must have one size; reframe them first")
    positions, rotations = poses(cameras)
    unit = float(np.median(norm(positions - positions.mean(0), axis=1))) or 1.0
    steps = _steps(positions, rotations, unit)
    kept = np.r_[True, steps > 1e-6]
    positions, rotations = positions[kept], rotations[kept]
    lenses = np.array([camera.intrinsics + camera.slope_limits for camera in cameras])[kept]
    if len(positions) == 1:
        return [cameras[0]] * frames
    at = np.r_[0.0, np.cumsum(steps[kept[1:]])]
    place = CubicSpline(at, positions, bc_type="natural")
    turn = RotationSpline(at, rotations)
    fine = np.linspace(0.0, at[-1], 16 * frames + 1)  # where the speed is measured
    way = np.r_[0.0, np.cumsum(_steps(place(fine), turn(fine), unit))]
    times = np.interp(np.linspace(0.0, way[-1], frames), way, fine)
    lenses = np.stack([np.interp(times, at, column) for column in lenses.T], axis=1)
    return [
        camera_of(view_from(matrix, position), lens[:4], *cameras[0].size, cameras[0].near, lens[4:])
        for matrix, position, lens in zip(turn(times).as_matrix(), place(times), lenses, strict=True)
    ]


def _steps(positions: Float64s, rotations: Rotation, unit: float) -> Float64s:
    """How far it is from each pose to the next, a turn by one radian counting as much as the distance ``unit``."""
    turns = (rotations[:-1].inv() * rotations[1:]).magnitude() if len(positions) > 1 else 0.0
    return norm(np.diff(positions, axis=0), axis=1) / unit + turns  # type: ignore[no-any-return]


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
    across /= norm(across)
    ahead = np.cross(up, across)
    arms = positions - middle
    x, y = arms @ across, arms @ ahead
    height = np.median(arms @ up)
    radius = np.median(np.hypot(x, y))
    # The arc that cameras fill: the circle without their largest gap.
    angles = np.sort(np.arctan2(y, x))
    gaps = np.diff(angles, append=angles[:1] + 2 * math.pi)
    widest = np.argmax(gaps)
    start, arc = angles[(widest + 1) % len(angles)], 2 * math.pi - gaps[widest]
    turns = 2 * math.pi * (np.arange(frames) / frames)
    if arc < math.radians(270):
        turns = arc * (0.5 + 0.5 * np.sin(turns))
    lens = np.median([camera.intrinsics + camera.slope_limits for camera in cameras], axis=0)
    first = cameras[0]
    path = []
    for angle in start + turns:
        eye = middle + height * up + radius * (math.cos(angle) * across + math.sin(angle) * ahead)
        path.append(camera_of(view_towards(middle, eye, up), lens[:4], *first.size, first.near, lens[4:]))
    return path


def read_camera_path(path: Path) -> tuple[list[Camera], float]:
    """The cameras of nerfstudio's camera path, and its frames per second.

    Of a file that has only ``keyframes``, these are the cameras. Poses are those of the scene: nerfstudio's own files
    fit where it has neither moved nor scaled the scene.

    Args:
        path: JSON with ``camera_path`` (``camera_to_world``, 16 numbers row by row; ``fov``, vertical, degrees), or
            ``keyframes`` (``matrix``, row by row or column by column).

    Raises:
        ValueError: It is not such a file, or has no size.
        OSError: It cannot be read.
    """
    with _refused(f"{path} is not a camera path as nerfstudio and the viewer write them"):
        content = json.loads(path.read_bytes())
        if (kind := content.get("camera_type", "perspective")) != "perspective":
            raise ValueError(f"its camera_type is {kind}, and only perspective can be rendered")
        entries = content.get("camera_path") or content["keyframes"]
        size = int(content["render_width"]), int(content["render_height"])
        cameras = [_entry_camera(entry, *size) for entry in entries]
        if not cameras:
            raise ValueError("it has no cameras")
        fps = float(content.get("fps", 24))
        if not 0 < fps < math.inf:
            raise ValueError(f"its fps is {fps:g}")
        return cameras, fps


@contextmanager
def _refused(sentence: str, advice: str = "") -> Iterator[None]:
    """Say with one sentence what else goes wrong where the content of a file is read, and why."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{sentence} ({reason}){advice}") from None


def _entry_camera(entry: Mapping[str, Any], width: int, height: int) -> Camera:
    numbers = entry["camera_to_world"] if "camera_to_world" in entry else entry["matrix"]
    pose = np.array(json.loads(numbers) if isinstance(numbers, str) else numbers, np.float64).reshape(4, 4)
    if np.abs(pose[3, :3]).max() > np.abs(pose[:3, 3]).max():
        pose = pose.T
    if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        raise ValueError("a pose is not a rigid matrix of 4x4")
    field = float(entry["fov"])
    if not 0 < field < 180:
        raise ValueError(f"a field of view is {field} degrees")
    focal = 0.5 * height / math.tan(math.radians(field) / 2)
    rotation = pose[:3, :3] * [1, -1, -1]  # from y up, looking along -z, to y down, looking along z
    return camera_of(view_from(rotation, pose[:3, 3]), (focal, focal, width / 2, height / 2), width, height)


# Pixels of a picture's side.
_MAX_SIDE = 1 << 16


def read_cameras(path: Path) -> dict[str, Camera]:
    """The cameras of photos by name, as a run (:func:`nsvq_lightning.report.viewer.write_cameras`) and INRIA list them.

    INRIA's trainer has principal points in the middle and near planes at 0.2, and lists cameras in the size of the
    photos, which it trains with as its ``cfg_args`` beside the list says.

    Args:
        path: JSON, a list of ``img_name``, ``width``, ``height``, ``fx``, ``fy`` (pixels), ``rotation`` (from the
            camera to the world, three rows) and ``position`` (the camera's, scene units), in our axes.

    Raises:
        ValueError: It is no such list.
        OSError: It cannot be read.
    """
    cameras = {}
    arguments = arguments_of(path.parent)
    advice = ": move it away, or name the photos with --data.root"
    with _refused(f"{path} is no list of cameras as INRIA's trainer writes it", advice):
        for entry in json.loads(path.read_bytes()):
            rotation = np.array(entry["rotation"], np.float64)
            position = np.array(entry["position"], np.float64)
            width, height = int(entry["width"]), int(entry["height"])
            if max(width, height) > _MAX_SIDE:
                raise ValueError(f"a picture of {width}x{height}")
            lens = entry["fx"], entry["fy"], entry.get("cx", width / 2), entry.get("cy", height / 2)
            name = str(entry["img_name"])
            if name in cameras:  # the names of photos in several folders, without these
                name = f"{name} ({entry['id']})"
            times = 1 if "cx" in entry else _times_smaller(arguments, width)
            small = tuple(number / times for number in lens)
            size = round(width / times), round(height / times)
            cameras[name] = camera_of(view_from(rotation, position), small, *size, entry.get("near", NEAR))
    if not cameras:
        return {}
    near = Frame.around(poses(list(cameras.values()))[0]).near
    return {name: replace(camera, near=min(near, camera.near)) for name, camera in cameras.items()}


def arguments_of(folder: Path) -> str:
    """What INRIA's trainer or this one, whose folder it is, was called with; nothing in another folder."""
    paths = [path for name in ("cfg_args", "config.yaml") if (path := folder / name).is_file()]
    return paths[0].read_text(encoding="utf-8", errors="replace") if paths else ""


def _times_smaller(arguments: str, width: int) -> float:
    """How many times smaller than the photos, ``width`` pixels wide, INRIA's trainer was asked to train them."""
    found = re.search(r"\bresolution=(-?\d+)", arguments)
    asked = int(found[1]) if found else -1
    folder = re.search(r"\bimages='[^']*_([248])'", arguments)
    smaller = float(folder[1]) if folder else 1.0
    if asked in (1, 2, 4, 8):
        return smaller * asked
    return width / asked if asked > 0 else max(smaller, width / 1600)
