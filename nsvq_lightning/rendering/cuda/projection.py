"""Projection, spherical harmonics and their backward pass, one splat per lane."""

from functools import lru_cache
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.language import constexpr

from nsvq_lightning.compute.devices import COMPILE, to_device
from nsvq_lightning.compute.formulas import for_triton
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.rendering import formulas as shared
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.cuda import records as rec
from nsvq_lightning.rendering.cuda.harmonics import color, color_backward, load_if, load_row, places, store_row
from nsvq_lightning.rendering.sampling import ViewSampling
from nsvq_lightning.splats.splats import FORM

formulas = for_triton(shared)
# Places of the limits of slopes and of the near plane among the numbers of a camera.
SLOPES, NEAR = constexpr(15), constexpr(19)

# Splats per program.
BLOCK = 128
# What kernels are given where splats are rendered as they are.
NO_SAMPLING = None, None


@triton.jit
def row_of(view, k):
    """Three numbers of the packed view: rows 0 to 2 of the rotation, then translation and camera position."""
    return tl.load(view + 3 * k), tl.load(view + 3 * k + 1), tl.load(view + 3 * k + 2)


@triton.jit
def load_view(view, fx, fy):
    """The view of :mod:`nsvq_lightning.rendering.formulas`."""
    rotation = (row_of(view, 0), row_of(view, 1), row_of(view, 2))
    slopes_x = (tl.load(view + SLOPES), tl.load(view + SLOPES + 1))
    slopes_y = (tl.load(view + SLOPES + 2), tl.load(view + SLOPES + 3))
    return rotation, row_of(view, 3), (fx, fy), slopes_x, slopes_y


@triton.jit
def load_geometry(means, quats, scales, row, mask):
    """Mean, quaternion and log-scales of the rows."""
    return load_row(means + 3 * row, 3, mask), load_row(quats + 4 * row, 4, mask), load_row(scales + 3 * row, 3, mask)


@triton.jit
def load_sampling(distances, size, row, n, mask):
    """The sampling of the rows, whose ``distances`` are ``[2, n]``."""
    nearest = tl.load(distances + row, mask=mask, other=1.0)
    return nearest, tl.load(distances + n + row, mask=mask, other=1.0), size


# Passed as the SH degree where no record is wanted.
RADIUS_ONLY = -1


@triton.jit(do_not_specialize=["n"])
def project_kernel(
    means, quats, scales, logits, sh0, shN, view, fx, fy, cx, cy, width, height, n, stride, distances, size,
    records, boxes, means2d, radii, DEGREE: constexpr, BLOCK: constexpr,
):  # fmt: skip
    """Records, tile boxes and centres of the splats in view at their own rows; radii, 0 for the rest."""
    row = places(BLOCK)
    inside = row < n
    mean, quat, scale = load_geometry(means, quats, scales, row, inside)
    logit = load_if(logits + row, inside)
    camera = load_view(view, fx, fy)
    screen = (cx, cy, width, height, tl.load(view + NEAR))
    point = formulas.view_point(camera, mean)
    trained_at = None  # Triton before 3.7 cannot return it
    if distances is not None:
        trained_at = load_sampling(distances, size, row, n, inside)
    seen, record, first, last, radius = formulas.footprint(camera, screen, point, quat, scale, logit, trained_at)
    seen = inside & seen
    radius = tl.minimum(radius, 1e9)
    tl.store(radii + row, tl.where(seen, radius, 0.0).to(tl.int32), mask=inside)
    if DEGREE >= 0:
        px, py, a, b, c, log2_opacity, z, _, _ = record
        store_row(means2d + 2 * row, (px, py), seen)
        x0, y0 = tl.where(seen, first[0], 0.0).to(tl.int32), tl.where(seen, first[1], 0.0).to(tl.int32)
        x1, y1 = tl.where(seen, last[0], 0.0).to(tl.int32), tl.where(seen, last[1], 0.0).to(tl.int32)
        store_row(boxes + 4 * row, (x0, y0, x1 - x0 + 1, y1 - y0 + 1), seen)
        d, _ = formulas.unit_direction(row_of(view, 4), mean)
        red, green, blue = formulas.clamped(color(sh0 + 3 * row, shN + row * stride, d, seen, DEGREE))
        fields = (px, py, a, b, c, log2_opacity, red, green, blue, z)
        store_row(records + row * rec.RECORD, fields, seen)


@triton.jit(do_not_specialize=["n"])
def project_backward_kernel(
    means, quats, scales, logits, shN, view, fx, fy, cx, cy, width, height, n, distances, size, ranks, records, totals,
    g_means2d, g_means, g_quats, g_scales, g_logits, g_sh0, g_shN,
    STRIDE: constexpr, DEGREE: constexpr, BLOCK: constexpr,
):  # fmt: skip
    """Gradients of all attributes from the moments (``totals``, one slot each) of the splats in view.

    Rows are written in their order, those out of view (of rank -1) with zeros: reads as 0 make all that follows 0.
    """
    row = places(BLOCK)
    inside = row < n
    rank = tl.load(ranks + row, mask=inside, other=-1).to(tl.int64)
    seen = rank >= 0
    mean, quat, scale = load_geometry(means, quats, scales, row, seen)
    camera = load_view(view, fx, fy)
    x, y, z = formulas.view_point(camera, mean)
    total, record = totals + rank * rec.RECORD, records + rank * rec.RECORD
    centre = load_row(g_means2d + 2 * row, 2, seen)
    h = load_if(total + rec.SUM_H, seen)
    trained_at = None
    if distances is not None:
        trained_at = load_sampling(distances, size, row, n, seen)
    g_mean, g_quat, g_scale = formulas.geometry_backward(
        camera, (x, y, tl.where(seen, z, 1.0)), quat, scale, load_row(record + rec.A, 3, seen),
        load_row(total + rec.SUM_UU, 3, seen), h, centre, load_if(total + rec.SUM_DEPTH, seen), trained_at,
    )  # fmt: skip
    store_row(g_scales + 3 * row, g_scale, inside)
    store_row(g_quats + 4 * row, g_quat, inside)

    rgb = formulas.unclamped(load_row(record + rec.RED, 3, seen), load_row(total + rec.SUM_RED, 3, seen))
    d, d_inverse = formulas.unit_direction(row_of(view, 4), mean)
    g_row = g_shN + row * STRIDE
    g_d = color_backward(g_sh0 + 3 * row, (shN + row * STRIDE, g_row), d, rgb, (seen, inside), DEGREE)
    for k in range(3 * (DEGREE + 1) * (DEGREE + 1) - 3, STRIDE):  # of the bands that are not evaluated
        tl.store(g_row + k, 0.0, mask=inside)
    store_row(g_means + 3 * row, formulas.add3(g_mean, formulas.mean_gradient(d, d_inverse, g_d)), inside)
    logit = load_if(logits + row, seen)
    tl.store(g_logits + row, formulas.logit_gradient(logit, h), mask=inside)


@triton.jit(do_not_specialize=["n"])
def take_kernel(table, ids, n, taken, WIDTH: constexpr, BLOCK: constexpr):
    """Rows ``ids`` of a table; torch's own indexing takes ten times as long for rows of whole 16-byte words."""
    place, field = places(BLOCK), tl.arange(0, 16)
    row = load_if(ids + place, place < n)
    wanted = (place < n)[:, None] & (field < WIDTH)[None]
    found = tl.load(table + row[:, None] * WIDTH + field, mask=wanted)
    tl.store(taken + place[:, None] * WIDTH + field, found, mask=wanted)


def _take(table: Tensor, ids: Tensor) -> Tensor:
    """Rows ``ids [V]`` of a table ``[N, WIDTH]`` of at most 16 columns."""
    n, width = len(ids), table.shape[1]
    taken = table.new_empty(n, width)
    if n:
        take_kernel[(triton.cdiv(n, BLOCK),)](table, ids, n, taken, WIDTH=width, BLOCK=BLOCK, **COMPILE)
    return taken


class Lens(NamedTuple):
    """A camera as the kernels take it.

    Attributes:
        view: Rotation row by row, translation, camera position, limits of slopes and near plane ``[20]`` float32 on
            the device of the splats.
        fx: Focal length in x, pixels.
        fy: Focal length in y, pixels.
        cx: Principal point, x in pixels.
        cy: Principal point, y in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
    """

    view: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @classmethod
    @lru_cache(4096)  # as many as a frame keeps
    def of(cls, camera: Camera, device: torch.device) -> "Lens":
        """Pack a camera; for one that has been packed for the device before, nothing is copied."""
        numbers = [*camera.packed_view, *camera.slope_limits, camera.near]
        view = to_device(torch.tensor(numbers, dtype=torch.float32), device)
        return cls(view, *camera.intrinsics, *camera.size)


class Projected(NamedTuple):
    """The splats of a view.

    Attributes:
        means2d: Projected centres of all splats ``[N, 2]``, 0 for those not in view.
        radii: Their radii ``[N]`` int32.
        ids: Rows of the splats in view, front to back ``[V]`` int64; the lower row first where depths are equal.
        records: Their records ``[V, RECORD]``.
        boxes: The tiles they touch: first column and row, number of columns and rows ``[V, 4]`` int32.
    """

    means2d: Tensor
    radii: Tensor
    ids: Tensor
    records: Tensor
    boxes: Tensor


def _check_attributes(lens: Lens, attributes: tuple[Tensor, ...], sampling: ViewSampling | None) -> None:
    distances = None if sampling is None else sampling.distances
    check_fit(f"{FORM}, camera [20], distances [2, N]", *attributes, lens.view, distances)


def _launch_projection(
    lens: Lens, attributes: tuple[Tensor, ...], degree: int, sampling: ViewSampling | None, *outputs: Tensor
) -> Tensor:
    """Write records, boxes and projected centres of all splats, and return their radii."""
    n, shN = len(attributes[0]), attributes[-1]
    _check_attributes(lens, attributes, sampling)
    radii = shN.new_zeros(n, dtype=torch.int32)
    if n:
        project_kernel[(triton.cdiv(n, BLOCK),)](
            *attributes, *lens, n, 3 * shN.shape[1], *(sampling or NO_SAMPLING), *outputs, radii,
            DEGREE=degree, BLOCK=BLOCK, **COMPILE,
        )  # fmt: skip
    return radii


def project_radii(lens: Lens, attributes: tuple[Tensor, ...]) -> Tensor:
    """Radii ``[N]`` int32 of all splats, 0 where not in view; the colours in ``attributes`` are not read."""
    unused = attributes[0]
    return _launch_projection(lens, attributes, RADIUS_ONLY, None, unused, unused, unused)


def project(lens: Lens, attributes: tuple[Tensor, ...], degree: int, sampling: ViewSampling | None = None) -> Projected:
    """Project all splats and list those in view.

    Args:
        lens: The camera.
        attributes: The six raw attributes, contiguous float32, in the order of
            :class:`~nsvq_lightning.splats.splats.RawSplats`.
        degree: Highest SH degree that is evaluated, at most the stored one.
        sampling: How the splats were trained, or None.
    """
    means = attributes[0]
    n = len(means)
    records = means.new_empty(n, rec.RECORD.value)
    boxes = means.new_empty(n, 4, dtype=torch.int32)
    means2d = means.new_zeros(n, 2)
    radii = _launch_projection(lens, attributes, degree, sampling, records, boxes, means2d)
    ids = radii.nonzero()[:, 0]
    ids = ids[records[ids, rec.DEPTH.value].sort(stable=True).indices]
    return Projected(means2d, radii, ids, _take(records, ids), _take(boxes, ids))


def project_backward(
    lens: Lens,
    attributes: tuple[Tensor, ...],
    degree: int,
    ids: Tensor,
    records: Tensor,
    totals: Tensor,
    g_means2d: Tensor,
    sampling: ViewSampling | None,
) -> list[Tensor]:
    """Gradients of the six attributes, 0 for splats not in view.

    Args:
        lens: As in :func:`project`.
        attributes: As in :func:`project`.
        degree: As in :func:`project`.
        ids: Rows of the splats in view ``[V]``.
        records: Their records ``[V, RECORD]``.
        totals: Their summed moments ``[V, RECORD]``.
        g_means2d: Gradient of the projected centres ``[N, 2]``.
        sampling: As in :func:`project`.
    """
    _check_attributes(lens, attributes, sampling)
    text = f"ids [V] int64, records [V, {rec.RECORD.value}], totals [V, {rec.RECORD.value}], g_means2d [N, 2]"
    check_fit(text, ids, records, totals, g_means2d, N=len(attributes[0]))
    gradients = [torch.empty_like(attribute) for attribute in attributes]
    means, quats, scales, logits, _, shN = attributes
    n = len(means)
    ranks = means.new_full((n,), -1, dtype=torch.int32)
    ranks[ids] = torch.arange(len(ids), dtype=torch.int32, device=ids.device)
    if n:
        project_backward_kernel[(triton.cdiv(n, BLOCK),)](
            means, quats, scales, logits, shN, *lens, n, *(sampling or NO_SAMPLING), ranks, records, totals, g_means2d,
            *gradients, STRIDE=3 * shN.shape[1], DEGREE=degree, BLOCK=BLOCK, **COMPILE,
        )  # fmt: skip
    return gradients
