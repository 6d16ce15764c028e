"""A COLMAP model: where its files are, and the cameras, poses and points in them, checked.

The only place that imports pycolmap.
"""

import math
import signal
from collections.abc import Callable, Iterable, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise, takewhile
from pathlib import Path, PurePath
from threading import current_thread, main_thread
from typing import Any, ClassVar, TypeVar

import cv2  # noqa: F401  (before pycolmap, see import_pycolmap)
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from nsvq_lightning.data import NO_FOLDER
from nsvq_lightning.data import colmap_tables as tables
from nsvq_lightning.splats.conventions import Float64s, Int64s, Uint8s, white_of
from nsvq_lightning.top_level import log

# Upper bound on poses and intrinsics: their squares, which rendering computes in float32, stay finite.
MAX_NUMBER = 1e18
# Where a model may be inside a scene folder, in order of preference: COLMAP's image_undistorter writes its own into
# sparse, beside that of the photos as they were in sparse/0.
FOLDERS = ("sparse", "sparse/0", ".")
# The tables of a COLMAP model; a scene can do without the last one.
TABLES = ("cameras", "images", "points3D")


class SceneError(ValueError):
    """A scene folder that cannot be used; the message names the file, what is wrong with it and what to do."""


class NoPhotosError(SceneError):
    """A scene folder has cameras, but none of their photos."""


# Pixels; a camera with a larger side is damaged.
MAX_SIDE = (1 << 20) - 1
# Relative error of a quaternion's length that comes from writing its numbers with few digits.
_ROUNDED = 1e-4


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image.

    Attributes:
        name: File name relative to the image folder.
        camera_id: Key into :attr:`ColmapModel.cameras`.
        viewmat: World to camera, rigid, ``[4, 4]`` float64, scene units.
        mask: File of its mask where the model names one.
    """

    name: str
    camera_id: int
    viewmat: Float64s
    mask: Path | None = None

    @property
    def centre(self) -> Float64s:
        """Where the camera is ``[3]``, scene units."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera without distortion, with the names of ``pycolmap.Camera``, whose place it takes.

    Attributes:
        K: ``[3, 3]`` float64, pixels, centres at .5.
        width: Pixels.
        height: Pixels.
        camera_id: Number of the camera; 0 where it has none.
    """

    K: Float64s
    width: int
    height: int
    camera_id: int = 0
    model_name: ClassVar[str] = "PINHOLE"

    def calibration_matrix(self) -> Float64s:
        """``K``."""
        return self.K

    def scaled(self, across: float, down: float) -> "Pinhole":
        """The camera of the image made so many times as wide and as high, rounded to pixels, at least one.

        With centres at .5, the whole of ``K`` scales linearly.
        """
        width = max(1, round(self.width * across))
        height = max(1, round(self.height * down))
        return Pinhole(np.diag([width / self.width, height / self.height, 1.0]) @ self.K, width, height)


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A COLMAP reconstruction in COLMAP's own world frame, or the cameras of a transforms file as if they were one.

    Attributes:
        images: Registered images, sorted by name.
        cameras: ``pycolmap.Camera`` by id, of those without distortion :class:`Pinhole`.
        points: Sparse points ``[P, 3]`` float64, scene units, sorted by COLMAP's point id; maybe none.
        colors: Their colours ``[P, 3]`` uint8 RGB.
        observations: Row of the point and row of the image of each sighting ``[O, 2]`` int64; None unless requested.
        source: Where it comes from, for messages.
        images_folder: Folder of the photos, where the model says so.
        test: Rows of the test images, where the model says so.
        cloud: Whether the points are those of another file or program, which may be in other coordinates than the
            cameras.
        synthetic: Whether it is a NeRF-synthetic scene, whose transparent pixels are white by convention.
    """

    images: tuple[ColmapImage, ...]
    cameras: dict[int, Any]
    points: Float64s
    colors: Uint8s
    observations: Int64s | None = None
    source: str = "COLMAP"
    images_folder: str | None = None
    test: tuple[int, ...] | None = None
    cloud: bool = False
    synthetic: bool = False


def import_pycolmap() -> Any:
    """Import pycolmap, late and after OpenCV and Pillow.

    The wheels bundle different copies of libpng and zlib. If pycolmap's are loaded first, writing a PNG with OpenCV or
    Pillow aborts the process; the imports at the top of this module ensure the right order.

    Raises:
        SceneError: It is not installed.
    """
    Image.preinit()  # loads Pillow's own image libraries, which a bare import leaves for later
    try:
        import pycolmap
    except ModuleNotFoundError as error:
        raise SceneError(
            "pycolmap, which places cameras and undistorts photos, is not installed (it has no wheel for Linux on "
            "ARM64): build it, or undistort the photos elsewhere (colmap image_undistorter)"
        ) from error
    if current_thread() is main_thread():  # its own handler takes the place of ours, and would leave files behind
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    return pycolmap


def is_outside(name: str) -> bool:
    """Whether a name leads out of the folder that it is relative to."""
    path = PurePath(name)
    return bool(path.anchor) or ".." in path.parts


def check_name(name: str, source: object, allow_outside: bool) -> None:
    """Check the name of a file that a model gives relative to its scene folder.

    Args:
        name: The name.
        source: Where it is given, for the message.
        allow_outside: Also allow files that are not in the scene folder.

    Raises:
        SceneError: It leaves the folder, or is not UTF-8.
    """
    try:
        name.encode()
    except UnicodeEncodeError:
        raise SceneError(f"{source} names {name!r}, which is not UTF-8: rename it (in a model: make it anew)") from None
    if not allow_outside and is_outside(name):
        raise SceneError(
            f"{source} names {name}, which is not in the scene folder: copy it there, or allow it in fit and test with "
            "--data.allow_outside=true"
        )


def find_model(root: Path, folders: Sequence[str] = FOLDERS) -> dict[str, Path] | None:
    """The files of the tables of the first model in the folders, points only if there are any; None if there is none.

    Args:
        root: Scene folder.
        folders: Where to look inside it.
    """
    return next(filter(None, (_tables_in(root / folder) for folder in folders)), None)


def _tables_in(folder: Path) -> dict[str, Path] | None:
    """The files of the tables in a folder, binary before text; None without cameras or images."""
    there = {path.name.lower(): path for path in folder.iterdir()} if folder.is_dir() else {}
    binary, text = (
        {table: there[name] for table in TABLES if (name := table.lower() + suffix) in there}
        for suffix in (".bin", ".txt")
    )
    files = text if len(binary) < len(text) == len(TABLES) else text | binary
    return files if {"cameras", "images"} <= files.keys() else None


def model_files(root: Path, chosen: str | None = None) -> dict[str, Path]:
    """The files of the model of a scene folder: in one of :data:`FOLDERS`, or the only one anywhere in it.

    Args:
        root: Scene folder.
        chosen: N for ``sparse/N``, or a folder inside ``root``; None looks for one.

    Raises:
        SceneError: There is none, or there are several where nobody looks first.
    """
    folders: Sequence[str] = FOLDERS
    if chosen is not None:
        folders = [f"sparse/{chosen}" if chosen.isdecimal() else chosen]
    if files := find_model(root, folders):
        if chosen is None and files["images"].parent == root / "sparse" and _tables_in(root / "sparse" / "0"):
            log.info(f"{root}: the COLMAP model is the one in sparse, not that in sparse/0 (--data.model=0)")
        return files
    others = other_models(root) if chosen is None else []
    if not others:
        raise _no_model(root, folders, chosen)
    if len(others) > 1:
        raise SceneError(f"{root} has models in {', '.join(others)}: choose one, such as --data.model={others[0]}")
    log.info(f"{root}: the COLMAP model is the one in {others[0]}")
    return model_files(root, f"./{others[0]}")


def other_models(root: Path) -> list[str]:
    """Folders with a model, up to three levels inside a scene folder."""
    folders = {path.parent for depth in ("*", "*/*", "*/*/*") for path in root.glob(f"{depth}/[cC]ameras.*")}
    return sorted(str(folder.relative_to(root)) for folder in folders if _tables_in(folder))


# So many points that no two photos saw are taken as they are; a scanner has more.
MAX_UNSEEN = 1000


def read_model(root: Path, observations: bool = False, chosen: str | None = None) -> ColmapModel:
    """Read the model of a scene folder; without ``points3D`` it has no points.

    Poses are those in ``images``, as in every other program of this field: those in ``frames`` say the same.

    Args:
        root: Scene folder.
        observations: Also read which image saw which point; training does not need it.
        chosen: See :func:`model_files`.

    Raises:
        SceneError: There is no such folder or no model, a file is damaged, or the model has no image.
    """
    if not root.is_dir():
        raise SceneError(NO_FOLDER.format(root))
    files = model_files(root, chosen)
    listed = _table(files["cameras"], tables.read_cameras)
    cameras = {row.number: row for row in listed}
    if any(cameras[row.number] != row for row in listed):
        raise SceneError(f"{files['cameras']} has two cameras of one number: export the model again")
    rows = sorted(_table(files["images"], tables.read_images), key=lambda row: row.name)
    if not rows:
        raise SceneError(f"{files['images']} lists no registered image: run COLMAP's mapper again")
    viewmats = _viewmats(rows, files["images"])
    for row in rows:
        check_name(row.name, files["images"], allow_outside=True)
        if row.camera_id not in cameras:
            raise SceneError(
                f"{files['images']}: photo {row.name[:80]} is of camera {row.camera_id}, which "
                f"{files['cameras'].name} does not have: copy both files again, from one model"
            )
    points = tables.PointTable(np.zeros((0, 3)), np.zeros((0, 3)), ())
    if "points3D" in files:
        points = _table(files["points3D"], lambda path: tables.read_points(path, observations))
    # Photos beside a model deeper in the folder.
    beside = [each / "images" for each in takewhile(root.__ne__, files["images"].parents[:3])]
    return ColmapModel(
        images=tuple(ColmapImage(row.name, row.camera_id, view) for row, view in zip(rows, viewmats, strict=True)),
        cameras={row.camera_id: _camera(cameras[row.camera_id], files["cameras"]) for row in rows},
        points=points.xyz,
        colors=rgb_bytes(points.rgb),
        observations=_observations(rows, points.tracks if points.seen else ()) if observations else None,
        images_folder=next((str(each.absolute()) for each in beside if each.is_dir()), None),
        cloud=not points.seen and len(points.xyz) > MAX_UNSEEN,
    )


_Rows = TypeVar("_Rows", bound=Sized)


def _table(path: Path, read: Callable[[Path], _Rows]) -> _Rows:
    """What a table holds; warns if its head announces more.

    Raises:
        SceneError: It is damaged.
    """
    remedy = "copy the model again or export it anew with `colmap model_converter`"
    try:
        rows, announced = read(path), tables.announced_rows(path)
    except (ValueError, OverflowError, OSError) as error:
        raise SceneError(f"{path}: {error}; {remedy}") from error
    found = len(rows.xyz) if isinstance(rows, tables.PointTable) else len(rows)
    if announced > found:
        log.warning(f"{path} announces {announced} rows but has {found}: unless you removed some, {remedy}")
    return rows


def _viewmats(rows: Sequence[tables.ImageRow], path: Path) -> Float64s:
    """World to camera ``[V, 4, 4]``.

    Raises:
        SceneError: A pose is not finite or its quaternion is 0, or a photo has two poses.
    """
    poses = np.array([row.pose for row in rows])
    quats = poses[:, :4]
    norms = np.linalg.norm(quats, axis=1)
    usable = (norms > 0) & (np.abs(poses) <= MAX_NUMBER).all(1)
    if not usable.all():
        first = rows[usable.argmin()]
        pose = f"quaternion {list(first.pose[:4])} and translation {list(first.pose[4:])}"
        raise SceneError(
            f"{path}: {(~usable).sum()} poses are no numbers, not finite or without rotation; the first is that of "
            f"{first.name} with {pose}: remove it from the model, or run COLMAP again"
        )
    for one, other in pairwise(rows):
        if one.name == other.name:
            raise SceneError(
                f"{path} lists {one.name} twice, as images {one.number} and {other.number}: rename one; run COLMAP anew"
            )
    worst = np.abs(norms - 1).max()
    if worst > _ROUNDED:
        log.warning(f"{path}: quaternions are up to {100 * worst:.2g} % too long or short; they are normalised")
    viewmats = np.tile(np.eye(4), (len(rows), 1, 1))
    viewmats[:, :3, :3] = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    viewmats[:, :3, 3] = poses[:, 4:]
    return viewmats


def _camera(row: tables.CameraRow, path: Path) -> Any:
    """The camera of a row, see :func:`lens`.

    Raises:
        SceneError: It is damaged.
    """
    has_sides = all(0 < side <= MAX_SIDE for side in (row.width, row.height))
    if not (has_sides and (np.abs(row.params) <= MAX_NUMBER).all() and row.params[0] > 0):
        raise SceneError(
            f"{path}: camera {row.number} has size {row.width}x{row.height} and parameters "
            f"{', '.join(map(str, row.params))}; needed are sizes from 1 to {MAX_SIDE}, finite numbers and a focal "
            "length above 0: copy the model again or run COLMAP again"
        )
    return lens(*row)


def lens(number: int, model: str, width: int, height: int, params: tuple[float, ...]) -> Any:
    """A camera: :class:`Pinhole` without distortion, else a ``pycolmap.Camera``.

    Args:
        number: Its identifier.
        model: COLMAP's name of its model.
        width: Pixels.
        height: Pixels.
        params: COLMAP's parameters of the model.

    Raises:
        SceneError: It has distortion, and pycolmap is not installed.
    """
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        *focal, cx, cy = params
        K = np.array([[focal[0], 0, cx], [0, focal[-1], cy], [0, 0, 1]], np.float64)
        return Pinhole(K, width, height, number)
    return import_pycolmap().Camera(model=model, width=width, height=height, params=list(params), camera_id=number)


def size_range(cameras: Iterable[Any]) -> str:
    """The smallest and the largest size of cameras of any kind, in words."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    return " to ".join(f"{width}x{height}" for width, height in sorted({min(sizes), max(sizes)}))


def rgb_bytes(values: Float64s, floats: bool = False) -> Uint8s:
    """Colours ``[P, 3]`` of any kind as bytes: in [0, 1] if they are fractions, in [0, 255], or of 12 or 16 bits.

    Args:
        values: The colours.
        floats: Whether they may be fractions even if all are 0 or 1.
    """
    values = np.nan_to_num(values)
    white = white_of(values, floats or bool((values % 1).any()))
    return ((values / white).clip(0, 1) * 255).round().astype(np.uint8)


def alignment(model: ColmapModel, other: ColmapModel) -> Float64s:
    """The similarity ``[3, 4]`` that takes the camera centres of a model nearest to those of another, by photo name.

    Raises:
        SceneError: They share fewer than three photos, or these lie on a line, and so do not say how it turns.
    """
    for name_of in str, lambda path: PurePath(path).name:  # paths of the same photos may begin elsewhere
        centres = [{name_of(image.name): image.centre for image in found.images} for found in (model, other)]
        unique = [*map(len, centres)] == [len(model.images), len(other.images)]
        shared = sorted(centres[0].keys() & centres[1].keys()) if unique else []
        if len(shared) > 2:
            break
    ours, theirs = (np.array([places[name] for name in shared]).reshape(-1, 3) for places in centres)
    for places in (ours, theirs):
        if len(shared) < 3 or np.linalg.matrix_rank(places - places.mean(0), 1e-6 * np.ptp(places)) < 2:
            raise SceneError(
                f"{len(shared)} photos of the same name are in both scenes: aligning takes three, not all on one line"
            )
    return import_pycolmap().estimate_sim3d(ours, theirs).matrix()  # type: ignore[no-any-return]


def _no_model(root: Path, folders: Sequence[str], chosen: str | None) -> SceneError:
    """What to say of a folder without a model."""
    found = [path for folder in folders for path in (root / folder).glob("*.*") if path.stem in TABLES]
    where = root
    advice = "nor is there a transforms.json: copy what is missing, export cameras as COLMAP's, or use nsvq prepare"
    if chosen is not None:
        where = root / folders[0]
        advice = f"choose another (--data.model); there is {', '.join(other_models(root)) or 'none in the folder'}"
    places = ", ".join(sorted(folders)[::-1])  # the usual one first
    return SceneError(
        f"no COLMAP model in {where}: looked for cameras and images (.bin or .txt) in {places}; "
        f"there is {' and '.join(str(path.relative_to(root)) for path in found) or 'neither'}; {advice}"
    )


def larger_models(root: Path) -> str | None:
    """Which models of a scene folder have more images than its ``sparse/0``, and what to do; None if none has.

    COLMAP numbers the parts of a scene that it could not join, not always in the order of their size. A model in
    ``sparse`` itself, which is read before them, is no such part.
    """
    counts = {}
    for folder in (root / "sparse").glob("*"):
        if files := _tables_in(folder):
            with suppress(ValueError, OSError):
                counts[folder.name] = len(tables.read_images(files["images"]))
    first = math.inf if _tables_in(root / "sparse") else counts.get("0", math.inf)
    larger = [f"sparse/{name} has {count}" for name, count in sorted(counts.items()) if count > first]
    advice = "COLMAP could not join them; --data.model=N trains on sparse/N"
    return f"sparse/0 has {first} images, {', '.join(larger)}: {advice}" if larger else None


def _observations(rows: Sequence[tables.ImageRow], tracks: Sequence[Sequence[int]]) -> Int64s:
    """Pairs of point row and image row, each once: a track may have two features in one image."""
    row_of = {image.number: row for row, image in enumerate(rows)}
    points = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    images = np.fromiter((row_of.get(image, -1) for track in tracks for image in track), np.int64, len(points))
    if lost := np.count_nonzero(images < 0):
        log.warning(f"left out {lost} sightings by images that the model does not have")
    return np.unique(np.stack([points, images], axis=1)[images >= 0], axis=0)
