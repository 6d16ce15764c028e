"""gsplat's CUDA kernels behind the interface of the package's own back-ends.

The kernels are called one by one (projection, spherical harmonics, tiles, blend) rather than through
``gsplat.rasterization``: the projected centres that :func:`nsvq_lightning.render` returns must lie between projection
and blend in the graph, so that they receive the gradient of the image, in pixels, as density control needs it.

The same: activations (log-scales, opacity logits, quaternions of any norm, wxyz), axes and pixel centres, the
near plane, the blur of the projected covariance, the margin outside which its Jacobian is clamped, the threshold of
1/255, the order by view-space z, spherical harmonics with the floor at 0, the background. There is no far plane, no
minimum radius and no anti-aliasing. Different, because gsplat has no argument for it:

* Opacity of one splat at one pixel is capped at 0.999, not at 0.99: only splats more opaque than 0.99 look different.
* The box of a splat is rounded up to whole pixels, so ``radii`` and :func:`visible_gsplat` count a few splats that
  reach no pixel centre; they change no pixel.
* A splat with a zero quaternion is not drawn; this package takes it as the identity. Quaternions whose squares
  overflow, and splats of thousands of pixels, lose the precision that the package's own kernels keep.
* The gradients of a splat with a non-finite attribute may be NaN; those of the others are not affected.
* Gradients are summed in the order in which threads arrive: two runs with one seed differ in their last bits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import gsplat
import torch
from torch import Tensor

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import BLUR, NEAR
from nsvq_lightning.splats.splats import SplatTensors

__all__ = ["render_gsplat", "visible_gsplat"]

TILE = 16
"""Side of the tiles in pixels; the only one that gsplat tests."""


class _Projected(NamedTuple):
    """Splats on the image plane, each with gsplat's leading dimension of cameras.

    Attributes:
        radii: Half sizes of their boxes in pixels, 0 for those not in view ``[1, N, 2]`` int32.
        means2d: Projected centres, 0 for those not in view ``[1, N, 2]`` pixels.
        depths: View-space z ``[1, N]``, undefined for those not in view.
        conics: Inverse covariances with the blur ``[1, N, 3]``, undefined for those not in view.
    """

    radii: Tensor
    means2d: Tensor
    depths: Tensor
    conics: Tensor


def _project(splats: SplatTensors, camera: Camera, opacities: Tensor) -> _Projected:
    """Project with gsplat; ``opacities`` ``[N]`` are between 0 and 1, not logits."""
    at = camera.to(splats.means.device, splats.means.dtype)
    radii, means2d, depths, conics, _ = gsplat.fully_fused_projection(
        splats.means, None, splats.quats, splats.scales.exp(), at.viewmat[None], at.K[None], camera.width,
        camera.height, eps2d=BLUR, near_plane=NEAR, far_plane=math.inf, radius_clip=0.0, packed=False,
        opacities=opacities.detach(),
    )  # fmt: skip
    # gsplat leaves the rows that it culls unwritten, and would draw a splat at NaN into the first tile.
    seen = (radii > 0).all(-1) & torch.isfinite(means2d).all(-1) & torch.isfinite(conics).all(-1)
    zero = means2d.new_zeros(())
    return _Projected(radii * seen[..., None], torch.where(seen[..., None], means2d, zero), depths, conics)


def _colors(splats: SplatTensors, camera: Camera, degree: int, seen: Tensor) -> Tensor:
    """Colours ``[1, N, 3]`` of the splats that are ``seen [1, N]``; undefined for the others."""
    direction = splats.means - camera.to(splats.means.device, splats.means.dtype).position
    coefficients = torch.cat([splats.sh0, splats.shN[:, : (degree + 1) ** 2 - 1]], 1)
    colors: Tensor = gsplat.spherical_harmonics(degree, direction[None], coefficients[None], masks=seen)
    return (colors + 0.5).clamp_min(0)


def render_gsplat(
    splats: SplatTensors, camera: Camera, sh_degree: int, background: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Image ``[H, W, 3]``, alpha ``[H, W]``, radii ``[N]``, means2d ``[N, 2]`` and depth ``[H, W]``.

    See :func:`nsvq_lightning.render` for the meaning of arguments and results.
    """
    opacities = splats.opacities.sigmoid()
    projected = _project(splats, camera, opacities)
    radii, means2d = projected.radii.amax(-1)[0], projected.means2d[0]
    colors = _colors(splats, camera, sh_degree, (projected.radii > 0).all(-1))
    features = torch.cat([colors, projected.depths[..., None]], -1)
    columns, rows = (math.ceil(side / TILE) for side in (camera.width, camera.height))
    _, keys, order = gsplat.isect_tiles(means2d[None], projected.radii, projected.depths, TILE, columns, rows)
    offsets = gsplat.isect_offset_encode(keys, 1, columns, rows)
    behind = torch.cat([background, background.new_zeros(1)])  # no depth
    blended, alpha = gsplat.rasterize_to_pixels(
        means2d[None], projected.conics, features, opacities[None], camera.width, camera.height, TILE, offsets, order,
        backgrounds=behind[None],
    )  # fmt: skip
    return blended[0, ..., :3], alpha[0, ..., 0], radii, means2d, blended[0, ..., 3]


def visible_gsplat(splats: SplatTensors, camera: Camera) -> Tensor:
    """Rows ``[V]`` int64, ascending, of the splats whose box touches the image."""
    radii = _project(splats, camera, splats.opacities.sigmoid()).radii
    return radii[0].amax(-1).nonzero()[:, 0]
