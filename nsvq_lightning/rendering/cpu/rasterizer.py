"""The CPU back-end as differentiable functions: projection, then binning and blend; statistics for density control."""

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute.jit import F, parallel, parts_of
from nsvq_lightning.compute.memory import Array, Workspace, check_fit, flat, recycled
from nsvq_lightning.compute.rows import clear_all, share, vector_share
from nsvq_lightning.compute.simd import get, put
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.cpu import binning, harmonics, projection, projection_backward
from nsvq_lightning.rendering.cpu import blend as blending
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.formulas import TILE
from nsvq_lightning.rendering.sampling import Layers, Shading, ViewSampling
from nsvq_lightning.skips import is_on
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import FORM, RawSplats

# Fewer splats than these are not worth a part of their own: to wake a thread takes a tenth of a millisecond.
PROJECTED, LISTED, SORTED = 2048, 4096, 65_536


class _Frame:
    """One view of the splats on its way through the stages; holds its workspace for as long as it lives."""

    def __init__(self, splats: RawSplats, camera: Camera, degree: int, sampling: ViewSampling | None) -> None:
        self.camera = rec.pack_camera(camera)
        self.sampling = None
        if sampling is not None:
            nearest, farthest = sampling.distances
            self.sampling = flat(nearest), flat(farthest), np.float32(sampling.size)
        self.size = width, height = camera.size
        side = TILE << rec.GROUP_SHIFT
        self.group_columns, group_rows = -(-width // side), -(-height // side)
        self.tiles = self.group_columns * group_rows * rec.GROUP_TILES
        self.n = splats.means.shape[0]
        attributes = tuple(map(flat, splats))
        self.geometry, self.colors = attributes[:4], attributes[4:]
        self.bands = 3 * splats.shN.shape[1], degree
        self.parts = parts_of(self.n, PROJECTED)
        self.work = Workspace.borrow()
        weakref.finalize(self, self.work.give_back)
        self.records = self.work.array("records", rec.RECORD * self.n)
        self.integers = self.records.view(np.int32)

    def find(self) -> tuple[Array, Array, Array]:
        """Write the records of the visible splats; returns a run of rows, and the rows and slots, of each part."""
        found = self.work.array("found", self.n, np.int32)
        counts, slots = (self.work.array(name, self.parts, np.int64) for name in ("counts", "slot_counts"))
        projection.project_splats(
            self.parts, self.camera, self.sampling, *self.geometry, self.records, self.integers, found, counts, slots
        )
        return found, counts, slots

    def project(self, means2d: Array, radii: Array) -> None:
        """Write the records; list the visible splats by row (``ids``) and, as places in it, by depth (``order``)."""
        found, counts, slots = self.find()
        self.count, self.slots = int(counts.sum()), int(slots.sum())
        self.ids = self.work.array("ids", self.count + 16, np.int32)
        keys = self.work.array("keys", self.count + 1, np.int32)
        order = self.work.array("order", self.count, np.int32)
        self.boxes = self.work.array("boxes", self.count, np.int64)
        listed = self.ids, keys, order, self.boxes
        projection.join_runs(self.parts, (found, counts, slots), self.records, self.integers, listed, means2d, radii)
        harmonics.add_colors(
            self.parts, self.camera, self.geometry[0], self.colors, self.bands, self.ids, self.count, self.records
        )
        if self.count:
            other = self.work.array("order2", self.count, np.int32)
            keys2 = self.work.array("keys2", self.count + 1, np.int32)
            parts = parts_of(self.count, SORTED)
            histogram = self.work.rows("digits", parts, binning.DIGITS, np.int64)
            if binning.sort_by_depth(parts, self.count, keys, order, keys2, other, histogram):
                order = other
        self.order = order

    def bin(self) -> None:
        """List the splats of every tile, front to back."""
        parts = parts_of(self.count, max(LISTED, 4 * self.tiles))
        histogram = self.work.rows("tile_counts", parts, self.tiles, np.int64)
        self.offsets = self.work.array("offsets", self.tiles + 1, np.int64)
        listed = parts, self.count, self.order, self.boxes, self.group_columns, histogram
        total = binning.count_tiles(*listed, self.offsets)
        if total >= 2**31:
            raise RuntimeError(
                f"{self.count} splats cover {total} tiles of the {self.size[0]}x{self.size[1]} image, more than can be "
                "listed; the scales have probably diverged (lower their learning rate or prune large splats)"
            )
        self.entries = self.work.array("entries", total, np.int32)
        binning.fill_tiles(*listed, self.ids, self.entries)
        self.touched = self.work.array("touched", total + blending.BATCH, np.uint16)
        self.ends = self.work.array("ends", self.tiles, np.int64)

    def clear_sums(self) -> None:
        """A slot of zeros for each pair of a splat and a group."""
        self.sums = self.work.array("sums", rec.RECORD * self.slots)
        clear_all(parts_of(self.slots, SORTED), self.sums)


_GRID = blending.pixel_grid()


class _Project(torch.autograd.Function):
    """Raw attributes to projected centres; the records travel in the frame, and the token links the graph."""

    @staticmethod
    def forward(ctx: Any, frame: _Frame, *attributes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        means2d, radii = recycled((frame.n, 2)), recycled((frame.n,)).view(torch.int32)
        ctx.frame, ctx.shapes = frame, [tensor.shape for tensor in attributes]
        ctx.save_for_backward(*attributes)
        frame.project(flat(means2d), flat(radii))
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return means2d, means2d.new_zeros(()), radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means2d: Tensor | None, g_token: Tensor | None, g_radii: Tensor | None) -> tuple[Any, ...]:
        frame: _Frame = ctx.frame
        if g_token is None:
            # Only the centres were differentiated, so no blend has written sums.
            frame.clear_sums()
        g_means2d = torch.zeros(frame.n, 2) if g_means2d is None else g_means2d
        for name, tensor, shape in zip(ATTRIBUTES, ctx.saved_tensors, ctx.shapes, strict=False):
            if tensor.shape != shape:  # its data were replaced, which autograd does not notice
                raise ValueError(
                    f"{name} had shape {list(shape)} when it was rendered and {list(tensor.shape)} in the backward "
                    "pass; add or remove splats only after it"
                )
        gradients = [recycled(shape) for shape in ctx.shapes]
        projection_backward.project_backward(
            frame.parts, frame.camera, frame.sampling, frame.geometry, frame.colors[1], frame.bands, frame.ids,
            frame.count, frame.records, frame.integers, frame.sums, flat(g_means2d), tuple(map(flat, gradients)),
        )  # fmt: skip
        return None, *gradients


class _Blend(torch.autograd.Function):
    """Projected splats to image, alpha and depth."""

    @staticmethod
    def forward(ctx: Any, frame: _Frame, *inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        _means2d, _token, background, pixel_weights, _absgrad = inputs
        shape = frame.size[::-1]
        planes = image, transmittance, depth = recycled((*shape, 3)), recycled(shape), recycled(shape)
        frame.bin()
        blending.blend(
            frame.tiles, frame.records, frame.entries, frame.offsets, frame.group_columns, frame.size,
            flat(background), _GRID, frame.touched, frame.ends, tuple(map(flat, planes)), is_on("blocks"),
        )  # fmt: skip
        ctx.frame = frame
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(image, transmittance, depth, pixel_weights)
        return image, 1 - transmittance, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None, g_depth: Tensor | None) -> tuple[Any, ...]:
        frame: _Frame = ctx.frame
        image, transmittance, depth, pixel_weights = ctx.saved_tensors
        # Placeholders that are never read stand in for missing gradients and a missing map.
        with_absgrad = pixel_weights is not None
        wanted = g_alpha is not None, g_depth is not None, with_absgrad
        pixel_weights = flat(pixel_weights if with_absgrad else depth)
        g_image = torch.zeros_like(image) if g_image is None else g_image
        g_alpha = transmittance if g_alpha is None else g_alpha
        g_depth = depth if g_depth is None else g_depth
        frame.clear_sums()
        g_means2d, g_absgrad = recycled((frame.n, 2)), recycled((frame.n if with_absgrad else 0, 3))
        first = frame.offsets[:: rec.GROUP_TILES]
        order = np.argsort(first[:-1] - first[1:], kind="stable")
        blending.blend_backward(
            len(order), order, frame.records, frame.integers, frame.entries, frame.offsets, frame.ends,
            frame.group_columns, frame.size, _GRID, frame.touched, (flat(image), flat(transmittance), flat(depth)),
            (flat(g_image), flat(g_alpha), flat(g_depth)), pixel_weights, wanted, frame.sums,
        )  # fmt: skip
        blending.total_slots(
            frame.parts, frame.ids[: frame.count], frame.slots, frame.records, frame.integers, frame.sums,
            flat(g_means2d), with_absgrad, flat(g_absgrad),
        )  # fmt: skip
        g_background = (g_image * transmittance[..., None]).sum((0, 1)) if ctx.needs_input_grad[3] else None
        return None, g_means2d, torch.zeros(()), g_background, None, g_absgrad if with_absgrad else None


def render(splats: RawSplats, camera: Camera, shading: Shading) -> Layers:
    """Image ``[H, W, 3]``, alpha ``[H, W]``, radii ``[N]``, means2d ``[N, 2]`` and depth ``[H, W]``.

    See :func:`nsvq_lightning.render` for the meaning of arguments and results.

    Raises:
        ValueError: The attributes do not fit together, or the image is too large.
        TypeError: An attribute is not float32.
    """
    sh_degree, sampling, background, pixel_weights, absgrad = shading
    distances = None if sampling is None else sampling.distances
    width, height = camera.size
    text = f"{FORM}, background [3], pixel_weights [H, W], distances [2, N]"
    check_fit(text, *splats, background, pixel_weights, distances, H=height, W=width)
    frame = _Frame(splats, camera, sh_degree, sampling)
    means2d, token, radii = _Project.apply(frame, *splats)
    image, alpha, depth = _Blend.apply(frame, means2d, token, background, pixel_weights, absgrad)
    return image, alpha, radii, means2d, depth


def visible(splats: RawSplats, camera: Camera) -> Tensor:
    """Rows ``[V]`` int64, ascending, of the splats that can change the image.

    Raises:
        ValueError: The attributes do not fit together, or the image is too large.
        TypeError: An attribute is not float32.
    """
    check_fit(FORM, *splats)
    frame = _Frame(splats, camera, 0, None)
    found, counts, _ = frame.find()
    starts = (vector_share.py_func(frame.n, part, frame.parts)[0] for part in range(frame.parts))
    runs = [found[start : start + count] for start, count in zip(starts, counts, strict=True)]
    return torch.from_numpy(np.concatenate(runs, dtype=np.int64))


@parallel
def _add(part, parts, tables, gradients, radii, factors):
    sums, views, weights, columns = tables[0], tables[1], tables[-1], len(tables)
    for i in range(*share(radii.shape[0], part, parts)):
        if get(radii, i) > 0:
            x = factors[0] * get(gradients, columns * i)
            y = factors[1] * get(gradients, columns * i + 1)
            put(sums, i, get(sums, i) + np.sqrt(x * x + y * y))
            put(views, i, get(views, i) + F(1))
            if columns == 3 and get(gradients, 3 * i + 2) > 0:
                put(weights, i, get(weights, i) + factors[2] * get(gradients, 3 * i + 2))


def add_view(tables: Sequence[Tensor], gradients: Tensor, radii: Tensor, factors: tuple[float, float]) -> None:
    """Add the norms of one view's screen-space gradients, count it, and add its weights, where a splat was seen.

    Args:
        tables: Changed in place, ``[N]`` float32 each: sum of the norms; number of views; and, if there is a third one,
            sum of the weights, those of a view divided by the mean of its positive ones.
        gradients: Per pixel, x and y of each splat ``[N, 2]`` float32; with a table of weights x, y and the weight.
        radii: Radius on the screen ``[N]`` int32, 0 for splats that were not seen.
        factors: Factors of x and y.

    Raises:
        ValueError: The tensors differ in length, or one is not contiguous.
        TypeError: A dtype is wrong.
    """
    text = "gradients [N, C], radii [N] int32, sums [N], views [N], weights [N]"
    check_fit(text, gradients.contiguous(), radii, *tables, C=len(tables))
    given, seen = flat(gradients), flat(radii)
    # One thread adds up, and so to the same bits for any number of them.
    positive = np.fmax(given[2::3] if len(tables) == 3 else given[:0], 0)
    total = positive.sum(dtype=np.float64)
    by_weight = np.count_nonzero(positive) / total if total > 0 else 0.0
    _add(parts_of(len(seen), SORTED), tuple(map(flat, tables)), given, seen, (*map(F, factors), F(by_weight)))
