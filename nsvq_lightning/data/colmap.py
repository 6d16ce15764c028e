"""A COLMAP model: its files, checked before a reader allocates memory for them, and what they hold.

The only place that imports pycolmap.
"""

from __future__ import annotations

import math
import mmap
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see import_pycolmap)
import numpy as np
import PIL.Image
from numpy.typing import NDArray

__all__ = [
    "ColmapImage",
    "ColmapModel",
    "ModelFiles",
    "SceneError",
    "check_binary_files",
    "check_name",
    "find_model",
    "has_model",
    "import_pycolmap",
    "larger_models",
    "read_model",
]


FOLDERS = ("sparse/0", "sparse", ".")
"""Where a model may be inside a scene folder, in order of preference."""
TABLES = ("cameras", "images", "points3D")
"""The three tables every COLMAP model has."""

LARGEST_SIDE = (1 << 20) - 1
"""Pixels; a camera with a larger side is damaged."""

_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_REMEDY = "copy the model again or export it anew with `colmap model_converter`"

Buffer = mmap.mmap
RecordEnd = Callable[[Buffer, int], int]


class SceneError(ValueError):
    """A scene folder that cannot be used; the message names the file, what is wrong with it and what to do."""


@dataclass(frozen=True)
class ModelFiles:
    """A complete COLMAP model on disk.

    Attributes:
        folder: Folder with the three tables.
        suffix: ``".bin"`` or ``".txt"``.
    """

    folder: Path
    suffix: str

    def path(self, table: str) -> Path:
        """File of one table, for example ``"cameras"``."""
        return self.folder / f"{table}{self.suffix}"


def has_model(root: Path) -> bool:
    """Whether a scene folder has a complete COLMAP model where :func:`find_model` looks for one."""
    return any(
        all((root / folder / f"{table}{suffix}").is_file() for table in TABLES)
        for folder in FOLDERS
        for suffix in (".bin", ".txt")
    )


def find_model(root: Path, chosen: str | None = None) -> ModelFiles:
    """The model of a scene folder: ``sparse/0``, ``sparse`` or the folder itself, binary before text.

    Args:
        root: Scene folder.
        chosen: N for ``sparse/N``, or a folder inside ``root``; None looks in the three places.

    Raises:
        SceneError: The folder does not exist or holds no complete model.
    """
    if not root.is_dir():
        raise SceneError(f"scene folder {root} does not exist: give the folder that holds images/ and sparse/")
    folders: tuple[str, ...] = FOLDERS
    if chosen is not None:
        folders = (f"sparse/{chosen}" if chosen.isdecimal() else chosen,)
    missing: list[str] = []
    for folder in folders:
        for suffix in (".bin", ".txt"):
            files = ModelFiles((root / folder).resolve(), suffix)
            absent = [table for table in TABLES if not files.path(table).is_file()]
            if not absent:
                return files
            if len(absent) < len(TABLES):
                missing.append(f"{folder} has a {suffix} model without {', '.join(t + suffix for t in absent)}")
    looked = ", ".join(folders)
    details = "; ".join(missing) or "none of the three files is in any of them"
    if chosen is not None:
        others = sorted({str(path.parent.relative_to(root)) for path in (root / "sparse").glob("*/cameras.*")})
        raise SceneError(
            f"no COLMAP model in {root / looked}: looked for cameras, images and points3D (.bin or .txt); {details}. "
            f"Choose another (--data.model); there is {', '.join(others) or 'none in sparse/'}"
        )
    raise SceneError(
        f"no COLMAP model in {root}: looked for cameras, images and points3D (.bin or .txt) in {looked}; {details}; "
        "nor is there a transforms.json. Run COLMAP on the photos or copy the missing files"
    )


def larger_models(root: Path) -> str | None:
    """Which models of a scene folder have more images than :func:`find_model`'s ``sparse/0``, and what to do; or None.

    COLMAP numbers the parts of a scene that it could not join, not always in the order of their size.
    """
    counts = {}
    for path in sorted((root / "sparse").glob("*/images.bin")):
        with path.open("rb") as file:
            counts[path.parent.name] = int.from_bytes(file.read(_U64.size), "little")
    larger = [f"sparse/{name} has {count}" for name, count in counts.items() if count > counts.get("0", math.inf)]
    if not larger:
        return None
    return (
        f"sparse/0 has {counts['0']} images, {', '.join(larger)}: COLMAP could not join them; --data.model=N "
        "trains on sparse/N"
    )


def check_name(name: str, source: object, allow_outside: bool = False) -> None:
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
        raise SceneError(f"{source} names {name!r}, which is not UTF-8: rename that file or folder") from None
    path = PurePath(name)
    if not allow_outside and (path.anchor or ".." in path.parts):
        raise SceneError(
            f"{source} names {name}, which is not in the scene folder: copy it there, or allow it in fit and test with "
            "--data.allow_outside=true"
        )


def check_binary_files(files: ModelFiles, params_of_model: Mapping[int, int]) -> None:
    """Walk every record of a binary model, so that a damaged file gives an error instead of an endless allocation.

    COLMAP's reader trusts the counts in the files: an empty ``points3D.bin`` makes it allocate without end, and a
    truncated ``cameras.bin`` loads as garbage.

    Args:
        files: The model; ``rigs.bin`` and ``frames.bin`` (COLMAP 4) are checked too where they exist.
        params_of_model: Number of parameters of each camera model id.

    Raises:
        SceneError: A file is empty, truncated, longer than its records, or not a COLMAP table.
    """
    walks: dict[str, RecordEnd] = {
        "cameras": partial(_camera_end, params_of_model),
        "images": _image_end,
        "points3D": _point_end,
        "rigs": _rig_end,
        "frames": _frame_end,
    }
    for table, record_end in walks.items():
        path = files.path(table)
        if table in TABLES or path.is_file():
            _check_table(path, record_end)


def _check_table(path: Path, record_end: RecordEnd) -> None:
    size = path.stat().st_size
    if size < _U64.size:
        raise SceneError(f"{path} has {size} bytes, too few for a COLMAP table: {_REMEDY}")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = _U64.unpack_from(data, 0)
        end = _U64.size
        for row in range(1, count + 1):
            try:
                end = record_end(data, end)
                if end > size:
                    raise struct.error("it ends beyond the file")
            except struct.error as error:
                raise SceneError(
                    f"{path} is truncated or garbled: of {count} declared records, record {row} cannot be read "
                    f"({error}; the file has {size} bytes); {_REMEDY}"
                ) from error
        if end != size:
            raise SceneError(f"{path} is garbled: its {count} declared records end at byte {end} of {size}; {_REMEDY}")


def _camera_end(params_of_model: Mapping[int, int], data: Buffer, start: int) -> int:
    camera_id, model, width, height = _CAMERA.unpack_from(data, start)
    if model not in params_of_model or not 0 < min(width, height) <= max(width, height) <= LARGEST_SIDE:
        raise struct.error(
            f"camera {camera_id} has model id {model} and size {width}x{height}; this pycolmap knows the ids 0 to "
            f"{max(params_of_model)}, sizes go from 1 to {LARGEST_SIDE}"
        )
    return start + _CAMERA.size + 8 * params_of_model[model]


def _image_end(data: Buffer, start: int) -> int:
    name = start + 64  # u32 id, 7 doubles of pose, u32 camera id
    terminator = data.find(b"\0", name)
    if terminator < 0:
        raise struct.error("unterminated name")
    (points,) = _U64.unpack_from(data, terminator + 1)
    return terminator + 1 + _U64.size + 24 * int(points)


def _point_end(data: Buffer, start: int) -> int:
    (track,) = _U64.unpack_from(data, start + 43)  # u64 id, 3 doubles, 3 bytes of colour, double error
    return start + 51 + 8 * int(track)


def _rig_end(data: Buffer, start: int) -> int:
    (sensors,) = _U32.unpack_from(data, start + 4)  # after u32 rig id
    end = start + 8 + (8 if sensors else 0)  # the reference sensor has no pose
    for _ in range(1, sensors):
        end += 9 + (56 if data[end + 8 : end + 9] == b"\1" else 0)
        if end > len(data):
            break
    return end


def _frame_end(data: Buffer, start: int) -> int:
    (images,) = _U32.unpack_from(data, start + 64)  # u32 frame id, u32 rig id, 7 doubles of pose
    return start + 68 + 16 * int(images)


def announced_rows(path: Path) -> int | None:
    """Number of rows that the comment at the head of a text table declares; None where it has no such comment."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if not line.startswith("#"):
                return None
            if found := re.match(r"# Number of \w+: (\d+)", line):
                return int(found[1])
    return None


_LARGEST = 1e18
"""Upper bound on poses and intrinsics: their squares, which rendering computes in float32, stay finite."""

# What pycolmap raises for a file it cannot read: its own checks give ValueError, the C++ library the others.
_READ_ERRORS = (ValueError, RuntimeError, IndexError, KeyError, OSError, MemoryError)


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
    viewmat: NDArray[np.float64]
    mask: Path | None = None


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A COLMAP reconstruction in COLMAP's own world frame, or the cameras of a transforms file as if they were one.

    Attributes:
        images: Registered images, sorted by name.
        cameras: ``pycolmap.Camera`` by id.
        points: Sparse points ``[P, 3]`` float64, scene units, sorted by COLMAP's point id.
        colors: Their colours ``[P, 3]`` uint8 RGB.
        observations: Row of the point and row of the image of each sighting ``[O, 2]`` int64; None unless requested.
        source: Where it comes from, for messages.
        images_folder: Folder of the photos inside the scene folder, where the model says so.
        test: Rows of the test images, where the model says so.
        synthetic: Whether it is a NeRF-synthetic scene, whose transparent pixels are white by convention.
    """

    images: tuple[ColmapImage, ...]
    cameras: dict[int, Any]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    observations: NDArray[np.int64] | None = None
    source: str = "COLMAP"
    images_folder: str | None = None
    test: tuple[int, ...] | None = None
    synthetic: bool = False


def import_pycolmap() -> Any:
    """Import pycolmap, late and after OpenCV and Pillow.

    The wheels bundle different copies of libpng and zlib. If pycolmap's are loaded first, writing a PNG with OpenCV or
    Pillow aborts the process; the imports at the top of this module ensure the right order.
    """
    PIL.Image.preinit()  # loads Pillow's own image libraries, which a bare import leaves for later
    import pycolmap

    return pycolmap


def read_model(root: Path, observations: bool = False, chosen: str | None = None) -> ColmapModel:
    """Read the model of a scene folder, see :func:`nsvq_lightning.data.colmap.find_model` for where it may be.

    Args:
        root: Scene folder.
        observations: Also read which image saw which point; training does not need it.
        chosen: Which model, see there.

    Raises:
        SceneError: There is no model, a file is damaged, or the model has no registered image or no point.
    """
    pycolmap = import_pycolmap()
    files = find_model(root, chosen)
    reconstruction = pycolmap.Reconstruction()
    try:
        if files.suffix == ".bin":
            check_binary_files(files, _parameter_counts(pycolmap))
            reconstruction.read_binary(str(files.folder))
        else:
            reconstruction.read_text(str(files.folder))
    except SceneError:
        raise
    except _READ_ERRORS as error:
        raise SceneError(
            f"COLMAP cannot read the {files.suffix} model in {files.folder} ({error}): a file is damaged or files of "
            "two models are mixed; copy the model again or run COLMAP again"
        ) from error
    if files.suffix == ".txt":
        _check_rows(files, reconstruction)
    return _plain_model(files, reconstruction, observations)


def _parameter_counts(pycolmap: Any) -> dict[int, int]:
    """Number of parameters by camera model id, as this pycolmap knows them."""
    models = [model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
    return {int(m.value): len(pycolmap.Camera.create_from_model_id(1, m, 1.0, 1, 1).params) for m in models}


def _check_rows(files: ModelFiles, reconstruction: Any) -> None:
    """A text table cut off between two lines reads without error, but its head comment still gives the row count."""
    for table in ("cameras", "images", "points3D"):
        path, rows = files.path(table), len(getattr(reconstruction, table))
        announced = announced_rows(path)
        if announced is not None and announced > rows:
            raise SceneError(
                f"{path} announces {announced} rows but has {rows}: it is truncated; copy it again or export it anew"
            )


def _plain_model(files: ModelFiles, reconstruction: Any, observations: bool) -> ColmapModel:
    registered = [image for image in reconstruction.images.values() if image.has_pose]
    try:
        registered.sort(key=lambda image: image.name)
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{files.path('images')}: the name of a photo is not UTF-8 ({error}): rename the photo and run COLMAP "
            "again, or copy the model again if it is damaged"
        ) from error
    images = tuple(ColmapImage(image.name, image.camera_id, _viewmat(image)) for image in registered)
    if not images:
        raise SceneError(f"{files.path('images')} lists no registered image: run COLMAP's mapper again")
    points = sorted(reconstruction.points3D.items())
    if not points:
        raise SceneError(
            f"{files.path('points3D')} has no points, and training starts from them: triangulate with COLMAP "
            "(`colmap point_triangulator`) or run its mapper again"
        )
    broken = [image.name for image in images if not (np.abs(image.viewmat) <= _LARGEST).all()]
    if broken:
        raise SceneError(
            f"{files.path('images')}: {len(broken)} poses are not finite, first {broken[0]}: run COLMAP again"
        )
    _check_cameras(files, {image.camera_id: reconstruction.cameras[image.camera_id] for image in images})
    return ColmapModel(
        images=images,
        cameras=dict(reconstruction.cameras.items()),
        points=np.array([point.xyz for _, point in points], np.float64),
        colors=np.array([point.color for _, point in points], np.uint8),
        observations=_observations(registered, points) if observations else None,
    )


def _check_cameras(files: ModelFiles, cameras: Mapping[int, Any]) -> None:
    """Check sizes and parameters: text tables, which no check has seen before, may hold any number."""
    for number, camera in cameras.items():
        size = camera.width, camera.height
        if not 0 < min(size) <= max(size) <= LARGEST_SIDE or not (np.abs(camera.params) <= _LARGEST).all():
            raise SceneError(
                f"{files.path('cameras')}: camera {number} has size {size[0]}x{size[1]} and parameters "
                f"{camera.params_to_string()}; needed are sizes from 1 to {LARGEST_SIDE} and finite numbers: copy the "
                "model again or run COLMAP again"
            )


def _observations(registered: list[Any], points: list[tuple[int, Any]]) -> NDArray[np.int64]:
    """Pairs of point row and image row, each once: a track may have two features in one image."""
    row_of = {image.image_id: row for row, image in enumerate(registered)}
    pairs = [
        (row, row_of[element.image_id])
        for row, (_, point) in enumerate(points)
        for element in point.track.elements
        if element.image_id in row_of
    ]
    return np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)


def _viewmat(image: Any) -> NDArray[np.float64]:
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    viewmat = np.eye(4)
    viewmat[:3] = pose.matrix()
    return viewmat
