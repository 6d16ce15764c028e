"""Reads the cameras of a ``transforms.json``: nerfstudio, instant-ngp, Polycam, and Blender's NeRF-synthetic scenes."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nsvq_lightning.data.colmap import (
    LARGEST,
    LARGEST_SIDE,
    ColmapImage,
    ColmapModel,
    SceneError,
    check_name,
    find_model,
    import_pycolmap,
    read_model,
)
from nsvq_lightning.data.images import image_head
from nsvq_lightning.data.point_cloud import read_points, share_seen
from nsvq_lightning.rendering.camera import Camera

__all__ = ["read_poses", "transforms_files"]

log = logging.getLogger(__name__)

_TRANSFORMS, _TRAIN = "transforms.json", "transforms_train.json"
_TEST = ("transforms_test.json", "transforms_val.json")
"""Where the test views of a NeRF-synthetic scene are: the first of these that there is."""
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")
"""What may be missing at the end of a ``file_path``."""
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = "OPENCV_FISHEYE"
_UNROUNDED = 1e-3
"""How far the axes of a camera may be from a rotation's."""
_CLEARLY = 1.5
"""Ratio of points in view from which ``applied_transform`` is taken to be missing from the points."""

Kind = tuple[str, int, int, tuple[float, ...]]
"""COLMAP's name of a camera model, width, height, parameters."""


def read_poses(
    root: Path, model: str | None = None, observations: bool = False, allow_outside: bool = False
) -> ColmapModel:
    """The cameras and points of a scene folder: of its COLMAP model or, if there is none, of its transforms file.

    Args:
        root: Scene folder.
        model: Which one to read: a number N for ``sparse/N``, a folder with a COLMAP model or a ``.json`` file, both
            inside ``root``; None looks for them.
        observations: Also read which image saw which point, see :func:`nsvq_lightning.data.colmap.read_model`.
        allow_outside: Also allow photos and masks that are not in the scene folder.

    Raises:
        SceneError: There is no such model, it is damaged, or has cameras or names that cannot be used.
    """
    check_name(str(root.resolve()), "--data.root", allow_outside=True)
    files = transforms_files(root, model)
    if files:
        return _read_transforms(root, files, allow_outside)
    poses = read_model(root, observations, model)
    for image in poses.images:
        check_name(image.name, f"the COLMAP model of {root}", allow_outside)
    return poses


def transforms_files(root: Path, model: str | None = None) -> list[Path]:
    """The transforms files with the cameras of a scene folder; empty if these are in a COLMAP model.

    Of two files, the second has the test views.

    Args:
        root: Scene folder.
        model: See :func:`read_poses`.
    """
    if model is not None:
        return [root / model] if model.endswith(".json") else []
    if find_model(root) is None:
        if (root / _TRANSFORMS).is_file():
            return [root / _TRANSFORMS]
        if (root / _TRAIN).is_file():
            return [root / _TRAIN, *[root / name for name in _TEST if (root / name).is_file()][:1]]
    return []


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame of a transforms file; its own values come before those of the file."""

    file: Path
    position: int
    values: Mapping[str, Any]
    allow_outside: bool

    def error(self, problem: str, remedy: str = "export the file again") -> SceneError:
        return SceneError(f"{self.file}: frame {self.position} {problem}: {remedy}")

    def number(self, key: str, otherwise: float = 0.0) -> float:
        """A finite number.

        Raises:
            SceneError: It is something else.
        """
        value = self.values.get(key, otherwise)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            raise self.error(f"has {key} = {value!r}, which is no finite number")
        return float(value)

    @property
    def name(self) -> str:
        """Path of its photo inside the scene folder, with the suffix that is often left out."""
        given = self.values.get("file_path")
        if not isinstance(given, str) or not given:
            raise self.error("has no file_path")
        name = self._named(given)
        return next((name + suffix for suffix in _SUFFIXES if (self.file.parent / (name + suffix)).is_file()), name)

    @property
    def mask(self) -> Path | None:
        """File of its mask, if it names one."""
        given = self.values.get("mask_path")
        return self.file.parent / self._named(given) if isinstance(given, str) and given else None

    def _named(self, given: str) -> str:
        """A path inside the scene folder, unless others are allowed."""
        name = _plain(given)
        check_name(name, f"{self.file}: frame {self.position}", self.allow_outside)
        return name

    def kind(self) -> Kind:
        """Its camera.

        Raises:
            SceneError: A value is missing or out of range, or the camera's model is not supported.
        """
        width, height = self._size()
        fx, fy = self._focal("x", width), self._focal("y", height)
        lens = (fx, fy, self.number("cx", width / 2), self.number("cy", height / 2))
        radial = tuple(self.number(f"k{i}") for i in range(1, 5))
        tangential = self.number("p1"), self.number("p2")
        model = self.values.get("camera_model", _FISHEYE if self.values.get("is_fisheye") is True else "OPENCV")
        if model == _FISHEYE and not any(tangential):
            return _FISHEYE, width, height, (*lens, *radial)
        if model not in _PERSPECTIVE or radial[3]:
            distorted = f" and k4 = {radial[3]:g}" if model in _PERSPECTIVE else ""
            raise self.error(
                f"has camera_model {model}{distorted}, which cannot be read; PINHOLE, OPENCV (k1 to k3, p1, p2) and "
                "OPENCV_FISHEYE (k1 to k4) can",
                "export the photos undistorted, as PINHOLE",
            )
        if radial[2]:
            return "FULL_OPENCV", width, height, (*lens, *radial[:2], *tangential, radial[2], 0.0, 0.0, 0.0)
        if any(radial) or any(tangential):
            return "OPENCV", width, height, (*lens, *radial[:2], *tangential)
        return "PINHOLE", width, height, lens

    def _size(self) -> tuple[int, int]:
        if "w" not in self.values or "h" not in self.values:
            path = self.file.parent / self.name
            if not path.is_file():
                raise self.error(f"is of the photo {path}, which does not exist", "copy the photo there")
            return image_head(path).size
        size = round(self.number("w")), round(self.number("h"))
        if not 0 < min(size) <= max(size) <= LARGEST_SIDE:
            raise self.error(f"has size {size[0]}x{size[1]}; sides go from 1 to {LARGEST_SIDE}")
        return size

    def _focal(self, axis: str, side: int) -> float:
        """Focal length in pixels; one that is not given is that of the other axis."""
        other = "y" if axis == "x" else "x"
        for name in (axis, other):
            if f"fl_{name}" in self.values:
                focal = self.number(f"fl_{name}")
            elif f"camera_angle_{name}" in self.values:
                along = side if name == axis else self._size()[name == "y"]
                focal = along / 2 / max(math.tan(self.number(f"camera_angle_{name}") / 2), 1e-12)
            else:
                continue
            if not focal > 0:
                raise self.error(f"has the focal length {focal:g}")
            return focal
        raise self.error("has no focal length: neither fl_x nor camera_angle_x")

    def viewmat(self) -> NDArray[np.float64]:
        """World to camera ``[4, 4]``, x right, y down, z forward; the file has the inverse, y up, z backward.

        Raises:
            SceneError: It is no rigid motion.
        """
        try:
            matrix = np.array(self.values.get("transform_matrix"), np.float64)
        except (ValueError, TypeError):
            matrix = np.zeros(0)
        if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) <= LARGEST).all():
            raise self.error("has no transform_matrix of 4 by 4 finite numbers")
        # Blender's cameras may be scaled.
        axes = matrix[:3, :3] / np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-30)
        left, _, right = np.linalg.svd(axes)
        rotation = left @ right
        if np.abs(rotation - axes).max() > _UNROUNDED or np.linalg.det(rotation) < 0:
            raise self.error("has a transform_matrix that is no rotation: its axes are skewed or mirrored")
        viewmat = np.eye(4)
        viewmat[:3, :3] = (rotation * (1, -1, -1)).T
        viewmat[:3, 3] = -viewmat[:3, :3] @ matrix[:3, 3]
        return viewmat


def _read_transforms(root: Path, files: list[Path], allow_outside: bool) -> ColmapModel:
    heads, frames = [], []
    for file in files:
        head = _document(file)
        heads.append(head)
        frames.append({frame.name: frame for frame in _frames(file, head, allow_outside)})
    test = _test_names(files, heads, frames)
    chosen = dict(sorted({name: frame for part in frames for name, frame in part.items()}.items()))
    if test is not None:
        train_names, test_names = test
        chosen = {name: frame for name, frame in chosen.items() if name in train_names | test_names}
    kinds = {name: frame.kind() for name, frame in chosen.items()}
    numbers = {kind: number for number, kind in enumerate(dict.fromkeys(kinds.values()), start=1)}
    pycolmap = import_pycolmap()
    cameras = {
        number: pycolmap.Camera(model=model, width=width, height=height, params=list(params), camera_id=number)
        for (model, width, height, params), number in numbers.items()
    }
    folder = _common_folder(list(chosen))
    images = tuple(
        ColmapImage(name.removeprefix(f"{folder}/"), numbers[kinds[name]], frame.viewmat(), frame.mask)
        for name, frame in chosen.items()
    )
    points, colors = _points(root, heads[0], images, cameras, allow_outside)
    return ColmapModel(
        images=images,
        cameras=cameras,
        points=points,
        colors=colors,
        source=files[0].name,
        images_folder=folder,
        test=None if test is None else tuple(i for i, name in enumerate(chosen) if name in test[1]),
        synthetic=files[0].name == _TRAIN,
    )


def _document(file: Path) -> dict[str, Any]:
    try:
        document = json.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise SceneError(f"{file} does not exist: choose another file (--data.model)") from error
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{file} cannot be read ({error}): copy or export it again") from error
    if not isinstance(document, dict) or not isinstance(document.get("frames"), list) or not document["frames"]:
        raise SceneError(f"{file} has no list of frames, so it has no cameras: export it again")
    return document


def _frames(file: Path, head: dict[str, Any], allow_outside: bool) -> Iterator[_Frame]:
    """The frames of a file.

    Raises:
        SceneError: One is no table of values, or two are of the same photo.
    """
    shared = {key: value for key, value in head.items() if key not in ("frames", "file_path", "mask_path")}
    names: set[str] = set()
    for position, frame in enumerate(head["frames"]):
        if not isinstance(frame, dict):
            raise SceneError(f"{file}: frame {position} is no table of values: export the file again")
        values = {key: value for key, value in (shared | frame).items() if value is not None}
        made = _Frame(file, position, values, allow_outside)
        if made.name in names:
            raise made.error(f"is of {made.name}, which an earlier frame is of, too", "remove one of them")
        names.add(made.name)
        yield made


def _plain(path: str) -> str:
    return str(PurePosixPath(path.replace("\\", "/")))


def _common_folder(names: list[str]) -> str:
    """The folder at the top that all files are in; ``"."`` if there is none."""
    tops = {PurePosixPath(name).parts[0] if "/" in name else "." for name in names}
    return tops.pop() if len(tops) == 1 else "."


def _test_names(
    files: list[Path], heads: list[dict[str, Any]], frames: list[dict[str, _Frame]]
) -> tuple[set[str], set[str]] | None:
    """Names of the train and test photos, where the files say so.

    Raises:
        SceneError: A photo is in both.
    """
    if len(files) == 2:
        train, test = set(frames[0]), set(frames[1])
    else:
        given = [heads[0].get(f"{part}_filenames") for part in ("train", "test", "val")]
        train, *tests = ({_plain(str(n)) for n in names} if isinstance(names, list) else set() for names in given)
        test = tests[0] or tests[1]
        if not (train and test):
            return None
    if train & test:
        raise SceneError(f"{files[-1]}: {min(train & test)} is a train and a test photo: list it once")
    return train, test


def _points(
    root: Path, head: dict[str, Any], images: tuple[ColmapImage, ...], cameras: dict[int, Any], allow_outside: bool
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """The points that a file names, in the frame of its cameras; none if it names none.

    Programs that wrote ``applied_transform`` have applied it to the cameras, and most of them to the points; where it
    is missing from the points shows in how many of them the cameras see.
    """
    if not isinstance(name := head.get("ply_file_path"), str):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    check_name(_plain(name), f"ply_file_path in {root}", allow_outside)
    points, colors = read_points(root / _plain(name))
    try:
        applied = np.array(head.get("applied_transform"), np.float64)[:3]
    except (ValueError, TypeError, IndexError):
        return points, colors
    if applied.shape != (3, 4) or not np.isfinite(applied).all():
        return points, colors
    pinholes = [
        Camera(torch.from_numpy(lens.calibration_matrix()), torch.from_numpy(image.viewmat), lens.width, lens.height)
        for image in images
        for lens in (cameras[image.camera_id],)
    ]
    moved = points @ applied[:, :3].T + applied[:, 3]
    if share_seen(moved, pinholes) > _CLEARLY * share_seen(points, pinholes):
        log.info("%s: the points are not in the frame of the cameras: applied_transform moves them there", root / name)
        return moved, colors
    return points, colors
