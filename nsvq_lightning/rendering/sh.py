"""Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting."""

import math

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.splats.conventions import SH_C0, sh_coefficients

C0 = SH_C0
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Values ``[N, (degree + 1)²]`` of the basis at unit ``directions [N, 3]``."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree > 0:
        basis += [-C1 * y, C1 * z, -C1 * x]
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
    return torch.stack(basis, -1)


def sh_colors(directions: Tensor, sh0: Tensor, shN: Tensor, degree: int) -> Tensor:
    """Colours ``[N, 3]`` seen along unit ``directions [N, 3]``: 0.5 + Σ coefficient · basis, not below 0.

    Args:
        directions: From the camera to the splat, unit length ``[N, 3]``.
        sh0: Constant coefficients ``[N, 1, 3]``.
        shN: Higher coefficients ``[N, ≥ (degree + 1)² - 1, 3]``; those above ``degree`` are ignored.
        degree: Highest degree used.
    """
    coefficients = torch.cat([sh0, shN[:, : sh_coefficients(degree)]], 1)
    return ((sh_basis(directions, degree)[..., None] * coefficients).sum(1) + 0.5).clamp_min(0)


def sh_rotation(rotation: Tensor, degree: int) -> Tensor:
    """The matrix ``[(degree + 1)² - 1]²`` that turns higher coefficients: ``matrix @ shN`` are those of turned splats.

    Colours seen along ``rotation @ direction`` are then those that were seen along ``direction``. The basis is
    orthonormal, so an element is the integral over the sphere of a basis function at turned directions times one at
    the directions, and 4 · 8 directions of a Gauss-Legendre rule give it exactly. A band turns into itself.

    Args:
        rotation: From old to new world axes ``[3, 3]``, float64 for an exact result.
        degree: Of the spherical harmonics, 0 to 3.
    """
    heights, shares = (torch.from_numpy(each).to(rotation) for each in np.polynomial.legendre.leggauss(4))
    height, turn = torch.cartesian_prod(heights, torch.arange(8).to(rotation) * (math.pi / 4)).unbind(1)
    across = (1 - height * height).sqrt()
    directions = torch.stack([across * turn.cos(), across * turn.sin(), height], 1)
    weights = shares.repeat_interleave(8) * (math.pi / 4)
    before, after = sh_basis(directions, degree)[:, 1:], sh_basis(directions @ rotation.T, degree)[:, 1:]
    turned = ((weights[:, None] * after)[:, :, None] * before[:, None, :]).sum(0)
    band = torch.arange(1, (degree + 1) ** 2).sqrt().floor().to(turned)
    return torch.where(band[:, None] == band, turned, 0.0)
