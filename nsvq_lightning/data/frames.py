"""Sharp, evenly spread frames of a video, and photos turned upright, as the pictures of a scene."""

import itertools
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import PIL.ImageOps
from cv2.typing import MatLike

from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.images import DAMAGED, ORIENTATION
from nsvq_lightning.io.atomic import atomic_path, atomic_write

# Suffixes of photos that both COLMAP and this package read.
PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
# Suffixes of videos.
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")


def photos_in(folder: Path) -> list[Path]:
    """The photos of a folder, sorted by name.

    Raises:
        SceneError: There are none, or some in a format that must be converted first.
    """
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    must_convert = (".heic", ".heif", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".dng")
    closed = [path.name for path in files if path.suffix.lower() in must_convert]
    if closed:
        raise SceneError(
            f"{folder}: {closed[0]} and {len(closed) - 1} more cannot be read: convert them to JPEG first, for example "
            f"with 'magick mogrify -format jpg *{Path(closed[0]).suffix}', or set the phone to \"most compatible\""
        )
    photos = [path for path in files if path.suffix.lower() in PHOTOS]
    if not photos:
        raise SceneError(f"{folder}: no photos; it must hold files that end in {', '.join(PHOTOS)}")
    return photos


JPEG_QUALITY = 95


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
            with PIL.Image.open(path) as image:
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
        except DAMAGED as error:
            damaged.append((path, str(error)))
        done(count)
    return damaged


def sharpness(picture: MatLike) -> float:
    """Variance of the Laplacian of a picture, reduced to the same width whatever its size: more is sharper."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
    factor = min(1.0, 480 / grey.shape[1])  # noise is no sharpness
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_64F).var())


# Mean difference, of 255, below which the camera has not moved between two frames.
STILL = 2.0


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
    last: MatLike | None = None
    for _, part in itertools.groupby(_frames(video, done), key=lambda frame: frame[0] * parts // total):
        number, picture = max(part, key=lambda frame: sharpness(frame[1]))
        tiny = cv2.resize(picture, (48, 27), interpolation=cv2.INTER_AREA).astype(np.float32)
        if last is not None and float(np.abs(tiny - last).mean()) < STILL:
            continue
        path = folder / f"frame_{number:06d}.jpg"
        with atomic_write(path) as file:
            file.write(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
        written.append(path)
        last = tiny
    return written


def frame_count(video: Path) -> int:
    """Number of frames of a video.

    Raises:
        SceneError: The file is not a video that can be read.
    """
    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    reader.release()
    if total <= 0:  # some containers do not say
        total = sum(1 for _ in _frames(video, lambda _: None))
    if not total:
        raise SceneError(f"{video}: no frame can be read; convert it with 'ffmpeg -i {video.name} converted.mp4'")
    return total


def _frames(video: Path, done: Callable[[int], None]) -> Iterator[tuple[int, MatLike]]:
    """The frames with their numbers; ``done`` is called with how many have been used."""
    reader = cv2.VideoCapture(str(video))
    try:
        for index in itertools.count():
            found, picture = reader.read()
            if not found:
                return
            yield index, picture
            done(index + 1)
    finally:
        reader.release()
