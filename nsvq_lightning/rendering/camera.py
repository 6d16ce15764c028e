"""A pinhole camera, and what several have in common: where up is, and the point that they look at."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from nsvq_lightning.rendering.constants import FRUSTUM_MARGIN


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera in COLMAP's conventions: x right, y down, z forward; pixel centres at .5.

    Attributes:
        K: Intrinsics ``[3, 3]`` in pixels, principal point included; skew must be 0.
        viewmat: World to camera, rigid, ``[4, 4]``, scene units.
        width: Image width in pixels.
        height: Image height in pixels.

    Raises:
        ValueError: A matrix has another shape, the image is empty, the focal lengths are not positive and finite, or
            there is skew.
    """

    K: Tensor
    viewmat: Tensor
    width: int
    height: int
    _intrinsics: tuple[float, float, float, float] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        for name, matrix, side in (("K", self.K, 3), ("viewmat", self.viewmat, 4)):
            if tuple(matrix.shape) != (side, side):
                raise ValueError(f"Camera.{name} must have shape [{side}, {side}], got {list(matrix.shape)}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"Camera needs at least one pixel, got {self.width}x{self.height}")
        if self._intrinsics is not None:
            return
        fx, fy = float(self.K[0, 0]), float(self.K[1, 1])
        # Kept as Python floats: reading them from an accelerator would stall it at every render.
        object.__setattr__(self, "_intrinsics", (fx, fy, float(self.K[0, 2]), float(self.K[1, 2])))
        if not (0 < fx < math.inf and 0 < fy < math.inf):
            raise ValueError(f"Camera.K needs positive, finite focal lengths, got fx={fx}, fy={fy}")
        if self.K[0, 1] != 0:
            raise ValueError(f"Camera.K must be without skew, got {float(self.K[0, 1])}: no back-end renders it")

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """``(fx, fy, cx, cy)`` in pixels."""
        assert self._intrinsics is not None  # set by __post_init__
        return self._intrinsics

    @property
    def slope_limits(self) -> tuple[float, float, float, float]:
        """Lowest and highest x/z, then y/z, at which a Jacobian is evaluated: a margin beyond the image."""
        fx, fy, cx, cy = self.intrinsics
        margin_x, margin_y = 0.5 * FRUSTUM_MARGIN * self.width / fx, 0.5 * FRUSTUM_MARGIN * self.height / fy
        return (
            -cx / fx - margin_x, (self.width - cx) / fx + margin_x,
            -cy / fy - margin_y, (self.height - cy) / fy + margin_y,
        )  # fmt: skip

    @property
    def packed_view(self) -> list[float]:
        """Rotation row by row, translation and camera position: 15 numbers in float64, the same on every machine."""
        *rows, _ = self.viewmat.detach().to("cpu", torch.float64).tolist()
        rotation, translation = [row[:3] for row in rows], [row[3] for row in rows]
        position = [-sum(row[k] * t for row, t in zip(rotation, translation, strict=True)) for k in range(3)]
        return [*(x for row in rotation for x in row), *translation, *position]

    @property
    def position(self) -> Tensor:
        """Camera centre ``[3]`` in world coordinates."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None, **kwargs: object
    ) -> "Camera":
        """The camera with both matrices on ``device`` and in ``dtype``; the same object if they already are."""
        K, viewmat = (matrix.to(device=device, dtype=dtype) for matrix in (self.K, self.viewmat))
        if K is self.K and viewmat is self.viewmat:
            return self
        return Camera(K, viewmat, self.width, self.height, self._intrinsics)


# Weight of what decides where cameras that all look the same way leave a direction open.
LITTLE = 1e-5


def poses(cameras: Sequence[Camera]) -> tuple[NDArray[np.float64], Rotation]:
    """Positions ``[N, 3]``, and rotations from camera to world."""
    packed = np.array([camera.packed_view for camera in cameras])
    return packed[:, 12:], Rotation.from_matrix(packed[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1))


def looked_at(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """The point ``[3]`` nearest to all lines of sight; where they are parallel, one in front of the cameras."""
    positions, rotations = poses(cameras)
    forward = rotations.as_matrix()[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    spread = np.linalg.norm(positions - positions.mean(0), axis=1).max() or 1.0
    ahead = positions.mean(0) + 2 * spread * forward.mean(0)
    weight = LITTLE * len(positions)
    total = across.sum(0) + weight * np.eye(3)
    return np.linalg.solve(total, np.einsum("nij,nj->i", across, positions) + weight * ahead)


def up_of(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """The direction ``[3]`` that is up for cameras most of which are held level, unit length.

    It is at right angles to where their right is, the sum of the sines of their rolls being least, so that a minority
    of photos in portrait format or askew does not count; where that leaves a choice, it is near their upper edges.
    Looking up or down does not matter.
    """
    axes = poses(cameras)[1].as_matrix()
    right, upper = axes[:, :, 0], -axes[:, :, 1].mean(0)
    if np.linalg.norm(upper) < 0.1:  # they are turned in all directions
        return np.asarray(-axes[0, :, 1])
    weights = np.ones(len(axes))
    for _ in range(20):  # weighted again by how level they are
        level = (weights * right.T) @ right / weights.sum()
        up = np.linalg.solve(level + LITTLE * np.eye(3), upper)
        up /= np.linalg.norm(up)
        weights = 1 / np.maximum(np.abs(right @ up), 0.02)  # sine of the roll below which a camera counts as level
    return up
