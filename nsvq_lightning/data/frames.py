"""Sharp, evenly spread frames of a video, and photos turned upright, as the pictures of a scene."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import PIL.ImageOps
from cv2.typing import MatLike

from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.images import ORIENTATION, opened
from nsvq_lightning.io.atomic import atomic_path, atomic_write

__all__ = ["PHOTOS", "VIDEOS", "copy_photos", "photos_in", "sharpness", "write_frames"]

PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
"""Suffixes of photos that both COLMAP and this package read."""
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""Suffixes of videos."""
CLOSED = (".heic", ".heif", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".dng")
"""Suffixes of photos that must be converted first."""
SMALL = 480
"""Width in pixels at which sharpness is measured: noise is no sharpness."""
TINY = 48, 27
"""Pixels at which two frames are compared."""
STILL = 2.0
"""Mean difference, of 255, below which the camera has not moved between two frames."""
JPEG_QUALITY = 95


def photos_in(folder: Path) -> list[Path]:
    """The photos of a folder, sorted by name.

    Raises:
        SceneError: There are none, or some in a format that must be converted first.
    """
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    closed = [path.name for path in files if path.suffix.lower() in CLOSED]
    if closed:
        raise SceneError(
            f"{folder}: {closed[0]} and {len(closed) - 1} more cannot be read: convert them to JPEG first, for example "
            f"with 'magick mogrify -format jpg *{Path(closed[0]).suffix}', or set the phone to \"most compatible\""
        )
    photos = [path for path in files if path.suffix.lower() in PHOTOS]
    if not photos:
        raise SceneError(f"{folder}: no photos; it must hold files that end in {', '.join(PHOTOS)}")
    return photos


def copy_photos(photos: Sequence[Path], folder: Path, done: Callable[[int], None]) -> list[tuple[Path, str]]:
    """Copy photos into a folder, those with an EXIF orientation turned upright; copies that are there already stay.

    Args:
        photos: The files.
        folder: Where to, existing.
        done: Called with how many have been treated.

    Returns:
        Photos that cannot be read, and why; they are not copied.
    """
    damaged = []
    for count, path in enumerate(photos, 1):
        target = folder / path.name
        try:
            with path.open("rb") as file, opened(file) as image:
                turned = image.getexif().get(ORIENTATION, 1) != 1
                if not turned:
                    image.load()
                elif not target.exists():
                    upright = PIL.ImageOps.exif_transpose(image)
                    with atomic_write(target) as copy:
                        exif = upright.getexif().tobytes()
                        upright.save(copy, image.format, quality=JPEG_QUALITY, exif=exif)
            if not turned and not target.exists():
                with atomic_path(target) as unfinished:
                    shutil.copyfile(path, unfinished)
        except (OSError, SyntaxError, ValueError) as error:
            damaged.append((path, str(error)))
        done(count)
    return damaged


def sharpness(picture: MatLike) -> float:
    """Variance of the Laplacian of a picture, reduced to the same width whatever its size: more is sharper."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
    factor = min(1.0, SMALL / grey.shape[1])
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_64F).var())


class _Frame(NamedTuple):
    number: int
    sharpness: float
    picture: MatLike


def write_frames(video: Path, folder: Path, count: int, done: Callable[[int], None]) -> list[Path]:
    """Write the sharpest frame of each of ``count`` equal parts of a video as a JPEG; still parts are left out.

    Args:
        video: The file; OpenCV turns its frames upright.
        folder: Where to, existing.
        count: Number of parts.
        done: Called with the number of frames that have been read.

    Returns:
        The pictures, named after the frames, in order.

    Raises:
        SceneError: The file is not a video that can be read.
    """
    total = frame_count(video)
    parts = min(count, total)
    written: list[Path] = []
    best: _Frame | None = None
    last: MatLike | None = None
    part = 0
    for index, picture in _frames(video):
        if index * parts // total != part:
            last = _keep(best, folder, last, written)
            best, part = None, index * parts // total
        found = sharpness(picture)
        if best is None or found > best.sharpness:
            best = _Frame(index, found, picture)
        done(index + 1)
    _keep(best, folder, last, written)
    return written


def frame_count(video: Path) -> int:
    """Number of frames of a video.

    Raises:
        SceneError: The file is not a video that can be read.
    """
    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    if total <= 0 and reader.isOpened():  # some containers do not say
        total = 0
        while reader.grab():
            total += 1
    reader.release()
    if total <= 0:
        raise SceneError(f"{video}: no frame can be read; convert it with 'ffmpeg -i {video.name} converted.mp4'")
    return total


def _frames(video: Path) -> Iterator[tuple[int, MatLike]]:
    reader, index = cv2.VideoCapture(str(video)), 0
    try:
        while True:
            found, picture = reader.read()
            if not found:
                return
            yield index, picture
            index += 1
    finally:
        reader.release()


def _keep(best: _Frame | None, folder: Path, last: MatLike | None, written: list[Path]) -> MatLike | None:
    """Write a frame unless it shows what the last one did; returns the last one kept, tiny."""
    if best is None:
        return last
    tiny = cv2.resize(best.picture, TINY, interpolation=cv2.INTER_AREA).astype(np.float32)
    if last is not None and float(np.abs(tiny - last).mean()) < STILL:
        return last
    path = folder / f"frame_{best.number:06d}.jpg"
    with atomic_write(path) as file:
        file.write(cv2.imencode(".jpg", best.picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
    written.append(path)
    return tiny
