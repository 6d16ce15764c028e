"""Anti-aliasing: splats smaller than a pixel get fainter instead of only larger (Mip-Splatting, Yu et al. 2024)."""

from __future__ import annotations

import torch
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.compute.rows import take_rows
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import BLUR, FAINTEST, FRUSTUM_MARGIN, HUGE_FOOTPRINT
from nsvq_lightning.rendering.reference import rotation_matrices
from nsvq_lightning.splats.splats import RawSplats, SplatTensors

__all__ = ["compensated"]

OPAQUE = 1 - 2.0**-20
"""Largest opacity: the rasterizer caps it lower, and its logit is finite."""


def compensated(splats: SplatTensors, camera: Camera, rows: Tensor) -> RawSplats:
    """The splats with the opacities that keep their light when the rasterizer blurs them by 0.3 square pixels.

    Each opacity is multiplied by √(det Σ / det(Σ + 0.3·I)) with Σ the projected covariance before the blur, the factor
    of Mip-Splatting's 2D filter: a splat that the blur makes twice as large becomes half as opaque. The factor is
    differentiable in means, quaternions and scales; it depends on the camera, so it is computed for each picture.

    Args:
        splats: Raw attributes of N splats.
        camera: Where to look from.
        rows: The splats that are in view ``[V]`` int64, ascending; the others stay.
    """
    opacity = (take_rows(splats.opacities, rows).sigmoid() * _light_kept(splats, camera, rows)).clamp_max(OPAQUE)
    logits = opacity.log() - (-opacity).log1p()
    seen = splats.opacities.index_copy(0, rows, logits)
    return RawSplats(splats.means, splats.quats, splats.scales, seen, splats.sh0, splats.shN)


def _light_kept(splats: SplatTensors, camera: Camera, rows: Tensor) -> Tensor:
    """The factors ``[V]``."""
    if kernels_for(splats.means) == "cpu":
        from nsvq_lightning.rendering.cpu.antialias import light_kept_cpu

        return light_kept_cpu(splats.means, splats.quats, splats.scales, camera, rows)
    means, quats, scales = (take_rows(getattr(splats, name), rows) for name in ("means", "quats", "scales"))
    viewmat = camera.viewmat.to(means)
    fx, fy, cx, cy = camera.intrinsics
    rotation = viewmat[:3, :3]
    # Elementwise: a GPU may round products of matrices to fewer digits.
    x, y, z = ((means[:, None, :] * rotation).sum(2) + viewmat[:3, 3]).unbind(1)
    margin_x, margin_y = (FRUSTUM_MARGIN * 0.5 * side / f for side, f in ((camera.width, fx), (camera.height, fy)))
    slope_x = (x / z).clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    slope_y = (y / z).clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    right, down, forward = rotation[0], rotation[1], rotation[2]
    across = (right - slope_x[:, None] * forward) * (fx / z)[:, None]
    along = (down - slope_y[:, None] * forward) * (fy / z)[:, None]
    axes = rotation_matrices(quats) * scales.exp()[:, None, :]
    u, v = (across[:, :, None] * axes).sum(1), (along[:, :, None] * axes).sum(1)
    # The blur does not matter to splats so large that squares of their area would overflow.
    counts = (u.square().sum(1) + v.square().sum(1)).detach() < HUGE_FOOTPRINT
    u, v = torch.where(counts[:, None], u, 0.0), torch.where(counts[:, None], v, 0.0)
    area = torch.linalg.cross(u, v).square().sum(1)  # det Σ by Lagrange's identity, which loses no digits
    blurred = BLUR * (u.square().sum(1) + v.square().sum(1)) + BLUR * BLUR
    factor = (area / (area + blurred)).clamp_min(FAINTEST * FAINTEST).sqrt()
    return torch.where(counts, factor, 1.0)
