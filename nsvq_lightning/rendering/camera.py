"""A pinhole camera."""

import math
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, field
from numbers import Integral

import torch
from torch import Tensor

from nsvq_lightning.rendering.constants import FRUSTUM_MARGIN, NEAR

# Shortest focal length in sides of the picture, of a view of 178 degrees: a shorter one is not in pixels.
MIN_FOCAL = 0.01


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera in COLMAP's conventions: x right, y down, z forward; pixel centres at .5.

    Its numbers are taken when it is made: writing into its matrices has no effect, :func:`dataclasses.replace` has.

    Attributes:
        K: Intrinsics ``[3, 3]`` in pixels, principal point included; skew must be 0. Arrays and lists become tensors.
        viewmat: World to camera, rigid, ``[4, 4]``, scene units.
        width: Image width in pixels.
        height: Image height in pixels.
        near: Splats whose centre is nearer than this along the viewing axis are not seen, scene units; 0.2 by default,
            for scenes with an extent of about 5. In smaller units it must be less: ``Frame.around(positions).near``.
        limits: The :attr:`slope_limits` of another picture that are to hold in this one. One of another shape or focal
            length than those of training needs theirs: beyond, splats were never stretched so far, and would lie as
            streaks over what is in view.
        intrinsics: ``(fx, fy, cx, cy)`` in pixels.
        packed_view: Rotation row by row, translation and camera position: 15 numbers in float64, the same on every
            machine.

    Raises:
        ValueError: A matrix has another shape or kind, or requires a gradient; the image is empty, the focal lengths
            are not finite or below :data:`MIN_FOCAL`, or ``near`` is not positive and finite.
    """

    K: Tensor
    viewmat: Tensor
    width: int
    height: int
    near: float = NEAR
    limits: tuple[float, ...] = ()
    intrinsics: tuple[float, float, float, float] = field(init=False, repr=False)
    packed_view: tuple[float, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name, side in (("K", 3), ("viewmat", 4)):
            matrix = vars(self)[name] = torch.as_tensor(getattr(self, name)).clone()
            if matrix.requires_grad or matrix.shape != (side, side):  # rendering has no gradient by cameras
                raise ValueError(f"Camera.{name} must be detached, of shape [{side}, {side}], got {list(matrix.shape)}")
        if not all(isinstance(side, Integral) and side > 0 for side in self.size):
            raise ValueError(f"Camera needs whole numbers of pixels, at least one, got {self.width}x{self.height}")
        (fx, _, cx), (_, fy, cy), _ = K = self.K.tolist()
        # Kept as Python floats: reading them from an accelerator would stall it at every render.
        intrinsics = fx, fy, cx, cy
        turn = self.viewmat.to("cpu", torch.float64, copy=True)
        rotation, translation = turn[:3, :3], turn[:3, 3:]
        position = -(rotation * translation).sum(0)
        packed_view = tuple(torch.cat([rotation.ravel(), translation.ravel(), position]).tolist())
        vars(self).update(intrinsics=intrinsics, packed_view=packed_view)
        if not (all(map(math.isfinite, intrinsics)) and min(fx / self.width, fy / self.height) > MIN_FOCAL):
            raise ValueError(f"Camera.K needs positive, finite focal lengths and a centre, in pixels, got {intrinsics}")
        if not 0 < self.near < math.inf:
            raise ValueError(f"Camera.near must be positive and finite, got {self.near}")
        if [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] != K:
            raise ValueError(f"Camera.K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew, got {K}")
        turn[:3, 3] *= 0  # what is not finite stays so
        if not ((turn @ turn.T - torch.eye(4)).abs().max() < 0.01 and turn.det() > 0):
            shape = "a rotation and a translation, over 0 0 0 1: is it transposed, mirrored or scaled?"
            raise ValueError(f"Camera.viewmat must be world to camera, {shape}")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.width, self.height

    @property
    def slope_limits(self) -> tuple[float, ...]:
        """Lowest and highest x/z, then y/z, at which a Jacobian is evaluated: those given, or beyond the image."""
        fx, fy, cx, cy = self.intrinsics
        margin_x, margin_y = 0.5 * FRUSTUM_MARGIN * self.width / fx, 0.5 * FRUSTUM_MARGIN * self.height / fy
        return self.limits or (
            -cx / fx - margin_x, (self.width - cx) / fx + margin_x,
            -cy / fy - margin_y, (self.height - cy) / fy + margin_y,
        )  # fmt: skip

    @property
    def position(self) -> Tensor:
        """Camera centre ``[3]`` in world coordinates."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def smaller(self, times: int) -> "Camera":
        """The camera with pixels that are as large as squares of ``times`` pixels; what is left of one is cut off."""
        lens = tuple(number / times for number in self.intrinsics)
        return camera_of(self.viewmat, lens, self.width // times, self.height // times, self.near, self.limits)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None, **_: object) -> "Camera":
        """The camera with both matrices on ``device`` and in ``dtype``; the same object if they already are."""
        K, viewmat = (matrix.to(device=device, dtype=dtype) for matrix in (self.K, self.viewmat))
        if K is self.K and viewmat is self.viewmat:
            return self
        moved = copy(self)
        vars(moved).update(K=K, viewmat=viewmat)
        return moved


def camera_of(
    viewmat: Tensor, lens: Iterable[float], width: int, height: int, near: float = NEAR, limits: Iterable[float] = ()
) -> Camera:
    """A camera.

    Args:
        viewmat: World to camera ``[4, 4]``.
        lens: ``(fx, fy, cx, cy)`` in pixels.
        width: Pixels.
        height: Pixels.
        near: Distance of the near plane, scene units.
        limits: Slope limits of another picture, if they are to hold.
    """
    fx, fy, cx, cy = map(float, lens)
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(K, viewmat, width, height, near, tuple(map(float, limits)))
