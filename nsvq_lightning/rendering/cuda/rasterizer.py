"""The CUDA back-end as differentiable functions: projection, then binning and blend."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.cuda.binning import Tiles, list_tiles
from nsvq_lightning.rendering.cuda.blend import blend, blend_backward, tile_grid
from nsvq_lightning.rendering.cuda.projection import Lens, project, project_backward, project_radii
from nsvq_lightning.rendering.sampling import Layers, Shading, ViewSampling
from nsvq_lightning.splats.splats import RawSplats


class _Project(torch.autograd.Function):
    """Raw attributes to centres, radii and records; the gradient of a record is its moments, see ``records``."""

    @staticmethod
    def forward(ctx: Any, lens: Lens, degree: int, sampling: ViewSampling | None, *attributes: Tensor) -> Any:
        projected = project(lens, attributes, degree, sampling)
        ctx.lens, ctx.degree, ctx.sampling = lens, degree, sampling
        ctx.save_for_backward(projected.ids, projected.records, *attributes)
        ctx.mark_non_differentiable(projected.radii, projected.ids, projected.boxes)
        ctx.set_materialize_grads(False)
        return projected

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means2d: Tensor | None, _r: None, _i: None, moments: Tensor | None, _b: None) -> Any:
        ids, records, *attributes = ctx.saved_tensors
        moments = torch.zeros_like(records) if moments is None else moments.contiguous()
        g_means2d = records.new_zeros(len(attributes[0]), 2) if g_means2d is None else g_means2d.contiguous()
        gradients = project_backward(
            ctx.lens, tuple(attributes), ctx.degree, ids, records, moments, g_means2d, ctx.sampling
        )
        return None, None, None, *gradients


class _Blend(torch.autograd.Function):
    """Projected splats to image, alpha and depth."""

    @staticmethod
    def forward(ctx: Any, lens: Lens, *inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        means2d, ids, records, boxes, background, pixel_weights, _absgrad = inputs
        tiles = list_tiles(boxes, *tile_grid(lens.width, lens.height))
        image, transmittance, depth, ends = blend(lens, records, tiles, background)
        ctx.lens, ctx.n = lens, len(means2d)
        ctx.save_for_backward(ids, records, ends, image, transmittance, depth, pixel_weights, *tiles)
        ctx.set_materialize_grads(False)
        return image, 1 - transmittance, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> Any:
        ids, records, ends, image, transmittance, depth, pixel_weights, *tiles = ctx.saved_tensors
        from_image, from_alpha, from_depth = (None if g is None else g.contiguous() for g in gradients)
        moments, g_means2d, g_absgrad = blend_backward(
            ctx.lens, records, ids, ctx.n, Tiles(*tiles), ends, (image, transmittance, depth),
            (from_image, from_alpha, from_depth), pixel_weights,
        )  # fmt: skip
        g_background = None
        if ctx.needs_input_grad[5] and from_image is not None:
            g_background = (from_image * transmittance[..., None]).sum((0, 1))
        return None, g_means2d, None, moments, None, g_background, None, g_absgrad


def render(splats: RawSplats, camera: Camera, shading: Shading) -> Layers:
    """Image ``[H, W, 3]``, alpha ``[H, W]``, radii ``[N]``, means2d ``[N, 2]`` and depth ``[H, W]``.

    See :func:`nsvq_lightning.render` for the meaning of arguments and results.
    """
    sh_degree, sampling, *behind = shading
    with torch.cuda.device_of(splats.means):
        lens = Lens.of(camera, splats.means.device)
        means2d, radii, ids, records, boxes = _Project.apply(lens, sh_degree, sampling, *splats)
        image, alpha, depth = _Blend.apply(lens, means2d, ids, records, boxes, *behind)
    return image, alpha, radii, means2d, depth


def visible(splats: RawSplats, camera: Camera) -> Tensor:
    """Rows ``[V]`` int64, ascending, of the splats that can change the image."""
    with torch.cuda.device_of(splats.means):
        return project_radii(Lens.of(camera, splats.means.device), splats).nonzero()[:, 0]
