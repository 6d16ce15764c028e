"""Turns any of COLMAP's camera models into a pinhole camera and its images into pinhole images."""

import logging
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.data.colmap import SceneError, import_pycolmap

log = logging.getLogger(__name__)


class Maps(NamedTuple):
    """Source column and row of each pixel, ``[H, W]``, in OpenCV's pixels (centres at integers).

    ``blank [H, W]`` marks the pixels that the camera never saw; None if it saw all.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    blank: NDArray[np.bool_] | None


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Intrinsics and size of a pinhole image.

    Attributes:
        K: ``[3, 3]`` float64, pixels, centres at .5.
        width: Pixels.
        height: Pixels.
    """

    K: NDArray[np.float64]
    width: int
    height: int

    def resized(self, width: int, height: int) -> "Pinhole":
        """The camera of the image scaled to another size; with centres at .5 the whole of ``K`` scales linearly."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Pinhole(scale @ self.K, width, height)


class Undistortion:
    """Mapping from the images of a distorted camera to those of a pinhole camera, cropped so that no pixel is blank.

    The pinhole camera is the one of COLMAP's ``image_undistorter`` with its default options. Distortion is evaluated in
    the model's pixels, so the image file may have another size than the model says, even another aspect ratio.

    Args:
        camera: Distorted ``pycolmap.Camera``.
        width: Width of the image files in pixels.
        height: Height of the image files in pixels.
        keep_maps: Keep the map, 8 bytes per pixel, for the next image of this camera.

    Raises:
        SceneError: The camera has no pinhole counterpart, for example a spherical one.
    """

    def __init__(self, camera: Any, width: int, height: int, keep_maps: bool = True) -> None:
        pycolmap = import_pycolmap()
        try:
            ideal = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        except (ValueError, RuntimeError) as error:
            raise SceneError(
                f"camera {camera.camera_id} with model {camera.model_name} cannot be turned into a pinhole camera "
                f"({error}): undistort the images with COLMAP first"
            ) from error
        self._camera = camera
        self._scale = (width / camera.width, height / camera.height)
        self.pinhole = Pinhole(ideal.calibration_matrix(), ideal.width, ideal.height).resized(
            max(1, round(ideal.width * self._scale[0])), max(1, round(ideal.height * self._scale[1]))
        )
        self._size = (width, height)
        self._keep_maps = keep_maps
        self._maps: Maps | None = None
        self._warned = False

    def __call__(
        self, image: NDArray[np.uint8], kept: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """Undistort an image ``[H, W, 3]`` of the file's size, and say which pixels of the result count.

        Args:
            image: The image; pixels that the camera never saw become black.
            kept: Which of its pixels count ``[H, W]``; None if all do.

        Returns:
            The pinhole image, and its pixels that the camera saw and whose sources count ``[H, W]``; None if all count.
        """
        maps = self.maps()
        # replicate the border, so that the cubic kernel does not mix black into the edge of the crop
        result: NDArray[np.uint8] = cv2.remap(image, maps.x, maps.y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        count = None
        if kept is not None:
            whole = kept.astype(np.uint8) * np.uint8(255)
            count = cv2.remap(whole, maps.x, maps.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) == 255
        if maps.blank is not None:
            result[maps.blank] = 0
            count = ~maps.blank if count is None else count & ~maps.blank
        return result, count

    def maps(self) -> Maps:
        """Where each pixel of the pinhole image comes from."""
        if self._maps is not None:
            return self._maps
        pixels = self._source_pixels()
        # more than a pixel outside, or NaN where the ray leaves the domain of the camera model
        blank: NDArray[np.bool_] = np.any((pixels <= -1) | (pixels >= self._size) | np.isnan(pixels), axis=-1)
        columns, rows = (np.nan_to_num(pixels[..., i], nan=-1.0) for i in (0, 1))
        maps = Maps(columns, rows, blank if blank.any() else None)
        if maps.blank is not None and not self._warned:
            self._warned = True
            log.warning(
                "camera %s (%s): %.1f %% of the pinhole image is left out: its field of view is too wide for a pinhole",
                self._camera.camera_id,
                self._camera.model_name,
                100 * blank.mean(),
            )
        if self._keep_maps:
            self._maps = maps
        return maps

    def _source_pixels(self) -> NDArray[np.float32]:
        """Where each pixel of the pinhole image comes from ``[H, W, 2]``."""
        K, width, height = self.pinhole.K, self.pinhole.width, self.pinhole.height
        x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
        y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
        pixels = np.empty((height, width, 2), np.float32)
        at_once = 256  # rows: a whole image in float64 would take gigabytes
        for top in range(0, height, at_once):
            grid = np.meshgrid(x, y[top : top + at_once])
            rays = np.stack([*grid, np.ones_like(grid[0])], axis=-1).reshape(-1, 3)
            block = np.asarray(self._camera.img_from_cam(rays)) * self._scale - 0.5
            pixels[top : top + at_once] = block.reshape(-1, width, 2)
        return pixels


def rectify(camera: Any, width: int, height: int, keep_maps: bool = True) -> tuple[Pinhole, Undistortion | None]:
    """Pinhole camera of the undistorted images, and how to undistort them (None if there is nothing to do).

    Args:
        camera: ``pycolmap.Camera`` of any model.
        width: Width of the image files in pixels; may differ from the model's.
        height: Height of the image files in pixels.
        keep_maps: See :class:`Undistortion`.

    Raises:
        SceneError: The camera cannot be turned into a pinhole camera.
    """
    # An all-zero polynomial is a pinhole too, but COLMAP's undistorter would crop its picture by a pixel.
    # Fisheye models without distortion are none.
    polynomial = camera.model_name in ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
    if (polynomial and camera.is_undistorted()) or camera.model_name in ("SIMPLE_PINHOLE", "PINHOLE"):
        pinhole = Pinhole(camera.calibration_matrix(), camera.width, camera.height)
        return pinhole.resized(width, height), None
    undistortion = Undistortion(camera, width, height, keep_maps)
    return undistortion.pinhole, undistortion
