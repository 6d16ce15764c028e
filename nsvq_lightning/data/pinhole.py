"""A camera without distortion, for which a scene needs no pycolmap."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from nsvq_lightning.splats.conventions import Float64s


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Intrinsics and size of a pinhole image, with the names of ``pycolmap.Camera``, whose place it takes.

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

    @classmethod
    def of(cls, params: tuple[float, ...], width: int, height: int, camera_id: int = 0) -> "Pinhole":
        """From COLMAP's parameters: one or two focal lengths, then the principal point."""
        *focal, cx, cy = params
        return cls(np.array([[focal[0], 0, cx], [0, focal[-1], cy], [0, 0, 1]], np.float64), width, height, camera_id)

    def calibration_matrix(self) -> Float64s:
        """``K``."""
        return self.K

    def resized(self, width: int, height: int) -> "Pinhole":
        """The camera of the image scaled to another size; with centres at .5 the whole of ``K`` scales linearly."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Pinhole(scale @ self.K, width, height)
