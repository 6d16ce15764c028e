"""One representative of the 48 pairs of scale and rotation that describe the same splat.

The covariance R·diag(s²)·Rᵀ does not change when the three axes change their order or direction (24 rotations of the
cube), nor when the quaternion changes its sign or length. Vectors that mean the same but lie apart waste codes of a
codebook; a canonical representative brings them together.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.splats.conventions import MIN_SQUARED_NORM


def _right_products(quats: Tensor) -> Tensor:
    """Matrices ``[M, 4, 4]`` with ``matrix @ q`` the product ``q ⊗ r`` for each quaternion r of ``quats [M, 4]``."""
    w, x, y, z = quats.unbind(1)
    rows = [[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


_H = math.sqrt(0.5)
# For each order of the axes, a rotation whose columns are, up to sign, the unit vectors in that order.
_AXIS_TURNS = torch.tensor(
    [
        [1.0, 0.0, 0.0, 0.0],  # axes 0 1 2
        [_H, _H, 0.0, 0.0],  # 0 2 1
        [_H, 0.0, 0.0, _H],  # 1 0 2
        [0.5, 0.5, 0.5, 0.5],  # 1 2 0
        [0.5, -0.5, -0.5, -0.5],  # 2 0 1
        [_H, 0.0, _H, 0.0],  # 2 1 0
    ],
    dtype=torch.float64,
)


# ``[6, 4, 4, 4]``: for each order of the axes and each of four half turns, the product from the right as a matrix.
_TURNS = _right_products(torch.eye(4, dtype=torch.float64)) @ _right_products(_AXIS_TURNS)[:, None]


class Canonical(NamedTuple):
    """Scales and rotations in a canonical form, and the maps that carry gradients over to it.

    Attributes:
        scales: Log-scales ``[N, 3]``.
        quats: Quaternions ``[N, 4]``, wxyz, of length 1.
        scale_maps: ``[N, 3, 3]``; maps a gradient with respect to the old log-scales to one with respect to the new.
        quat_maps: ``[N, 4, 4]``, the same for the quaternions.
    """

    scales: Tensor
    quats: Tensor
    scale_maps: Tensor
    quat_maps: Tensor


def canonical(scales: Tensor, quats: Tensor) -> Canonical:
    """Scales and rotations of the same covariances in a canonical form.

    The axes are sorted, longest first; of the remaining rotations it is the smallest one, with the largest w; and the
    quaternion has length 1. One too short to have a direction is the identity, as for the renderer; NaN and infinity
    are kept.

    Args:
        scales: Log-scales ``[N, 3]``.
        quats: Quaternions ``[N, 4]``, wxyz, any length.
    """
    squared = quats.square().sum(1, keepdim=True)
    directed = ~(squared < MIN_SQUARED_NORM)
    quats = torch.where(directed, quats, torch.eye(4, dtype=quats.dtype, device=quats.device)[0])
    lengths = torch.where(directed, squared, 1.0).sqrt()
    order = scales.argsort(dim=1, descending=True, stable=True)
    turns = _turns_to(order, quats)
    turned = _apply(turns, quats)
    signs = torch.where(turned[:, :1] < 0, -1.0, 1.0).to(quats)
    axes = torch.eye(3, dtype=scales.dtype, device=scales.device)
    return Canonical(
        scales.gather(1, order),
        signs * turned / lengths,
        axes[order],
        (signs * lengths)[:, :, None] * turns,
    )


def _turns_to(order: Tensor, quats: Tensor) -> Tensor:
    """Orthogonal matrices ``[N, 4, 4]`` that turn quaternions to axes in ``order [N, 3]`` by the smallest angle.

    The order fixes a rotation up to half turns around the axes; of these four, it takes the one with the largest w.
    """
    number = 2 * order[:, 0] + (order[:, 1] > order[:, 2])
    turns = _TURNS.to(quats)
    w = _apply(turns[:, :, 0][number], quats)
    return turns[number, w.abs().argmax(1)]


def _apply(matrices: Tensor, rows: Tensor) -> Tensor:
    return (matrices * rows[:, None, :]).sum(2)
