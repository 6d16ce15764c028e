"""Reads a COLMAP model. The only place that imports pycolmap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see import_pycolmap)
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from nsvq_lightning.data.model_files import (
    LARGEST_SIDE,
    ModelFiles,
    SceneError,
    announced_rows,
    check_binary_files,
    find_model,
)

__all__ = ["ColmapImage", "ColmapModel", "import_pycolmap", "read_model"]

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
    """Read the model of a scene folder, see :func:`nsvq_lightning.data.model_files.find_model` for where it may be.

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
