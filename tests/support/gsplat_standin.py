"""Stands in for gsplat where there is no GPU: the functions that the back-end calls, after gsplat's documentation.

Projection and harmonics are the package's oracle, which agrees with the torch code that gsplat 1.5.3 ships (means,
conics, harmonics and their gradients to 1e-15 in float64). Like gsplat's kernels it leaves unwritten what it culls
(NaN here), keeps splats whose box touches the image, and caps α at 0.999. Tiles and blend are plain loops.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from nsvq_lightning.rendering import constants, reference
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.sh import sh_basis
from nsvq_lightning.splats.splats import RawSplats

ALPHA_MAX = 0.999
UNWRITTEN = float("nan")


def fully_fused_projection(
    means: Tensor,
    covars: None,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    opacities: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
    """``radii [1, N, 2]``, ``means2d [1, N, 2]``, ``depths [1, N]``, ``conics [1, N, 3]`` for one camera."""
    assert covars is None
    assert not packed
    assert eps2d == constants.BLUR, "the oracle knows one blur only"
    assert opacities is not None
    assert not opacities.requires_grad
    splats = RawSplats(means, quats, scales.log(), opacities.logit(), means[:, None], means[:, None][:, :0])
    seen = reference.project(splats, Camera(Ks[0], viewmats[0], width, height))
    half, size = seen.half_sizes.ceil(), torch.tensor([width, height]).to(means)
    keep = (seen.depths >= near_plane) & (seen.depths <= far_plane) & (half > radius_clip).any(-1)
    keep &= ((seen.means2d + half > 0) & (seen.means2d - half < size)).all(-1)
    # A splat at NaN passes every such test of gsplat's.
    keep |= torch.isnan(seen.means2d).any(-1)
    radii = torch.where(keep[:, None], half.nan_to_num(1.0).clamp_max(1e6), 0).to(torch.int32)
    written = (torch.where(keep.view(-1, *[1] * (t.dim() - 1)), t, UNWRITTEN) for t in seen[:3])
    means2d, conics, depths = written
    return radii[None], means2d[None], depths[None], conics[None], None


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Colours ``[1, N, 3]`` without the ½; directions ``[1, N, 3]`` of any length."""
    basis = sh_basis((dirs / dirs.norm(dim=-1, keepdim=True))[0], degrees_to_use)[None, ..., None]
    colors = (basis * coeffs[:, :, : basis.shape[2]]).sum(2)
    return colors if masks is None else torch.where(masks[..., None], colors, UNWRITTEN)


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Counts by splat ``[1, N]``, then tile (as key) and splat of every intersection, sorted by tile and depth."""
    means2d, depths = means2d.detach(), depths.detach()
    found, counts = [], torch.zeros(radii.shape[:-1], dtype=torch.int32)
    for row in (radii[0] > 0).all(-1).nonzero()[:, 0].tolist():
        low = ((means2d[0, row] - radii[0, row]) / tile_size).floor().clamp_min(0).int().tolist()
        high = ((means2d[0, row] + radii[0, row]) / tile_size).ceil().int().tolist()
        tiles = [
            tile_width * y + x
            for y in range(low[1], min(high[1], tile_height))
            for x in range(low[0], min(high[0], tile_width))
        ]
        counts[0, row] = len(tiles)
        found += [(tile, float(depths[0, row]), row) for tile in tiles]
    found.sort()
    keys, rows = (torch.tensor([entry[k] for entry in found], dtype=torch.int64) for k in (0, 2))
    return counts, keys, rows.int()


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Where the list of each tile begins ``[1, tile_height, tile_width]``."""
    assert n_images == 1
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids, tiles).int().view(1, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Blended channels ``[1, H, W, D]`` over the background and alpha ``[1, H, W, 1]``."""
    columns = isect_offsets.shape[-1]
    assert columns == math.ceil(image_width / tile_size)
    # Part of the graph even where nothing is drawn, as the output of gsplat's own function is.
    blended = colors.new_zeros(image_height, image_width, colors.shape[-1]) + 0 * means2d.sum()
    left_over = colors.new_ones(image_height, image_width)
    ends = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    for tile, (begin, end) in enumerate(pairwise(ends)):
        top, left = tile_size * (tile // columns), tile_size * (tile % columns)
        ys = torch.arange(top, min(top + tile_size, image_height))[:, None]
        xs = torch.arange(left, min(left + tile_size, image_width))[None]
        passed, done = colors.new_ones(len(ys), xs.shape[1]), torch.zeros(len(ys), xs.shape[1], dtype=torch.bool)
        total = colors.new_zeros(*passed.shape, colors.shape[-1])
        for row in flatten_ids[begin:end].tolist():
            dx, dy = means2d[0, row, 0] - (xs.to(means2d) + 0.5), means2d[0, row, 1] - (ys.to(means2d) + 0.5)
            xx, xy, yy = conics[0, row]
            sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
            alpha = (opacities[0, row] * (-sigma).exp()).clamp_max(ALPHA_MAX)
            drawn = (sigma >= 0) & (alpha >= 1 / 255) & ~done
            done = done | (drawn & (passed * (1 - alpha) <= 1e-4))
            alpha = torch.where(drawn & ~done, alpha, 0)
            total = total + (passed * alpha)[..., None] * colors[0, row]
            passed = passed * (1 - alpha)
        rows_of_tile, columns_of_tile = ys.expand_as(passed), xs.expand_as(passed)
        blended = blended.index_put((rows_of_tile, columns_of_tile), total)
        left_over = left_over.index_put((rows_of_tile, columns_of_tile), passed)
    if backgrounds is not None:
        blended = blended + left_over[..., None] * backgrounds[0]
    return blended[None], 1 - left_over[None, ..., None]
