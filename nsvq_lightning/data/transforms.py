"""Reads a ``transforms.json``: nerfstudio, instant-ngp, Polycam, and Blender's NeRF-synthetic scenes.

The file has the cameras; the points to start from are those of a ``.ply`` file, or random ones where the cameras look.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch

from nsvq_lightning.data import PANORAMA, colmap
from nsvq_lightning.data.colmap import ColmapImage, ColmapModel, SceneError, check_name
from nsvq_lightning.data.images import image_head
from nsvq_lightning.data.photo_files import locate
from nsvq_lightning.data.points import cloud_in, read_points, share_seen
from nsvq_lightning.io.errors import Json
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.poses import transformed, viewmat_of
from nsvq_lightning.splats.conventions import Float64s, Uint8s
from nsvq_lightning.top_level import log

# A camera: COLMAP's name of the model, width and height in pixels, parameters.
_Lens = tuple[str, int, int, tuple[float, ...]]


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
    if model is None:
        files = [] if colmap.find_model(root) else _files_in(root)
    else:
        model = str(model)  # a number in Python
        files = [root / model] if model.endswith(".json") else []
    if files:
        poses = _read_transforms(files, allow_outside)
        return poses if len(poses.points) else _with_colmap_points(poses, root)
    poses = colmap.read_model(root, observations, model)
    cloud = cloud_in([colmap.model_files(root, model)["images"].parent, root]) if not len(poses.points) else None
    if cloud is None:
        return poses
    log.info(f"{root} has no points in its COLMAP model: those of {cloud} take their place")
    points, colors = read_points(cloud)
    return replace(poses, points=points, colors=colors, cloud=True)


def has_poses(root: Path) -> bool:
    """Whether a folder has a COLMAP model or a transforms file, for :func:`read_poses`."""
    return bool(colmap.find_model(root) or _files_in(root))


def _files_in(root: Path) -> list[Path]:
    """The transforms files of a folder: of train and of test views, or else the one of all; maybe none."""
    single, *parts = (root / f"transforms{part}.json" for part in ("", "_train", "_test", "_val"))
    found = [path for path in parts if path.is_file()][:2] if parts[0].is_file() else []
    return [single] if single.is_file() and len(found) < 2 else found


def _with_colmap_points(poses: ColmapModel, root: Path) -> ColmapModel:
    """Cameras with the points of the first COLMAP model in the folder, from which they may have been made, if any.

    Programs turn, move and scale that model; the photos that both have say how.
    """
    models = colmap.other_models(root)
    if not models:
        return poses
    try:
        found = colmap.read_model(root, chosen=models[0])
        moved = colmap.alignment(found, poses)
    except SceneError as error:
        log.warning(f"the points of {root / models[0]} are not used: {error}")
        return poses
    log.info(f"the transforms file of {root} names no points: those of {root / models[0]} are used")
    return replace(poses, points=transformed(found.points, moved), colors=found.colors)


def _numbers(values: object) -> Float64s:
    """Values of a file as an array; one without dimensions if they are none."""
    try:
        return np.array(values, np.float64)
    except (ValueError, TypeError):
        return np.zeros(())


# Cameras with distortion or without, of k1 to k3, p1 and p2; what is missing of these is 0.
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
# How instant-ngp says that a lens is of another kind.
_OTHER_LENSES = ("latlong", "equirectangular", "orthographic", "ftheta_p1")


class _Frame(NamedTuple):
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
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= colmap.MAX_NUMBER:
            raise self.error(f"has {key} = {value!r}, which is no finite number")
        return float(value)

    def path(self, key: str) -> str:
        """A path that it gives, with slashes; empty if it gives none."""
        given = self.values.get(key)
        return _plain(given) if isinstance(given, str) and given else ""

    @property
    def name(self) -> str:
        """Path of its photo, relative to the scene folder."""
        folder = self.file.parent
        return (self.photo.relative_to(folder) if self.photo.is_relative_to(folder) else self.photo).as_posix()

    def lens(self) -> _Lens:
        """Its camera.

        Raises:
            SceneError: A value is missing or out of range, or the camera's model is not supported.
        """
        width, height = self._size()
        fx, fy = self._focals(width, height)
        pinhole = (fx, fy, self.number("cx", width / 2), self.number("cy", height / 2))
        listed = _numbers(self.values.get("distortion_params", np.zeros(6)))  # as nerfstudio has it
        if listed.shape != (6,):
            raise self.error("has distortion_params that are not 6 numbers")
        k1, k2, k3, k4, p1, p2 = map(self.number, ("k1", "k2", "k3", "k4", "p1", "p2"), listed)
        usual = "OPENCV_FISHEYE" if self.values.get("is_fisheye") else "OPENCV"
        other = (key.upper() for key in _OTHER_LENSES if self.values.get(key))
        model = next(other, str(self.values.get("camera_model", usual)).upper())
        if model == "OPENCV_FISHEYE" and not (p1 or p2):
            return model, width, height, (*pinhole, k1, k2, k3, k4)
        if model not in _PERSPECTIVE or k4:
            distorted = f" and k4 = {k4:g}" if model in _PERSPECTIVE else ""
            raise self.error(
                f"has camera_model {model}{distorted}, which cannot be read; PINHOLE, OPENCV (k1 to k3, p1, p2) and "
                "OPENCV_FISHEYE (k1 to k4, no p1 and p2) can",
                PANORAMA if model in ("EQUIRECTANGULAR", "LATLONG") else "export the photos undistorted, as PINHOLE",
            )
        distortion = (k1, k2, p1, p2, k3)
        if any(distortion):
            return "FULL_OPENCV", width, height, (*pinhole, *distortion, 0.0, 0.0, 0.0)
        return "PINHOLE", width, height, pinhole

    def _size(self) -> tuple[int, int]:
        if "w" not in self.values or "h" not in self.values:
            if not self.photo.is_file():
                raise self.error(f"is of the photo {self.photo}, which does not exist", "copy the photo there")
            return image_head(self.photo).size
        width = round(self.number("w"))
        height = round(self.number("h"))
        if not 0 < min(width, height) <= max(width, height) <= colmap.MAX_SIDE:
            raise self.error(f"has size {width}x{height}; sides go from 1 to {colmap.MAX_SIDE}")
        return width, height

    def _focals(self, width: int, height: int) -> tuple[float, float]:
        """Focal lengths along both axes, pixels; one that is not given is that of the other axis."""
        given = {}
        for axis, side in (("x", width), ("y", height)):
            if f"fl_{axis}" in self.values:
                given[axis] = self.number(f"fl_{axis}")
            elif f"camera_angle_{axis}" in self.values:
                # Larger angles are in degrees: they leave no focal length.
                given[axis] = side / 2 / max(math.tan(min(self.number(f"camera_angle_{axis}"), math.pi) / 2), 1e-12)
        for focal in given.values():
            if not focal > 0:
                raise self.error(f"has the focal length {focal:g}")
        if not given:
            raise self.error("has no focal length: neither fl_x nor camera_angle_x")
        fx = given.get("x") or given["y"]
        return fx, given.get("y", fx)

    def viewmat(self) -> Float64s:
        """World to camera ``[4, 4]``, x right, y down, z forward; the file has the inverse, y up, z backward.

        Raises:
            SceneError: It is no rigid motion.
        """
        matrix = _numbers(self.values.get("transform_matrix"))
        if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) <= colmap.MAX_NUMBER).all():
            raise self.error("has no transform_matrix of 4 by 4 finite numbers")
        if not np.allclose(matrix[3:], (0, 0, 0, 1), atol=1e-6):
            raise self.error("has a transform_matrix whose last row is not 0 0 0 1; is it transposed?")
        # Blender's cameras may be scaled.
        axes = matrix[:3, :3] / np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-30)
        left, _, right = np.linalg.svd(axes)
        rotation = left @ right
        if np.abs(rotation - axes).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise self.error("has a transform_matrix that is no rotation: its axes are skewed or mirrored")
        return viewmat_of((rotation * (1, -1, -1)).T, matrix[:3, 3])


def _read_transforms(files: list[Path], allow_outside: bool) -> ColmapModel:
    """What one file lists, or two: the train and the test views.

    Raises:
        SceneError: A file is damaged, or has cameras or names that cannot be used.
    """
    head, frames = _frames(files[0], allow_outside)
    if not frames:
        raise SceneError(f"{files[0]} has no list of frames, so it has no cameras: export it again")
    train, test = _listed(head, frames)
    if train or test:  # the others, where one list stands alone
        train, test = train or set(frames) - test, test or set(frames) - train
    for file in files[1:]:
        _, tests = _frames(file, allow_outside)
        # BlenderNeRF leaves test photos to be rendered: none is there, and the nearest names are those of train photos.
        named = ((frame, frames.get(name, frame)) for name, frame in tests.items())
        if not any(own.photo.is_file() and own.path("file_path") == one.path("file_path") for own, one in named):
            log.warning(f"{file}: none of its photos is there, so it is not used")
            continue
        train, test = set(frames), set(tests)
        frames |= tests
    if train & test:
        twice = f"{min(train & test)} is a train and a test photo"
        raise SceneError(f"{files[-1]}: {twice}: list it once, or choose one file (--data.model={files[0].name})")
    is_split = bool(train and test)
    names = sorted(train | test if is_split else frames)
    if len(names) < len(frames):
        log.info(f"{files[0]}: {len(frames) - len(names)} of {len(frames)} photos are not used, by its lists")
    tops = {PurePosixPath(name).parts[0] if "/" in name and not colmap.is_outside(name) else "." for name in names}
    folder = tops.pop() if len(tops) == 1 else "."
    numbers: dict[_Lens, int] = {}
    images = []
    for name in names:
        frame = frames[name]
        number = numbers.setdefault(frame.lens(), len(numbers) + 1)
        images.append(ColmapImage(name.removeprefix(f"{folder}/"), number, frame.viewmat(), frame.mask))
    cameras = {number: colmap.lens(number, *lens) for lens, number in numbers.items()}
    points, colors = _points(files[0].parent, head, images, cameras, allow_outside)
    return ColmapModel(
        images=tuple(images),
        cameras=cameras,
        points=points,
        colors=colors,
        source=files[0].name,
        images_folder=f"{files[0].parent.absolute()}/{folder}",  # keeps ".", beside which is no "._2"
        test=tuple(row for row, name in enumerate(names) if name in test) if is_split else None,
        cloud=True,
        synthetic=files[0].name == "transforms_train.json",
    )


def _frames(file: Path, allow_outside: bool) -> tuple[Json, dict[str, _Frame]]:
    """The values of a file, and its frames by the names of their photos.

    Raises:
        SceneError: It cannot be read or has no list of frames, one is no table of values, or two are of the same photo.
    """
    try:
        head = json.loads(file.read_bytes())
    except FileNotFoundError as error:
        raise SceneError(f"{file} does not exist: choose another file (--data.model)") from error
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{file} cannot be read ({error}): copy or export it again") from error
    if not isinstance(head, dict) or not isinstance(head.get("frames"), list):
        raise SceneError(f"{file} has no list of frames: export it again")
    shared = {key: value for key, value in head.items() if key not in ("frames", "file_path", "mask_path")}
    if shared.get("fisheye_crop_radius"):
        log.warning(f"{file}: fisheye_crop_radius is not applied: leave out what lies beyond by masks")
    given = []
    for position, own in enumerate(head["frames"]):
        if not isinstance(own, dict):
            raise SceneError(f"{file}: frame {position} is no table of values: export the file again")
        # Its own angle comes before a focal length of the file.
        angle = any(key.startswith("camera_angle_") for key in own)
        common = {key: value for key, value in shared.items() if not (angle and key.startswith("fl_"))}
        frame = _Frame(file, position, {key: value for key, value in (common | own).items() if value is not None})
        if not frame.path("file_path"):
            raise frame.error("has no file_path")
        given.append(frame)
    named, masked = ([path for frame in given if (path := frame.path(key))] for key in ("file_path", "mask_path"))
    photos = locate(named, file.parent, str(file), allow_outside)
    masks = locate(masked, file.parent, str(file), allow_outside, photos.values())
    frames = {}
    for frame in given:
        frame = frame._replace(photo=photos[frame.path("file_path")], mask=masks.get(frame.path("mask_path")))
        if frame.name in frames:
            raise frame.error(f"is of {frame.name}, which an earlier frame is of, too", "remove one of them")
        frames[frame.name] = frame
    return head, frames


def _listed(head: Mapping[str, Any], frames: Mapping[str, _Frame]) -> tuple[set[str], set[str]]:
    """Names of the train and test photos that a file lists; an empty set where it lists none of them."""
    names = {str(PurePosixPath(name).with_suffix("")): name for name in frames}
    names |= {frame.path("file_path"): name for name, frame in frames.items()}
    names |= {name: name for name in frames}

    def listed(part: str) -> set[str]:
        """Those of a list; a warning counts what in it is no photo."""
        given = head.get(f"{part}_filenames")
        found = [names.get(_plain(str(name))) for name in given] if isinstance(given, list) else []
        if missing := found.count(None):
            log.warning(f"{missing} of {len(found)} names in {part}_filenames are of no photo in the file")
        return set(filter(None, found))

    return listed("train"), listed("test") or listed("val")


def _plain(path: str) -> str:
    return str(PurePosixPath(path.replace("\\", "/")))


def _points(
    root: Path, head: Mapping[str, Any], images: Sequence[ColmapImage], cameras: Mapping[int, Any], allow_outside: bool
) -> tuple[Float64s, Uint8s]:
    """The points that a file names, or that lie beside it, in the frame of its cameras; none if there are none.

    Programs that wrote ``applied_transform`` have applied it to the cameras, and most of them to the points; where it
    is missing from the points shows in how many of them the cameras see.
    """
    name = head.get("ply_file_path")
    if isinstance(name, str):
        check_name(_plain(name), f"ply_file_path in {root}", allow_outside)
        path: Path | None = root / _plain(name)
    elif path := cloud_in([root]):
        log.info(f"the transforms file of {root} names no points: those of {path} are used")
    if path is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    points, colors = read_points(path)
    applied = _numbers(head.get("applied_transform"))
    if applied.shape not in ((3, 4), (4, 4)) or not np.isfinite(applied[:3]).all():
        return points, colors
    views = []
    for image in images:
        lens = cameras[image.camera_id]
        views.append(Camera(lens.calibration_matrix(), torch.from_numpy(image.viewmat), lens.width, lens.height))
    moved = transformed(points, applied)
    if share_seen(moved, views) > 1.5 * share_seen(points, views):
        log.info(f"{path}: the points are not in the frame of the cameras: applied_transform moves them there")
        return moved, colors
    return points, colors
