"""Image files: decoding to RGB bytes, and a cache of them with a byte budget."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import torch
from numpy.typing import NDArray
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from torch import Tensor

from nsvq_lightning.data.model_files import SceneError
from nsvq_lightning.data.undistort import Pinhole, Undistortion
from nsvq_lightning.skips import is_on

__all__ = ["ImageSource", "ImageStore", "encode_png", "image_size", "read_image"]

# COLMAP works on the pixels as stored, so the EXIF orientation must not be applied.
_READ = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

_MOST_A_BYTE = 10_000
"""Pixels per byte of the file; no photo comes near, and an empty PNG of one bit per pixel has 8000."""

_DAMAGED = (OSError, ValueError, SyntaxError, KeyError)
"""What Pillow raises for a file that is damaged or not a picture."""

_TIFF_SIZE, _TIFF_ORIENTATION = (256, 257), 274
_LIMIT = threading.Lock()

_MIRRORED = {2: (1,), 3: (0, 1), 4: (0,), 6: (0,), 7: (0, 1), 8: (1,)}
"""By orientation, the axes to mirror; from 5 on, rows and columns are swapped first."""


def _undecodable(path: Path, reason: str) -> SceneError:
    return SceneError(f"image {path} cannot be decoded ({reason}): copy it again, or remove it and run COLMAP again")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels as stored, read from the head of the file.

    Raises:
        SceneError: The file is not an image, or its head declares more pixels than it can hold.
    """
    try:
        with _opened(path) as image:
            width, height = image.size
            if image.format == "TIFF":  # Pillow applies the orientation to their size
                width, height = (int(image.getexif()[tag]) for tag in _TIFF_SIZE)
    except _DAMAGED as error:
        raise _undecodable(path, str(error)) from error
    if width * height > _MOST_A_BYTE * path.stat().st_size:
        raise _undecodable(path, f"its head declares {width}x{height} pixels in {path.stat().st_size} bytes")
    return width, height


@contextmanager
def _opened(path: Path) -> Iterator[PIL.Image.Image]:
    """Open the head of a picture of any size, past Pillow's pixel limit, which phones exceed; nothing is decoded."""
    with _LIMIT:
        usual, PIL.Image.MAX_IMAGE_PIXELS = PIL.Image.MAX_IMAGE_PIXELS, None
        try:
            image = PIL.Image.open(path)
        finally:
            PIL.Image.MAX_IMAGE_PIXELS = usual
    with image:
        yield image


def read_image(path: Path) -> NDArray[np.uint8]:
    """Decode an image to RGB ``[H, W, 3]`` uint8: grey is repeated, alpha dropped, 16 bit scaled to 8.

    Raises:
        SceneError: The file is damaged or has floating-point pixels.
    """
    data = path.read_bytes()  # imread fails on names outside the locale's character set
    try:
        orientation = _orientation(data)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), _READ)
    except _DAMAGED:
        image = None
    except cv2.error as error:  # a size beyond OpenCV's limits
        raise _undecodable(path, str(error)) from error
    if image is None:
        raise _undecodable(path, f"truncated, damaged or of an unknown format, {len(data)} bytes")
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if image.dtype != np.uint8:
        raise _undecodable(path, f"its pixels are {image.dtype}; accepted are 8 and 16 bit integers")
    return _turned_back(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), orientation)


def encode_png(rgb: NDArray[np.uint8]) -> bytes:
    """A PNG file of RGB bytes ``[H, W, 3]``.

    Raises:
        OSError: The picture could not be encoded.
    """
    # Not imwrite, which on Windows fails on names outside the locale's character set.
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    if not encoded:
        raise OSError(f"cannot encode a picture of shape {list(rgb.shape)}")
    return bytes(data)


def _orientation(data: bytes) -> int:
    """The orientation that OpenCV applies to the picture; also refuses truncation that OpenCV would not notice.

    Raises:
        OSError: The file is incomplete; the other errors of ``_DAMAGED`` mean the same.
    """
    file = io.BytesIO(data)
    if data.startswith(b"\x89PNG"):
        PngImageFile(file).verify()  # OpenCV allocates chunks of any declared length, up to 2 GB, before it reads them
    elif data.startswith(b"\xff\xd8"):
        JpegImageFile(file)  # up to the first scan
        if b"\xff\xd9" not in data[file.tell() :]:
            raise OSError("there is no end marker")  # OpenCV 4 would fill the missing part with grey
    elif data.startswith((b"II", b"MM")):
        tags = PIL.Image.Exif()  # the tags of a TIFF, whatever its pixels are
        tags.load(data)
        return int(tags.get(_TIFF_ORIENTATION, 1))
    return 1


def _turned_back(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """A TIFF's pixels as stored: OpenCV applies the orientation to TIFFs even when told not to."""
    stored = pixels.transpose(1, 0, 2) if orientation >= 5 else pixels
    return np.ascontiguousarray(np.flip(stored, _MIRRORED.get(orientation, ())))


@dataclass(frozen=True, eq=False)
class ImageSource:
    """How the picture of one view is made from its file.

    Attributes:
        path: Image file.
        size: Its width and height in pixels.
        undistortion: Applied first; None for a pinhole camera.
        pinhole: Camera of the resulting picture, which is resized to its size.
    """

    path: Path
    size: tuple[int, int]
    undistortion: Undistortion | None
    pinhole: Pinhole

    @property
    def nbytes(self) -> int:
        """Bytes of the picture in memory."""
        return 3 * self.pinhole.width * self.pinhole.height

    def load(self) -> Tensor:
        """The picture, ``[H, W, 3]`` uint8 RGB.

        Raises:
            SceneError: The file is damaged or has changed its size since the scene was loaded.
        """
        image = read_image(self.path)
        height, width = image.shape[:2]
        if (width, height) != self.size:
            raise _undecodable(self.path, f"decoded to {width}x{height}, its head says {self.size[0]}x{self.size[1]}")
        if self.undistortion is not None:
            image = self.undistortion(image)
        if image.shape[:2] != (self.pinhole.height, self.pinhole.width) or not is_on("resizing"):
            image = cv2.resize(image, (self.pinhole.width, self.pinhole.height), interpolation=cv2.INTER_AREA)
        return torch.from_numpy(np.ascontiguousarray(image))


class ImageStore:
    """Pictures by index, decoded at first use and kept while the byte budget lasts.

    A kept picture stays: under a random order without replacement, an LRU cache smaller than the scene would evict what
    the next epoch needs first. Pictures beyond the budget are decoded anew each time; :meth:`prefetch` does that in the
    background, with one thread per picture, so that no thread pool has to survive a fork.

    Args:
        sources: One entry per view.
        cache_bytes: Budget for the kept pictures in bytes; 0 keeps none.

    Raises:
        ValueError: ``cache_bytes`` is negative.
    """

    def __init__(self, sources: Sequence[ImageSource], cache_bytes: int = 4 << 30) -> None:
        if cache_bytes < 0:
            raise ValueError(f"cache_bytes must be at least 0, got {cache_bytes}")
        self.sources = tuple(sources)
        self.nbytes = sum(source.nbytes for source in self.sources)
        """Bytes of all pictures, decoded."""
        self._free = cache_bytes
        self._kept: dict[int, Tensor] = {}
        self._coming: dict[int, Future[Tensor]] = {}

    def __len__(self) -> int:
        return len(self.sources)

    def __getitem__(self, index: int) -> Tensor:
        """Picture ``index``, ``[H, W, 3]`` uint8 RGB on the CPU; treat it as read-only.

        Raises:
            SceneError: The file cannot be decoded.
        """
        if index in self._kept:
            return self._kept[index]
        coming = self._coming.pop(index, None)
        image = coming.result() if coming is not None else self.sources[index].load()
        if image.nbytes <= self._free:
            self._kept[index] = image
            self._free -= image.nbytes
        return image

    def prefetch(self, index: int) -> None:
        """Start decoding picture ``index`` in the background; errors are raised when it is requested."""
        if index in self._kept or index in self._coming:
            return
        while len(self._coming) > 1:  # prefetched and never requested
            self._coming.pop(next(iter(self._coming)))
        future: Future[Tensor] = Future()
        self._coming[index] = future
        threading.Thread(target=_load_into, args=(future, self.sources[index]), name="nsvq-image").start()

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_coming": {}}


def _load_into(future: Future[Tensor], source: ImageSource) -> None:
    try:
        future.set_result(source.load())
    except Exception as error:  # passed on to whoever requests the picture
        future.set_exception(error)
