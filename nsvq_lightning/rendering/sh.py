"""Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from nsvq_lightning.splats.conventions import SH_C0, Float64s, sh_coefficients

if TYPE_CHECKING:
    from torch import Tensor

C0 = SH_C0
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def _bands(directions: Any, degree: int) -> list[Any]:
    """Values of the basis from degree 1 on at unit directions: x, y and z as arrays or tensors of any shape."""
    x, y, z = directions
    basis = [-C1 * y, C1 * z, -C1 * x] if degree else []
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        basis += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z, C2[2] * (xx - yy)]
    if degree > 2:
        basis += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    return basis


def sh_basis(directions: "Tensor", degree: int) -> "Tensor":
    """Values ``[N, (degree + 1)²]`` of the basis at unit ``directions [N, 3]``."""
    import torch  # files that are turned need none

    return torch.stack([torch.full_like(directions[..., 0], C0), *_bands(directions.unbind(-1), degree)], -1)


def sh_colors(directions: "Tensor", sh0: "Tensor", shN: "Tensor", degree: int) -> "Tensor":
    """Colours ``[N, 3]`` seen along unit ``directions [N, 3]``: 0.5 + Σ coefficient · basis, not below 0.

    Args:
        directions: From the camera to the splat, unit length ``[N, 3]``.
        sh0: Constant coefficients ``[N, 1, 3]``.
        shN: Higher coefficients ``[N, ≥ (degree + 1)² - 1, 3]``; those above ``degree`` are ignored.
        degree: Highest degree used.
    """
    import torch

    coefficients = torch.cat([sh0, shN[:, : sh_coefficients(degree)]], 1)
    return ((sh_basis(directions, degree)[..., None] * coefficients).sum(1) + 0.5).clamp_min(0)


def sh_rotation(rotation: Float64s, degree: int) -> Float64s:
    """The matrix ``[(degree + 1)² - 1]²`` that turns higher coefficients: ``matrix @ shN`` are those of turned splats.

    Colours seen along ``rotation @ direction`` are then those that were seen along ``direction``. The basis is
    orthonormal, so an element is the integral over the sphere of a basis function at turned directions times one at
    the directions, and 4 · 8 directions of a Gauss-Legendre rule give it exactly. A band turns into itself.

    Args:
        rotation: From old to new world axes ``[3, 3]``.
        degree: Of the spherical harmonics, 0 to 3.
    """
    heights, shares = np.polynomial.legendre.leggauss(4)
    height, turn = heights.repeat(8), np.tile(np.arange(8) * (math.pi / 4), 4)
    across = np.sqrt(1 - height * height)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), height])
    before, after = (np.reshape(_bands(each, degree), (-1, 32)) for each in (directions, rotation @ directions))
    # Half a turn is exact, and between bands is nothing.
    return (shares.repeat(8) * (math.pi / 4) * after[:, None] * before).sum(2).round(14)  # type: ignore[no-any-return]
