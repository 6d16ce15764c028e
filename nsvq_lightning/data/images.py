"""From the file of a photo to the picture that a view is compared with, which is kept while a byte budget lasts."""

import struct
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from PIL import Image, ImageCms
from PIL.ExifTags import Base
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from torch import Tensor

from nsvq_lightning.compute.devices import to_device
from nsvq_lightning.data.colmap import Pinhole, SceneError
from nsvq_lightning.data.undistortion import Undistortion
from nsvq_lightning.io.atomic import make_folder_of, write_bytes
from nsvq_lightning.io.errors import LFS, POINTER
from nsvq_lightning.splats.conventions import Arrays, Bools, Uint8s
from nsvq_lightning.top_level import log

# Pillow refuses twice as many, and by default fewer than phones have.
Image.MAX_IMAGE_PIXELS = 1 << 27
# What Pillow raises for a file that is damaged, not a picture, or beyond that limit.
DAMAGED = (OSError, ValueError, SyntaxError, KeyError, TypeError, struct.error, Image.DecompressionBombError)
# EXIF orientations from here on: stored lying on its side, so that programs that apply it swap width and height.
ON_ITS_SIDE = 5
# Relative difference of aspect ratios that rounding explains.
ROUNDED = 0.01


# Width and height in pixels.
Size = tuple[int, int]


class ImageHead(NamedTuple):
    """What the head of an image file says: width and height in pixels as stored, EXIF orientation, transparency."""

    size: Size
    orientation: int
    has_alpha: bool


def exif_of(image: Image.Image) -> Image.Exif:
    """The EXIF tags of an open image; Pillow would decode a whole PNG for those behind its pixels, which few have."""
    return Image.Exif() if image.format == "PNG" and "exif" not in image.info else image.getexif()


def image_head(path: Path) -> ImageHead:
    """What the head of an image file says.

    Raises:
        SceneError: The file is not an image, or its head declares too many pixels.
    """
    try:
        with Image.open(path) as image:
            size = image.size
            tags = exif_of(image)
            orientation = int(tags.get(Base.Orientation, 1))
            if image.format == "TIFF":  # Pillow applies the orientation to their size
                size = int(tags[Base.ImageWidth]), int(tags[Base.ImageLength])
            has_alpha = image.has_transparency_data
    except DAMAGED as error:
        raise _undecodable(path, str(error)) from error
    return ImageHead(size, orientation, has_alpha)


def is_cut(one: Size, other: Size) -> bool:
    """Whether a photo of size (width, height) ``one`` shows another part than its camera of size ``other``.

    Those that differ little were not scaled, but cut, as photos without their distortion are.
    """
    return not same_shape(one, other) or ROUNDED * other[0] + 2 < abs(one[0] - other[0]) < 0.12 * other[0]


def same_shape(one: Size, other: Size) -> bool:
    """Whether two sizes (width, height) have one aspect ratio, up to rounding of a side to a pixel of either."""
    return abs(one[0] * other[1] - one[1] * other[0]) <= max(ROUNDED * one[1] * other[0], *one, *other)


def is_transparent(path: Path) -> bool:
    """Whether any pixel of an image that can be read is transparent; an alpha channel alone does not say so."""
    with Image.open(path) as image:
        return min(image.convert("RGBA").getchannel("A").tobytes()) < 255


def head_for(path: Path, expected: Size, as_shown: bool = False) -> ImageHead:
    """The head of a photo for a camera of some size: with the orientation to apply, and the size that it then has.

    Args:
        path: Image file; of one that cannot be read, the head is as expected.
        expected: Width and height of the camera, pixels.
        as_shown: Whether other photos say that the cameras are of photos as their EXIF orientation shows them.
    """
    try:
        size, orientation, has_alpha = image_head(path)
    except SceneError:
        return ImageHead(expected, 1, False)  # it is left out once its pixels are missed
    # COLMAP calibrates photos as they are stored, other programs as their EXIF orientation shows them.
    shown = size[::-1] if orientation >= ON_ITS_SIDE else size
    if same_shape(shown, expected) and (as_shown or not same_shape(size, expected)):
        return ImageHead(shown, orientation, has_alpha)
    return ImageHead(size, 1, has_alpha)


def _undecodable(path: Path, reason: str) -> SceneError:
    with suppress(OSError), path.open("rb") as file:
        if file.read(len(LFS)) == LFS:
            reason = POINTER
    return SceneError(
        f"image {path} cannot be decoded ({reason}): copy it again, or remove it, and run COLMAP again if it is a photo"
    )


def read_image(path: Path) -> Uint8s:
    """Decode an image to RGB ``[H, W, 3]`` uint8: grey is repeated, alpha dropped, 16 bit scaled to 8.

    Raises:
        SceneError: The file is damaged or has floating-point pixels.
    """
    pixels = _to_bytes(_decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH))
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)  # type: ignore[no-any-return]


@cache
def _to_srgb(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """What takes colours of a photo to those of sRGB, which all viewers show; None if they are, or nothing says it."""
    try:
        own = ImageCms.ImageCmsProfile(BytesIO(profile))
        name = ImageCms.getProfileDescription(own).strip()
        if "srgb" in name.lower():
            return None
        turn = ImageCms.buildTransform(own, ImageCms.createProfile("sRGB"), "RGB", "RGB")
    except (OSError, ImportError, ImageCms.PyCMSError):  # Pillow may have been built without
        return None
    log.info(f"photos are in the colours of {name}, and are turned into those of sRGB, which viewers show")
    return turn


def _decoded(path: Path, flags: int) -> Arrays:
    """Decode an image as OpenCV does, of 8 or 16 bits, with the pixels as stored: those are what COLMAP works on.

    Args:
        path: Image file.
        flags: Of ``cv2.imdecode``.

    Raises:
        SceneError: The file is damaged, has floating-point pixels, or declares too many pixels.
    """
    try:
        data = path.read_bytes()  # imread fails on names outside the locale's character set
    except OSError as error:
        raise SceneError(
            f"image {path} cannot be read any more ({error.strerror}): it was there when the scene was loaded"
        ) from error
    try:
        with Image.open(BytesIO(data)) as head:
            # OpenCV applies the orientation to TIFFs even when told not to.
            applied = int(head.getexif().get(Base.Orientation, 1)) if head.format == "TIFF" else 1
            _check_whole(data)
            grey = head.mode in ("LA", "PA") or (head.mode in ("L", "1") and "transparency" in head.info)
            if (head.format == "TIFF" and head.mode == "RGBA") or (grey and flags == cv2.IMREAD_UNCHANGED):
                # OpenCV would multiply colours by alpha, or leave it out.
                image = cv2.cvtColor(np.asarray(head.convert("RGBA")), cv2.COLOR_RGBA2BGRA)
            else:
                image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise OSError("OpenCV cannot decode it")
    except (*DAMAGED, cv2.error) as error:
        reason = f"truncated, damaged, too large or of an unknown format, {len(data)} bytes: {error}"
        raise _undecodable(path, reason) from error
    if image.dtype not in (np.uint8, np.uint16):
        raise _undecodable(path, f"its pixels are {image.dtype}: save 8 or 16 bit integers, a mask in 0 and 255")
    return _turned_back(image, applied)


def _to_bytes(pixels: Arrays) -> Uint8s:
    """Pixels of 8 or 16 bits in 8."""
    # Rounds; none of the 65536 is near a half.
    return pixels if pixels.dtype == np.uint8 else cv2.convertScaleAbs(pixels, alpha=1 / 257)


def _check_whole(data: bytes) -> None:
    """Refuse truncation that OpenCV would not notice.

    Raises:
        OSError: The file is incomplete; the other errors of ``DAMAGED`` mean the same.
    """
    file = BytesIO(data)
    if data.startswith(b"\x89PNG"):
        PngImageFile(file).verify()  # OpenCV allocates chunks of any declared length, up to 2 GB, before it reads them
    elif data.startswith(b"\xff\xd8"):
        JpegImageFile(file)  # up to the first scan
        if b"\xff\xd9" not in data[file.tell() :]:
            raise OSError("there is no end marker")  # OpenCV 4 would fill the missing part with grey


def _turned_back(pixels: Arrays, orientation: int) -> Arrays:
    """Pixels to which an EXIF orientation was applied, as they were stored."""
    if orientation >= ON_ITS_SIDE:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 6, 7):
        pixels = pixels[::-1]
    if orientation in (2, 3, 7, 8):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def read_mask(path: Path, size: Size) -> Bools:
    """Which pixels of a photo count ``[H, W]``: those that are more than half as bright as the brightest.

    So white and 1 are kept, in 8 or 16 bits, black is excluded. Where pixels are transparent, that is the mask; in
    colours or small numbers, as of labels or of photos cut out, all counts that is not black. A mask of another size is
    scaled, unless it is a few percent off: then it is of the photo before it was cut or undistorted.

    Args:
        path: Image file.
        size: Width and height of the photo, pixels.

    Raises:
        SceneError: The file is damaged, or shows another part than the photo (:func:`is_cut`).
    """
    pixels = _decoded(path, cv2.IMREAD_UNCHANGED)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    colours = pixels[..., :3]
    levels = colours.max(2)
    black = 1 / 2
    if pixels.shape[2] == 4 and np.ptp(pixels[..., 3]) > pixels[..., 3].max() / 2:
        levels = pixels[..., 3]
    elif levels.max() < 32 or np.ptp(colours, axis=2).max() > levels.max() / 16:
        black = 1 / 32  # also after JPEG
    bright = levels > black * levels.max()
    if is_cut(bright.shape[::-1], size):
        raise SceneError(
            f"mask {path} is of {bright.shape[1]}x{bright.shape[0]}, its photo of {size[0]}x{size[1]}, another shape, "
            "or a few percent off as before undistortion: make it from that photo, scale it to its size, or remove it"
        )
    return np.asarray(cv2.resize(bright.view(np.uint8), size, interpolation=cv2.INTER_NEAREST), bool)


def resized(image: Uint8s, kept: Bools | None, size: Size) -> tuple[Uint8s, Bools | None]:
    """A picture made ``size`` (width, height), and which of its pixels count: those all of whose sources do."""
    if image.shape[1::-1] == size:
        return image, kept
    if kept is not None:
        kept = cv2.resize(kept.view(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) == 255
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA), kept


class Picture(NamedTuple):
    """A photo as it is compared with.

    Attributes:
        image: ``[H, W, 3]`` uint8 RGB, black where it does not count.
        mask: Which pixels count ``[H, W]`` bool; None if all do.
    """

    image: Tensor
    mask: Tensor | None

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return sum(each.nbytes for each in self if each is not None)


class ImageSource(NamedTuple):
    """How the picture of one view is made from its file.

    Pixels count if the mask says so, if they are not transparent and if the camera saw them; each pixel of the picture
    only if all that it was mixed from count.

    Attributes:
        path: Image file.
        size: Its width and height in pixels, after it was turned.
        undistortion: Applied to the photo once it has its size; None for a pinhole camera.
        pinhole: Camera of the resulting picture, which is resized to its size.
        orientation: EXIF orientation to apply; 1 leaves the pixels as stored.
        mask: Image file that says which pixels count.
        has_alpha: Whether the file has transparent pixels.
        white: Whether transparent pixels are white, and count.
    """

    path: Path
    size: Size
    undistortion: Undistortion | None
    pinhole: Pinhole
    orientation: int = 1
    mask: Path | None = None
    has_alpha: bool = False
    white: bool = False

    @property
    def masked(self) -> bool:
        """Whether only some of its pixels count."""
        return self.mask is not None or (self.has_alpha and not self.white)

    @property
    def nbytes(self) -> int:
        """Bytes of the picture in memory."""
        return (3 + self.masked) * self.pinhole.width * self.pinhole.height

    def load(self) -> Picture:
        """The picture.

        Raises:
            SceneError: A file is damaged or has changed its size since the scene was loaded, or no pixel counts.
        """
        image, kept = self._decode()
        height, width = image.shape[:2]
        if (width, height) != self.size:
            raise _undecodable(self.path, f"decoded to {width}x{height}, its head says {self.size[0]}x{self.size[1]}")
        if self.mask:
            mask = read_mask(self.mask, self.size)
            kept = mask if kept is None else kept & mask
        if self.undistortion:
            image, kept = self.undistortion(*resized(image, kept, self.undistortion.size))
        image, kept = resized(image, kept, (self.pinhole.width, self.pinhole.height))
        with Image.open(self.path) as head:
            if turn := _to_srgb(head.info.get("icc_profile", b"")):
                image = np.array(ImageCms.applyTransform(Image.fromarray(image), turn))
        if kept is None or kept.all():
            return Picture(torch.from_numpy(image), None)
        if not kept.any():
            raise SceneError(
                f"no pixel of {self.path} counts by its {f'mask {self.mask}' if self.mask else 'transparency'}: masks "
                "are white and photos opaque where the photo counts; mend it, or remove the photo from the model"
            )
        return Picture(torch.from_numpy(image * kept[..., None]), torch.from_numpy(kept))

    def _decode(self) -> tuple[Uint8s, Bools | None]:
        """The file's pixels, turned, and which of them are not transparent."""
        undo = {6: 8, 8: 6}.get(self.orientation, self.orientation)  # the others undo themselves
        if not self.has_alpha:
            return _turned_back(read_image(self.path), undo), None
        pixels = _to_bytes(_decoded(self.path, cv2.IMREAD_UNCHANGED))
        if pixels.ndim != 3 or pixels.shape[2] != 4:
            raise _undecodable(self.path, "its transparency is not understood: save it as RGB or RGBA")
        pixels = _turned_back(pixels, undo)
        image = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGB)
        alpha = pixels[..., 3]
        if not self.white:
            return image, alpha >= 128  # half opaque
        share = alpha.astype(np.float32) / 255
        for channel in range(3):  # one by one: as numbers of 32 bits, they take several times the memory
            image[..., channel] = np.rint(image[..., channel] * share + 255 * (1 - share))
        return image, None


class Edges(NamedTuple):
    """Edges of a photo, a byte a pixel.

    Attributes:
        values: Strength ``[H, W]`` uint8, 0 where it is least.
        strongest: The largest of them, at least 1.
    """

    values: Tensor
    strongest: int

    def strength(self, device: torch.device | str = "cpu") -> Tensor:
        """Strength ``[H, W]`` float32 in [0, 1]: 1 for the strongest edge."""
        return to_device(self.values, device) / self.strongest


def edges_of(image: Tensor, mask: Tensor | None = None) -> Edges:
    """Edges of a photo; one without any is 0 everywhere.

    Args:
        image: ``[H, W, 3]`` uint8 RGB.
        mask: Which pixels count ``[H, W]`` bool; those beside one that does not have strength 0. None if all count.
    """
    values = torch.from_numpy(high_pass(image, mask, cv2.CV_8U))  # which also clips to 0..255
    values = values - values.min()
    return Edges(values, max(int(values.max()), 1))


def high_pass(image: Tensor, mask: Tensor | None, depth: int) -> Arrays:
    """Eight times the grey value of each pixel less those of its neighbours, 0 beside pixels that do not count.

    Args:
        image: ``[H, W, 3]`` uint8 RGB.
        mask: Which pixels count ``[H, W]`` bool; None if all do.
        depth: OpenCV's name of the type of the result.
    """
    grey = cv2.cvtColor(image.numpy(force=True), cv2.COLOR_RGB2GRAY)
    kernel = np.full((3, 3), -1, np.float32)
    kernel[1, 1] = 8
    passed: Arrays = cv2.filter2D(grey, depth, kernel)
    if mask is not None:
        passed *= cv2.erode(mask.numpy(force=True).view(np.uint8), None)  # by 3 x 3
    return passed


class ImageStore:
    """Pictures by index, decoded at first use and kept while the byte budget lasts.

    A kept picture stays: under a random order without replacement, an LRU cache smaller than the scene would evict what
    the next epoch needs first. Pictures beyond the budget are decoded anew each time; :meth:`prefetch` does that in the
    background, with one thread per picture, so that no thread pool has to survive a fork.

    Args:
        sources: One entry per view.
        cache_bytes: Budget for the kept pictures in bytes; 0 keeps none.
        held: Pictures that are there already and need no source.

    Raises:
        ValueError: ``cache_bytes`` is negative, or a mask is not bool.
    """

    def __init__(
        self, sources: Sequence[ImageSource], cache_bytes: int = 4 << 30, held: Sequence[Picture] = ()
    ) -> None:
        if cache_bytes < 0:
            raise ValueError(f"cache_bytes must be at least 0, got {cache_bytes}")
        for _, mask in held:
            if mask is not None and mask.dtype != torch.bool:
                raise ValueError(f"masks must be bool, got {mask.dtype}")
        self.sources = tuple(sources)
        self.nbytes = sum(source.nbytes for source in self.sources) + sum(picture.nbytes for picture in held)
        """Bytes of all pictures, decoded."""
        self._free = cache_bytes
        self._free_for_edges = cache_bytes - self.nbytes  # a picture takes longer to decode again
        self._kept = dict(enumerate(held))
        self._edges: dict[int, Edges] = {}
        self._coming: dict[int, Future[Picture]] = {}

    def __getitem__(self, index: int) -> Picture:
        """Picture ``index`` on the CPU; treat it as read-only.

        Raises:
            SceneError: The file cannot be decoded.
        """
        if index in self._kept:
            return self._kept[index]
        coming = self._coming.pop(index, None)
        picture = coming.result() if coming else self.sources[index].load()
        if picture.nbytes <= self._free:
            self._kept[index] = picture
            self._free -= picture.nbytes
        return picture

    def edges(self, index: int) -> Edges:
        """Edges of picture ``index``, kept while the budget has room beside all pictures.

        Raises:
            SceneError: The file cannot be decoded.
        """
        if index in self._edges:
            return self._edges[index]
        found = edges_of(*self[index])
        if found.values.nbytes <= self._free_for_edges:
            self._edges[index] = found
            self._free_for_edges -= found.values.nbytes
        return found

    def prefetch(self, index: int) -> None:
        """Start decoding picture ``index`` in the background; errors are raised when it is requested."""
        if index in self._kept or index in self._coming:
            return
        while len(self._coming) > 1:  # prefetched and never requested
            self._coming.pop(next(iter(self._coming)))
        thread = ThreadPoolExecutor(1, "nsvq-image")
        self._coming[index] = thread.submit(self.sources[index].load)
        thread.shutdown(wait=False)

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_coming": {}}


def write_pixels(path: Path, pixels: Uint8s) -> None:
    """Write pixels ``[H, W]`` or ``[H, W, 3]`` BGR as PNG, atomically, and make the folder."""
    make_folder_of(path)
    write_bytes(path, cv2.imencode(".png", pixels)[1].tobytes())
