"""Photos of a camera with distortion, as a pinhole camera would have taken them."""

from functools import partial
from typing import Any

import cv2
import numpy as np

from nsvq_lightning.data import PANORAMA
from nsvq_lightning.data.colmap import Pinhole, SceneError, import_pycolmap
from nsvq_lightning.splats.conventions import Bools, Float32s, Uint8s
from nsvq_lightning.top_level import log


def rectify(camera: Any, width: int, height: int, keep_maps: bool = True) -> "tuple[Pinhole, Undistortion | None]":
    """Pinhole camera of the undistorted images, and how to undistort them (None if there is nothing to do).

    Args:
        camera: ``pycolmap.Camera`` of any model, or a pinhole.
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
        return pinhole.scaled(width / camera.width, height / camera.height), None
    undistortion = Undistortion(camera, width, height, keep_maps)
    return undistortion.pinhole, undistortion


class Undistortion:
    """Mapping from the images of a distorted camera to those of a pinhole camera, cropped so that no pixel is blank.

    The pinhole camera is the one of COLMAP's ``image_undistorter`` with its default options. Distortion is evaluated in
    the model's pixels, so the image file may have another size than the model says, even another aspect ratio.

    Attributes:
        size: Width and height of the images that it takes, pixels.
        pinhole: Camera of the pictures that it makes.

    Args:
        camera: Distorted ``pycolmap.Camera``.
        width: Width of the image files in pixels.
        height: Height of the image files in pixels.
        keep_maps: Keep the maps, 9 bytes a pixel, for the next image of this camera.

    Raises:
        SceneError: The camera has no pinhole counterpart, for example a spherical one.
    """

    def __init__(self, camera: Any, width: int, height: int, keep_maps: bool) -> None:
        pycolmap = import_pycolmap()
        try:
            ideal = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        except (ValueError, RuntimeError) as error:
            remedy = PANORAMA if camera.model_name == "EQUIRECTANGULAR" else "undistort the images with COLMAP first"
            raise SceneError(
                f"camera {camera.camera_id}: {camera.model_name} cannot be turned into a pinhole ({error}): {remedy}"
            ) from error
        self._camera = camera
        self.size = (width, height)
        pinhole = Pinhole(ideal.calibration_matrix(), ideal.width, ideal.height)
        self.pinhole = pinhole.scaled(width / camera.width, height / camera.height)
        self._keep_maps = keep_maps
        self._maps: tuple[Float32s, Float32s, Bools] | None = None
        self._warned = False

    def scale_to(self, pinhole: Pinhole) -> None:
        """Have it make pictures of a smaller pinhole camera, of images that were made smaller by as much.

        Maps and pictures of large photos would take gigabytes, most of which is thrown away afterwards.
        """
        scale = pinhole.width / self.pinhole.width
        width, height = (max(1, round(scale * side)) for side in self.size)
        self.size = (width, height)
        self.pinhole, self._maps = pinhole, None

    def __call__(self, image: Uint8s, kept: Bools | None = None) -> tuple[Uint8s, Bools | None]:
        """Undistort an image ``[H, W, 3]`` of its size, and say which pixels of the result count.

        Args:
            image: The image; pixels that the camera never saw become black.
            kept: Which of its pixels count ``[H, W]``; None if all do.

        Returns:
            The pinhole image, and its pixels that the camera saw and whose sources count ``[H, W]``; None if all count.
        """
        columns, rows, blank = self.maps()
        # replicate the border, so that the cubic kernel does not mix black into the edge of the crop
        result = cv2.remap(image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        result[blank] = 0
        count = ~blank
        if kept is not None:
            whole = kept.view(np.uint8) * 255
            count &= cv2.remap(whole, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) == 255
        return result, None if count.all() else count

    def maps(self) -> tuple[Float32s, Float32s, Bools]:
        """Where each pixel of the pinhole image comes from.

        Returns:
            Source column and row ``[H, W]``, in OpenCV's pixels (centres at integers), and which pixels the camera
            never saw.
        """
        if self._maps:
            return self._maps
        pixels = self._source_pixels()
        # a pixel or more from the centres of the border, or NaN where the ray leaves the domain of the camera model
        blank = ~np.all((pixels > -1) & (pixels < self.size), axis=-1)
        pixels[blank] = np.nan
        columns, rows = np.moveaxis(pixels, 2, 0).copy()
        # Where the polynomial of a lens has turned back, it shows the picture once more: mirrored, then upside down.
        slope = partial(cv2.Sobel, ddepth=cv2.CV_32F, ksize=1, borderType=cv2.BORDER_REPLICATE)
        right, down = {"dx": 1, "dy": 0}, {"dx": 0, "dy": 1}
        turned = slope(columns, **right) * slope(rows, **down) < slope(columns, **down) * slope(rows, **right)
        if turned.any():
            regions = cv2.connectedComponents((~blank & ~turned).view(np.uint8))[1]
            middle = np.clip(self.pinhole.K[[1, 0], 2].astype(int), 0, np.subtract(blank.shape, 1))
            blank |= turned | (regions != regions[*middle])
        columns, rows = (np.nan_to_num(each, nan=-1.0) for each in (columns, rows))
        if blank.any() and not self._warned:
            self._warned = True
            log.warning(
                f"camera {self._camera.camera_id} ({self._camera.model_name}): {100 * blank.mean():.1f} % of the "
                "pinhole image is left out: its field of view is too wide for a pinhole, or for its lens polynomial"
            )
        if self._keep_maps:
            self._maps = columns, rows, blank
        return columns, rows, blank

    def _source_pixels(self) -> Float32s:
        """Where each pixel of the pinhole image comes from ``[H, W, 2]``."""
        K, width, height = self.pinhole.K, self.pinhole.width, self.pinhole.height
        scale = np.divide(self.size, (self._camera.width, self._camera.height))
        x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
        y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
        pixels = np.empty((height, width, 2), np.float32)
        at_once = 256  # rows: a whole image in float64 would take gigabytes
        for top in range(0, height, at_once):
            grid = np.meshgrid(x, y[top : top + at_once])
            rays = np.stack([*grid, np.ones_like(grid[0])], axis=-1).reshape(-1, 3)
            block = np.asarray(self._camera.img_from_cam(rays)) * scale - 0.5
            pixels[top : top + at_once] = block.reshape(-1, width, 2)
        return pixels
