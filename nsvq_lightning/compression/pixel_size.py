"""How large a pixel is where the splats are, and below which size a splat's extent is not visible."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR

__all__ = ["INVISIBLE", "pixel_sizes", "scale_floor"]

INVISIBLE = 0.25
"""Size in pixels below which the scale of a splat is not visible; the rasterizer blurs every splat by 0.55 pixels."""
CLOSE = 0.05
"""Share of the splats that may be seen from closer than the floor assumes."""
SAMPLE = 1 << 16
"""Largest number of splats in the sample."""
BATCH = 1 << 17
"""Pairs of a splat and a view that are looked at together; they fit into a processor's cache."""


@torch.no_grad()
def pixel_sizes(means: Tensor, cameras: Iterable[Camera]) -> Tensor:
    """Size ``[N]`` of a pixel at each splat in the view that sees it closest, scene units; infinite where none does.

    Args:
        means: Centres ``[N, 3]``, world coordinates.
        cameras: The views.
    """
    views = list(cameras)
    sizes = torch.full_like(means[:, 0], math.inf)
    if not views:
        return sizes
    intrinsics = torch.tensor([camera.intrinsics for camera in views], dtype=torch.float64)
    extents = torch.tensor([(camera.width, camera.height) for camera in views], dtype=torch.float64)
    fx, fy, cx, cy = intrinsics.T[:, :, None]
    x, y, z = torch.stack([camera.viewmat.detach().to("cpu", torch.float64) for camera in views])[:, :3].unbind(1)
    # Rows ``[views, 4]`` that give, of a position, its column · depth, row · depth and depth.
    lines = [line.to(means).unsqueeze(-1).unbind(1) for line in (fx * x + cx * z, fy * y + cy * z, z)]
    width, height, focal = torch.cat([extents, intrinsics[:, :2].amax(1, keepdim=True)], 1).to(means).T[:, :, None]
    step = max(1, BATCH // len(views))
    for rows in (slice(start, start + step) for start in range(0, len(means), step)):
        batch = means[rows].unbind(1)
        u, v, depth = (_affine(line, batch) for line in lines)
        inside = torch.minimum(u, v).minimum(width * depth - u).minimum(height * depth - v) >= 0
        sizes[rows] = torch.where(inside & (depth > NEAR), depth / focal, math.inf).amin(0)
    return sizes


def _affine(line: Sequence[Tensor], position: Sequence[Tensor]) -> Tensor:
    """Elementwise, as a GPU may round matrix products to fewer digits (TF32)."""
    (a, b, c, d), (x, y, z) = line, position
    return torch.addcmul(d, a, x).addcmul_(b, y).addcmul_(c, z)


def scale_floor(means: Tensor, cameras: Iterable[Camera], pixels: float = INVISIBLE) -> float | None:
    """Log-scale of ``pixels`` pixels for splats that are seen close: 95 % of them are seen from farther away.

    Differences below it are not visible, but the logarithm varies widely there, which wastes codes. On 187 k splats, a
    floor of 0.25 pixels raised one scale in eight, and test PSNR fell by 0.003 dB; with 4k codes for the scales, PSNR
    right after k-means rose from 31.64 to 31.95 dB.

    Args:
        means: Centres ``[N, 3]``, world coordinates.
        cameras: The views.
        pixels: Size in pixels, above 0.

    Returns:
        The floor, or None where no view sees a splat.
    """
    sizes = pixel_sizes(means[:: 1 + len(means) // SAMPLE], cameras)
    sizes = sizes[sizes.isfinite()]
    return math.log(pixels * float(sizes.quantile(CLOSE))) if len(sizes) else None
