"""Reads a ``transforms.json``: nerfstudio, instant-ngp, Polycam, and Blender's NeRF-synthetic scenes.

The file has the cameras; the points to start from are those of a ``.ply`` file, or random ones where the cameras look.
"""

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from nsvq_lightning.data import PANORAMA, colmap
from nsvq_lightning.data.colmap import ColmapImage, ColmapModel, SceneError, check_name
from nsvq_lightning.data.images import image_head
from nsvq_lightning.data.photo_files import locate
from nsvq_lightning.data.points import cloud_in, read_points
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.poses import looked_at, poses
from nsvq_lightning.splats.conventions import Float64s, Int64s, Uint8s

log = logging.getLogger(__name__)


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
    root = root.expanduser()
    check_name(str(root.resolve()), "--data.root", allow_outside=True)
    files = [root / model] if model is not None and model.endswith(".json") else []
    if model is None and colmap.find_model(root) is None:
        single, train, *tests = (root / f"transforms{part}.json" for part in ("", "_train", "_test", "_val"))
        if single.is_file():
            files = [single]
        elif train.is_file():
            files = [train, *[test for test in tests if test.is_file()][:1]]  # the second one has the test views
    if files:
        poses = _read_transforms(root, files, allow_outside)
        return poses if len(poses.points) else _with_colmap_points(poses, root)
    poses = colmap.read_model(root, observations, model)
    cloud = cloud_in([colmap.model_files(root, model)["images"].parent, root]) if not len(poses.points) else None
    if cloud is None:
        return poses
    log.info("%s has no points in its COLMAP model: those of %s take their place", root, cloud)
    points, colors = read_points(cloud)
    return replace(poses, points=points, colors=colors)


def _with_colmap_points(poses: ColmapModel, root: Path) -> ColmapModel:
    """Cameras with the points of the only COLMAP model in the folder that they may have been made from, if any.

    Programs turn, move and scale that model; the photos that both have say how.
    """
    models = colmap.other_models(root)
    if len(models) != 1:
        return poses
    try:
        found = colmap.read_model(root, chosen=models[0])
        moved = colmap.alignment(found, poses)
    except SceneError as error:
        log.warning("the points of %s are not used: %s", root / models[0], error)
        return poses
    log.info("%s names no points: those of %s are used", root / poses.source, root / models[0])
    return replace(poses, points=found.points @ moved[:3, :3].T + moved[:3, 3], colors=found.colors)


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame of a transforms file; its own values come before those of the file."""

    file: Path
    position: int
    values: Mapping[str, Any]
    photo: Path = Path()
    mask: Path | None = None

    def error(self, problem: str, remedy: str = "export the file again") -> SceneError:
        name = self.values.get("file_path")
        return SceneError(f"{self.file}: frame {self.position} {problem} (its file_path is {name!r}): {remedy}")

    def number(self, key: str, otherwise: float = 0.0) -> float:
        """A finite number.

        Raises:
            SceneError: It is something else.
        """
        value = self.values.get(key, otherwise)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= colmap.LARGEST:
            raise self.error(f"has {key} = {value!r}, which is no finite number")
        return float(value)

    def path(self, key: str) -> str | None:
        """A path that it gives, with slashes; None if it gives none."""
        given = self.values.get(key)
        return _plain(given) if isinstance(given, str) and given else None

    @property
    def name(self) -> str:
        """Path of its photo, relative to the scene folder."""
        folder = self.file.parent
        return str(self.photo.relative_to(folder) if self.photo.is_relative_to(folder) else self.photo)

    def lens(self) -> tuple[str, int, int, tuple[float, ...]]:
        """Its camera: COLMAP's name of the model, width, height, parameters.

        Raises:
            SceneError: A value is missing or out of range, or the camera's model is not supported.
        """
        width, height = self._size()
        fx, fy = self._focal("x", width), self._focal("y", height)
        pinhole = (fx, fy, self.number("cx", width / 2), self.number("cy", height / 2))
        radial = tuple(self.number(f"k{i}") for i in range(1, 5))
        tangential = self.number("p1"), self.number("p2")
        fisheye, perspective = "OPENCV_FISHEYE", ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        model = self.values.get("camera_model", fisheye if self.values.get("is_fisheye") is True else "OPENCV")
        if model == fisheye and not any(tangential):
            return fisheye, width, height, (*pinhole, *radial)
        if model not in perspective or radial[3]:
            distorted = f" and k4 = {radial[3]:g}" if model in perspective else ""
            raise self.error(
                f"has camera_model {model}{distorted}, which cannot be read; PINHOLE, OPENCV (k1 to k3, p1, p2) and "
                "OPENCV_FISHEYE (k1 to k4) can",
                PANORAMA if model == "EQUIRECTANGULAR" else "export the photos undistorted, as PINHOLE",
            )
        if any(radial) or any(tangential):
            return "FULL_OPENCV", width, height, (*pinhole, *radial[:2], *tangential, radial[2], 0.0, 0.0, 0.0)
        return "PINHOLE", width, height, pinhole

    def _size(self) -> tuple[int, int]:
        if "w" not in self.values or "h" not in self.values:
            if not self.photo.is_file():
                raise self.error(f"is of the photo {self.photo}, which does not exist", "copy the photo there")
            return image_head(self.photo).size
        size = round(self.number("w")), round(self.number("h"))
        if not 0 < min(size) <= max(size) <= colmap.LARGEST_SIDE:
            raise self.error(f"has size {size[0]}x{size[1]}; sides go from 1 to {colmap.LARGEST_SIDE}")
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

    def viewmat(self) -> Float64s:
        """World to camera ``[4, 4]``, x right, y down, z forward; the file has the inverse, y up, z backward.

        Raises:
            SceneError: It is no rigid motion.
        """
        try:
            matrix = np.array(self.values.get("transform_matrix"), np.float64)
        except (ValueError, TypeError):
            matrix = np.zeros(0)
        if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) <= colmap.LARGEST).all():
            raise self.error("has no transform_matrix of 4 by 4 finite numbers")
        if not np.allclose(matrix[3:], (0, 0, 0, 1), atol=1e-6):
            raise self.error("has a transform_matrix whose last row is not 0 0 0 1; is it transposed?")
        # Blender's cameras may be scaled.
        axes = matrix[:3, :3] / np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-30)
        left, _, right = np.linalg.svd(axes)
        rotation = left @ right
        if np.abs(rotation - axes).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise self.error("has a transform_matrix that is no rotation: its axes are skewed or mirrored")
        viewmat = np.eye(4)
        viewmat[:3, :3] = (rotation * (1, -1, -1)).T
        viewmat[:3, 3] = -viewmat[:3, :3] @ matrix[:3, 3]
        return viewmat


def _read_transforms(root: Path, files: list[Path], allow_outside: bool) -> ColmapModel:
    heads, frames = zip(*[_frames(file, allow_outside) for file in files], strict=True)
    chosen = {name: frame for part in frames for name, frame in part.items()}
    train, test = map(set, frames) if len(files) == 2 else _listed(heads[0], frames[0])
    if train & test:
        raise SceneError(f"{files[-1]}: {min(train & test)} is a train and a test photo: list it once")
    is_split = bool(train and test)
    chosen = {name: frame for name, frame in sorted(chosen.items()) if name in train | test or not is_split}
    lenses = {name: frame.lens() for name, frame in chosen.items()}
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(lenses.values()), start=1)}
    cameras = {number: colmap.lens(number, *lens) for lens, number in numbers.items()}
    tops = {PurePosixPath(name).parts[0] if "/" in name else "." for name in chosen}
    folder = tops.pop() if len(tops) == 1 else "."
    images = tuple(
        ColmapImage(name.removeprefix(f"{folder}/"), numbers[lenses[name]], frame.viewmat(), frame.mask)
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
        test=tuple(i for i, name in enumerate(chosen) if name in test) if is_split else None,
        synthetic=files[0].name == "transforms_train.json",
    )


def _frames(file: Path, allow_outside: bool) -> tuple[dict[str, Any], dict[str, _Frame]]:
    """The values of a file, and its frames by the names of their photos.

    Raises:
        SceneError: It cannot be read or has no frames, one is no table of values, or two are of the same photo.
    """
    try:
        head = json.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise SceneError(f"{file} does not exist: choose another file (--data.model)") from error
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{file} cannot be read ({error}): copy or export it again") from error
    if not isinstance(head, dict) or not isinstance(head.get("frames"), list) or not head["frames"]:
        raise SceneError(f"{file} has no list of frames, so it has no cameras: export it again")
    shared = {key: value for key, value in head.items() if key not in ("frames", "file_path", "mask_path")}
    frames: dict[str, _Frame] = {}
    given = []
    for position, own in enumerate(head["frames"]):
        if not isinstance(own, dict):
            raise SceneError(f"{file}: frame {position} is no table of values: export the file again")
        values = {key: value for key, value in (shared | own).items() if value is not None}
        frame = _Frame(file, position, values)
        if frame.path("file_path") is None:
            raise frame.error("has no file_path")
        given.append(frame)
    photos, masks = (
        locate([path for frame in given if (path := frame.path(key))], file.parent, str(file), allow_outside)
        for key in ("file_path", "mask_path")
    )
    masks_left = iter(masks)
    for frame, photo in zip(given, photos, strict=True):
        frame = replace(frame, photo=photo, mask=next(masks_left) if frame.path("mask_path") else None)
        if frame.name in frames:
            raise frame.error(f"is of {frame.name}, which an earlier frame is of, too", "remove one of them")
        frames[frame.name] = frame
    return head, frames


def _listed(head: Mapping[str, Any], frames: Mapping[str, _Frame]) -> list[set[str]]:
    """Names of the train and test photos that a file lists; an empty set where it lists none of them."""
    names = {str(PurePosixPath(name).with_suffix("")): name for name in frames}
    names |= {str(frame.path("file_path")): name for name, frame in frames.items()} | {name: name for name in frames}
    lists = [head.get(f"{part}_filenames") for part in ("train", "test", "val")]
    train, test, val = (
        {names.get(_plain(str(name)), "") for name in each} if isinstance(each, list) else set() for each in lists
    )
    return [train - {""}, (test or val) - {""}]


def _plain(path: str) -> str:
    return str(PurePosixPath(path.replace("\\", "/")))


def _points(
    root: Path, head: dict[str, Any], images: tuple[ColmapImage, ...], cameras: dict[int, Any], allow_outside: bool
) -> tuple[Float64s, Uint8s]:
    """The points that a file names, or that lie beside it, in the frame of its cameras; none if there are none.

    Programs that wrote ``applied_transform`` have applied it to the cameras, and most of them to the points; where it
    is missing from the points shows in how many of them the cameras see.
    """
    name = head.get("ply_file_path")
    if isinstance(name, str):
        check_name(_plain(name), f"ply_file_path in {root}", allow_outside)
        path: Path | None = root / _plain(name)
    elif (path := cloud_in([root])) is not None:
        log.info("%s names no points: those of %s are used", root, path)
    if path is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    points, colors = read_points(path)
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
    if share_seen(moved, pinholes) > 1.5 * share_seen(points, pinholes):
        log.info("%s: the points are not in the frame of the cameras: applied_transform moves them there", path)
        return moved, colors
    return points, colors


def share_seen(points: Float64s, cameras: list[Camera]) -> float:
    """Mean share of the cameras that have a point in their picture, walls disregarded."""
    return float(_sightings(points, cameras).mean() / len(cameras)) if len(points) else 0.0


# Points of a scene that comes without.
RANDOM_POINTS = 20_000


def random_points(cameras: list[Camera]) -> Float64s:
    """:data:`RANDOM_POINTS` points ``[P, 3]`` in the volume that the cameras see together, always the same ones.

    Candidates are spread over the views, up to twice as far away as what the cameras look at, which is where their
    optical axes come closest to each other; those that most cameras see are kept.

    Args:
        cameras: At least one.
    """
    draws = generator(0, 0, "random points")
    count = 8 * RANDOM_POINTS
    centres, turned = poses(cameras)
    rotations, middle = turned.as_matrix(), centres.mean(0)
    # The cameras look at where their axes meet, or as far away as their own extent if that is farther.
    typical = float(np.median(np.linalg.norm(centres - looked_at(cameras), axis=1)))
    distance = max(typical, float(np.linalg.norm(centres - middle, axis=1).max()), 1e-6)
    chosen = torch.randint(len(cameras), (count,), generator=draws).numpy()
    across, down, away = torch.rand(3, count, generator=draws, dtype=torch.float64).numpy()
    focal = np.array([camera.intrinsics for camera in cameras])[chosen]
    size = np.array([(camera.width, camera.height) for camera in cameras])[chosen]
    depth = 2 * distance * away
    x, y = (across * size[:, 0] - focal[:, 2]) / focal[:, 0], (down * size[:, 1] - focal[:, 3]) / focal[:, 1]
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    points = centres[chosen] + np.einsum("pij,pj->pi", rotations[chosen], rays * depth[:, None])
    order = np.argsort(-_sightings(points, cameras), kind="stable")
    return np.asarray(points[order[:RANDOM_POINTS]])


def _sightings(points: Float64s, cameras: list[Camera]) -> Int64s:
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
