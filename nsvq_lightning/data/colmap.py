"""A COLMAP model: its files, checked before a reader allocates memory for them, and what they hold.

The only place that imports pycolmap.
"""

import itertools
import math
import mmap
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see import_pycolmap)
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from nsvq_lightning.data import NO_FOLDER


class SceneError(ValueError):
    """A scene folder that cannot be used; the message names the file, what is wrong with it and what to do."""


# Pixels; a camera with a larger side is damaged.
LARGEST_SIDE = (1 << 20) - 1
# Upper bound on poses and intrinsics: their squares, which rendering computes in float32, stay finite.
LARGEST = 1e18


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

    Raises:
        SceneError: It is not installed.
    """
    PIL.Image.preinit()  # loads Pillow's own image libraries, which a bare import leaves for later
    try:
        import pycolmap
    except ModuleNotFoundError as error:
        raise SceneError(
            "pycolmap, which reads and writes COLMAP models, is not installed (it has no wheel for Linux on ARM64): "
            "build it, or give a folder with a transforms.json"
        ) from error
    return pycolmap


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


# Where a model may be inside a scene folder, in order of preference.
FOLDERS = ("sparse/0", "sparse", ".")
# The three tables every COLMAP model has.
TABLES = ("cameras", "images", "points3D")


def find_model(root: Path, folders: Sequence[str] = FOLDERS) -> dict[str, Path] | None:
    """The files of the tables of the first complete model in the folders, binary before text; None if there is none.

    Args:
        root: Scene folder.
        folders: Where to look inside it.
    """
    for folder, suffix in itertools.product(folders, (".bin", ".txt")):
        files = {table: root / folder / f"{table}{suffix}" for table in TABLES}
        if all(path.is_file() for path in files.values()):
            return files
    return None


def read_model(root: Path, observations: bool = False, chosen: str | None = None) -> ColmapModel:
    """Read the model of a scene folder: in ``sparse/0``, ``sparse`` or the folder itself, binary before text.

    Args:
        root: Scene folder.
        observations: Also read which image saw which point; training does not need it.
        chosen: N for ``sparse/N``, or a folder inside ``root``; None looks in the three places.

    Raises:
        SceneError: There is no such folder or no model, a file is damaged, or the model has no registered image or no
            point.
    """
    if not root.is_dir():
        raise SceneError(NO_FOLDER.format(root))
    folders = FOLDERS if chosen is None else (f"sparse/{chosen}" if chosen.isdecimal() else chosen,)
    if (files := find_model(root, folders)) is None:
        raise no_model(root, folders, chosen)
    reconstruction = _read(files)
    registered = [image for image in reconstruction.images.values() if image.has_pose]
    try:
        registered.sort(key=lambda image: image.name)
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{files['images']}: the name of a photo is not UTF-8 ({error}): rename the photo and run COLMAP "
            "again, or copy the model again if it is damaged"
        ) from error
    if not registered:
        raise SceneError(f"{files['images']} lists no registered image: run COLMAP's mapper again")
    points = sorted(reconstruction.points3D.items())
    if not points:
        raise SceneError(
            f"{files['points3D']} has no points, and training starts from them: triangulate with COLMAP "
            "(`colmap point_triangulator`) or run its mapper again"
        )
    images = tuple(
        ColmapImage(image.name, image.camera_id, np.array([*image.cam_from_world().matrix(), (0.0, 0.0, 0.0, 1.0)]))
        for image in registered
    )
    broken = [image.name for image in images if not _is_finite(image.viewmat)]
    if broken:
        raise SceneError(f"{files['images']}: {len(broken)} poses are not finite, first {broken[0]}: run COLMAP again")
    for number in dict.fromkeys(image.camera_id for image in images):
        camera = reconstruction.cameras[number]  # of a text table, which no check has seen before, it may be anything
        size = camera.width, camera.height
        if not 0 < min(size) <= max(size) <= LARGEST_SIDE or not _is_finite(camera.params):
            raise SceneError(
                f"{files['cameras']}: camera {number} has size {size[0]}x{size[1]} and parameters "
                f"{camera.params_to_string()}; needed are sizes from 1 to {LARGEST_SIDE} and finite numbers: copy the "
                "model again or run COLMAP again"
            )
    return ColmapModel(
        images=images,
        cameras=dict(reconstruction.cameras.items()),
        points=np.array([point.xyz for _, point in points], np.float64),
        colors=np.array([point.color for _, point in points], np.uint8),
        observations=_observations(registered, points) if observations else None,
    )


def alignment(model: ColmapModel, other: ColmapModel) -> NDArray[np.float64]:
    """The similarity ``[4, 4]`` that takes the camera centres of a model nearest to those of another, by photo name.

    Raises:
        SceneError: They share fewer than three photos, or these lie on a line, and so do not say how it turns.
    """
    centres = [
        {image.name: -image.viewmat[:3, :3].T @ image.viewmat[:3, 3] for image in found.images}
        for found in (model, other)
    ]
    shared = sorted(centres[0].keys() & centres[1].keys())
    ours, theirs = (np.array([places[name] for name in shared]).reshape(-1, 3) for places in centres)
    for places in (ours, theirs):
        if len(shared) < 3 or np.linalg.matrix_rank(places - places.mean(0), 1e-6 * np.ptp(places)) < 2:
            raise SceneError(
                f"{len(shared)} photos of the same name are in both scenes: to align them takes three that were not "
                "taken from one line"
            )
    matrix = np.eye(4)
    matrix[:3] = import_pycolmap().estimate_sim3d(ours, theirs).matrix()
    return matrix


def _is_finite(values: NDArray[np.float64]) -> bool:
    return bool((np.abs(values) <= LARGEST).all())


def no_model(root: Path, folders: Sequence[str], chosen: str | None) -> SceneError:
    """What to say of a folder without a complete model."""
    missing = []
    for folder, suffix in itertools.product(folders, (".bin", ".txt")):
        absent = [table + suffix for table in TABLES if not (root / folder / f"{table}{suffix}").is_file()]
        if len(absent) < len(TABLES):
            missing.append(f"{folder} has a {suffix} model without {', '.join(absent)}")
    where, advice = root, "nor is there a transforms.json: make a scene with nsvq prepare, or copy the missing files"
    if chosen is not None:
        others = sorted({str(path.parent.relative_to(root)) for path in (root / "sparse").glob("*/cameras.*")})
        where = root / folders[0]
        advice = f"choose another (--data.model); there is {', '.join(others) or 'none in sparse/'}"
    return SceneError(
        f"no COLMAP model in {where}: looked for cameras, images and points3D (.bin or .txt) in {', '.join(folders)}; "
        f"{'; '.join(missing) or 'none of the three files is in any of them'}; {advice}"
    )


def larger_models(root: Path) -> str | None:
    """Which models of a scene folder have more images than its ``sparse/0``, and what to do; None if there are none.

    COLMAP numbers the parts of a scene that it could not join, not always in the order of their size.
    """
    files = sorted((root / "sparse").glob("*/images.bin"))
    counts = {path.parent.name: int(np.fromfile(path, "<u8", 1).sum()) for path in files}
    larger = [f"sparse/{name} has {count}" for name, count in counts.items() if count > counts.get("0", math.inf)]
    advice = "COLMAP could not join them; --data.model=N trains on sparse/N"
    return f"sparse/0 has {counts['0']} images, {', '.join(larger)}: {advice}" if larger else None


def _read(files: Mapping[str, Path]) -> Any:
    """The ``pycolmap.Reconstruction`` in the files.

    Raises:
        SceneError: A file is damaged.
    """
    pycolmap = import_pycolmap()
    reconstruction = pycolmap.Reconstruction()
    folder, suffix = files["cameras"].parent, files["cameras"].suffix
    if suffix == ".bin":
        models = [model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
        params = {int(m.value): len(pycolmap.Camera.create_from_model_id(1, m, 1.0, 1, 1).params) for m in models}
        for table in (*TABLES, "rigs", "frames"):  # the last two are COLMAP 4's
            path = folder / f"{table}.bin"
            if table in TABLES or path.is_file():
                _check_table(table, path, params)
    read = reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text
    try:
        read(str(folder))
    # pycolmap's own checks give ValueError, its C++ library the others.
    except (ValueError, RuntimeError, IndexError, KeyError, OSError, MemoryError) as error:
        raise SceneError(
            f"COLMAP cannot read the {suffix} model in {folder} ({error}): a file is damaged or files of "
            "two models are mixed; copy the model again or run COLMAP again"
        ) from error
    if suffix == ".txt":
        for table, path in files.items():
            _check_rows(path, len(getattr(reconstruction, table)))
    return reconstruction


_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height


def _check_table(table: str, path: Path, params: Mapping[int, int]) -> None:
    """Walk every record of a binary table, so that a damaged file gives an error instead of an endless allocation.

    COLMAP's reader trusts the counts in the files: an empty ``points3D.bin`` makes it allocate without end, and a
    truncated ``cameras.bin`` loads as garbage.

    Args:
        table: Its name.
        path: Its file.
        params: Number of parameters of each camera model by its id.

    Raises:
        SceneError: The file is empty, truncated, longer than its records, or not a COLMAP table.
    """
    remedy = "copy the model again or export it anew with `colmap model_converter`"
    size = path.stat().st_size
    if size < _U64.size:
        raise SceneError(f"{path} has {size} bytes, too few for a COLMAP table: {remedy}")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = _U64.unpack_from(data, 0)
        end = _U64.size
        for row in range(1, count + 1):
            try:
                end = _record_end(table, data, end, params)
                if end > size:
                    raise struct.error("it ends beyond the file")
            except struct.error as error:
                raise SceneError(
                    f"{path} is truncated or garbled: of {count} declared records, record {row} cannot be read "
                    f"({error}; the file has {size} bytes); {remedy}"
                ) from error
        if end != size:
            raise SceneError(f"{path} is garbled: its {count} declared records end at byte {end} of {size}; {remedy}")


def _record_end(table: str, data: mmap.mmap, start: int, params: Mapping[int, int]) -> int:
    """Where a record of a table ends that begins at ``start``.

    Raises:
        struct.error: It is damaged, or what tells its length is beyond the end of the file.
    """
    match table:
        case "cameras":
            camera_id, model, width, height = _CAMERA.unpack_from(data, start)
            if model not in params or not 0 < min(width, height) <= max(width, height) <= LARGEST_SIDE:
                raise struct.error(
                    f"camera {camera_id} has model id {model} and size {width}x{height}; this pycolmap knows the ids 0 "
                    f"to {max(params)}, sizes go from 1 to {LARGEST_SIDE}"
                )
            return start + _CAMERA.size + 8 * params[model]
        case "images":
            terminator = data.find(b"\0", start + 64)  # after u32 id, 7 doubles of pose, u32 camera id: the name
            if terminator < 0:
                raise struct.error("unterminated name")
            (points,) = _U64.unpack_from(data, terminator + 1)
            return terminator + 1 + _U64.size + 24 * int(points)
        case "points3D":
            (track,) = _U64.unpack_from(data, start + 43)  # u64 id, 3 doubles, 3 bytes of colour, double error
            return start + 51 + 8 * int(track)
        case "frames":
            (images,) = _U32.unpack_from(data, start + 64)  # u32 frame id, u32 rig id, 7 doubles of pose
            return start + 68 + 16 * int(images)
        case _:  # rigs
            (sensors,) = _U32.unpack_from(data, start + 4)  # after u32 rig id
            end = start + 8 + (8 if sensors else 0)  # the reference sensor has no pose
            for _ in range(1, sensors):
                end += 9 + (56 if data[end + 8 : end + 9] == b"\1" else 0)
                if end > len(data):
                    break
            return end


def _check_rows(path: Path, rows: int) -> None:
    """A text table cut off between two lines reads without error, but its head comment still gives the row count."""
    with path.open(encoding="utf-8", errors="replace") as file:
        head = "".join(itertools.takewhile(lambda line: line.startswith("#"), file))
    announced = re.search(r"^# Number of \w+: (\d+)", head, re.MULTILINE)
    if announced and int(announced[1]) > rows:
        raise SceneError(f"{path} announces {announced[1]} rows but has {rows}: it is truncated; copy it again")


def _observations(registered: Sequence[Any], points: Sequence[tuple[int, Any]]) -> NDArray[np.int64]:
    """Pairs of point row and image row, each once: a track may have two features in one image."""
    row_of = {image.image_id: row for row, image in enumerate(registered)}
    pairs = [
        (row, row_of[element.image_id])
        for row, (_, point) in enumerate(points)
        for element in point.track.elements
        if element.image_id in row_of
    ]
    return np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)
