"""Projection, spherical harmonics and their backward pass, one splat per lane.

Equations: EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl et al. 2023, sec. 4).
"""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.devices import COMPILE, to_device
from nsvq_lightning.compute.memory import check_tensor
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.cuda import records as rec
from nsvq_lightning.rendering.cuda.harmonics import color, color_backward, load3, store3
from nsvq_lightning.splats.attributes import ATTRIBUTES


@triton.jit
def dot3(a, b):
    """Dot product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """Cross product of two triples."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def positive(x):
    """max(x, 0) that keeps NaN, so that the loss shows it; ``tl.maximum`` drops NaN on a GPU."""
    return tl.where(x < 0, 0.0, x)


@triton.jit
def row_of(view, k):
    """Three numbers of the packed view: rows 0 to 2 of the rotation, then translation and camera position."""
    return tl.load(view + 3 * k), tl.load(view + 3 * k + 1), tl.load(view + 3 * k + 2)


@triton.jit
def axes_of(quat, log_scales):
    """Unit quaternion and its inverse norm, axis lengths, and the rows of M = R·diag(lengths)."""
    w, x, y, z = quat
    largest = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    shrink = tl.where(largest > rec.HUGE_QUATERNION, rec.SHRINK, 1.0)
    w, x, y, z = w * shrink, x * shrink, y * shrink, z * shrink
    inverse = 1 / tl.sqrt(tl.maximum(w * w + x * x + y * y + z * z, rec.MIN_SQUARED_NORM))
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    s0 = tl.exp2(log_scales[0] * rec.LOG2_E)
    s1 = tl.exp2(log_scales[1] * rec.LOG2_E)
    s2 = tl.exp2(log_scales[2] * rec.LOG2_E)
    m0 = ((1 - 2 * (y * y + z * z)) * s0, 2 * (x * y - w * z) * s1, 2 * (x * z + w * y) * s2)
    m1 = (2 * (x * y + w * z) * s0, (1 - 2 * (x * x + z * z)) * s1, 2 * (y * z - w * x) * s2)
    m2 = (2 * (x * z - w * y) * s0, 2 * (y * z + w * x) * s1, (1 - 2 * (x * x + y * y)) * s2)
    return (w, x, y, z), inverse * shrink, (s0, s1, s2), m0, m1, m2


@triton.jit
def view_point(view, mean):
    """View-space x, y, z."""
    t = row_of(view, 3)
    return dot3(row_of(view, 0), mean) + t[0], dot3(row_of(view, 1), mean) + t[1], dot3(row_of(view, 2), mean) + t[2]


@triton.jit
def limited_slope(tangent, focal, centre, size):
    """The slope at which the Jacobian is evaluated, limited to a margin around the image."""
    margin = size * (0.5 * rec.FRUSTUM_MARGIN)
    return tl.minimum(tl.maximum(tangent, (-centre - margin) / focal), (size - centre + margin) / focal)


@triton.jit
def affine_row(view, k, scale, slope):
    """Row k of T = J·W: ``scale`` is focal/z, W the rotation."""
    near, far = row_of(view, k), row_of(view, 2)
    j = -(scale * slope)
    return scale * near[0] + j * far[0], scale * near[1] + j * far[1], scale * near[2] + j * far[2]


@triton.jit
def image_axes(t, m0, m1, m2):
    """One row of U = T·M: the splat's axes along one image axis."""
    return dot3(t, (m0[0], m1[0], m2[0])), dot3(t, (m0[1], m1[1], m2[1])), dot3(t, (m0[2], m1[2], m2[2]))


@triton.jit
def unit_direction(view, mean):
    """Unit vector from the camera to the splat and the inverse distance."""
    p = row_of(view, 4)
    x, y, z = mean[0] - p[0], mean[1] - p[1], mean[2] - p[2]
    inverse = 1 / tl.sqrt(tl.maximum(x * x + y * y + z * z, 1e-20))
    return x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def load_geometry(means, quats, scales, row, mask):
    """Mean, quaternion and log-scales of the rows."""
    q = quats + 4 * row
    w = tl.load(q, mask=mask, other=0.0)
    x, y, z = load3(q + 1, mask)
    return load3(means + 3 * row, mask), (w, x, y, z), load3(scales + 3 * row, mask)


# Splats per program.
BLOCK = 128
# Place of the near plane among the numbers of a camera.
NEAR = tl.constexpr(15)
# Passed as the SH degree where no record is wanted.
RADIUS_ONLY = -1


@triton.jit(do_not_specialize=["n"])
def project_kernel(
    means, quats, scales, logits, sh0, shN, view, fx, fy, cx, cy, width, height, n, stride,
    records, boxes, means2d, radii, DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Records, tile boxes and centres of the splats in view at their own rows; radii, 0 for the rest."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < n
    mean, quat, scale = load_geometry(means, quats, scales, row, inside)
    logit = tl.load(logits + row, mask=inside, other=0.0)
    x, y, z = view_point(view, mean)
    inverse = 1 / z
    t0 = affine_row(view, 0, fx * inverse, limited_slope(x * inverse, fx, cx, width))
    t1 = affine_row(view, 1, fy * inverse, limited_slope(y * inverse, fy, cy, height))
    _, _, _, m0, m1, m2 = axes_of(quat, scale)
    u, v = image_axes(t0, m0, m1, m2), image_axes(t1, m0, m1, m2)
    xx, xy, yy = dot3(u, u), dot3(u, v), dot3(v, v)
    # |u|²|v|² - (u·v)² = |u × v|² (Lagrange): no cancellation for large splats.
    normal, size = cross(u, v), xx + yy
    unit = tl.where(size > rec.HUGE_FOOTPRINT, 1 / size, 1.0)
    normal = (normal[0] * unit, normal[1] * unit, normal[2] * unit)
    determinant = dot3(normal, normal) + (size * rec.BLUR + rec.BLUR_SQUARED) * unit * unit
    xx, yy = xx + rec.BLUR, yy + rec.BLUR

    px, py = fx * (x * inverse) + cx, fy * (y * inverse) + cy
    log2_opacity = -tl.log2(1 + tl.exp2(-(logit * rec.LOG2_E)))
    # α reaches 1/255 where u² + v² ≤ log2(255 o): a box of half sizes √(2 ln(255 o)·Σ_ii).
    reach = (log2_opacity - rec.LOG2_ALPHA_MIN) * (2 * rec.LN2)
    half_x, half_y = tl.sqrt(tl.maximum(reach, 0.0) * xx), tl.sqrt(tl.maximum(reach, 0.0) * yy)
    left, right = tl.maximum(tl.ceil(px - half_x - 0.5), 0.0), tl.floor(px + half_x - 0.5)
    top, bottom = tl.maximum(tl.ceil(py - half_y - 0.5), 0.0), tl.floor(py + half_y - 0.5)
    right, bottom = tl.minimum(right, width - 1.0), tl.minimum(bottom, height - 1.0)
    seen = inside & (z > tl.load(view + NEAR)) & (reach > 0) & (left <= right) & (top <= bottom)
    seen = seen & (size < rec.LARGEST_FOOTPRINT) & (determinant < rec.FINITE)
    seen = seen & (tl.abs(px) < rec.FINITE) & (tl.abs(py) < rec.FINITE) & (logit >= -rec.FINITE)
    # A log-scale of -inf is a splat without extent; one of +inf or NaN is broken.
    seen = seen & (scale[0] + scale[1] + scale[2] < rec.FINITE)

    radius = tl.minimum(tl.ceil(tl.maximum(half_x, half_y)), 1e9)
    tl.store(radii + row, tl.where(seen, radius, 0.0).to(tl.int32), mask=inside)
    if DEGREE >= 0:
        tl.store(means2d + 2 * row, px, mask=seen)
        tl.store(means2d + 2 * row + 1, py, mask=seen)
        x0, y0 = tl.where(seen, left, 0.0).to(tl.int32) // rec.TILE, tl.where(seen, top, 0.0).to(tl.int32) // rec.TILE
        x1 = tl.where(seen, right, 0.0).to(tl.int32) // rec.TILE
        y1 = tl.where(seen, bottom, 0.0).to(tl.int32) // rec.TILE
        box = boxes + 4 * row
        tl.store(box, x0, mask=seen)
        tl.store(box + 1, y0, mask=seen)
        tl.store(box + 2, x1 - x0 + 1, mask=seen)
        tl.store(box + 3, y1 - y0 + 1, mask=seen)
        dx, dy, dz, _ = unit_direction(view, mean)
        red, green, blue = color(sh0, shN, row, row * stride, dx, dy, dz, seen, DEGREE)
        a = tl.sqrt(yy * unit / determinant * unit) * rec.FACTOR_SCALE
        record = records + row * rec.RECORD
        tl.store(record + rec.X, px, mask=seen)
        tl.store(record + rec.Y, py, mask=seen)
        tl.store(record + rec.A, a, mask=seen)
        tl.store(record + rec.B, -(a * (xy / yy)), mask=seen)
        tl.store(record + rec.C, 1 / tl.sqrt(yy) * rec.FACTOR_SCALE, mask=seen)
        tl.store(record + rec.LOG2_OPACITY, log2_opacity, mask=seen)
        tl.store(record + rec.RED, positive(red), mask=seen)
        tl.store(record + rec.GREEN, positive(green), mask=seen)
        tl.store(record + rec.BLUE, positive(blue), mask=seen)
        tl.store(record + rec.DEPTH, z, mask=seen)


@triton.jit
def quaternion_gradient(q, inverse, r0, r1, r2):
    """dL/dq of an unnormalised quaternion from the rows of dL/dR."""
    w, x, y, z = q
    gw = 2 * (x * (r2[1] - r1[2]) + y * (r0[2] - r2[0]) + z * (r1[0] - r0[1]))
    gx = 2 * (y * (r0[1] + r1[0]) + z * (r0[2] + r2[0]) + w * (r2[1] - r1[2]) - 2 * x * (r1[1] + r2[2]))
    gy = 2 * (x * (r0[1] + r1[0]) + z * (r1[2] + r2[1]) + w * (r0[2] - r2[0]) - 2 * y * (r0[0] + r2[2]))
    gz = 2 * (x * (r0[2] + r2[0]) + y * (r1[2] + r2[1]) + w * (r1[0] - r0[1]) - 2 * z * (r0[0] + r1[1]))
    radial = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - radial * w) * inverse,
        (gx - radial * x) * inverse,
        (gy - radial * y) * inverse,
        (gz - radial * z) * inverse,
    )


@triton.jit
def scaled_row(t0, t1, gu, gv):
    """One row of dL/dM = Tᵀ·dL/dU."""
    return t0 * gu[0] + t1 * gv[0], t0 * gu[1] + t1 * gv[1], t0 * gu[2] + t1 * gv[2]


@triton.jit(do_not_specialize=["n"])
def project_backward_kernel(
    means, quats, scales, logits, shN, view, fx, fy, cx, cy, width, height, n, ranks, records, totals, g_means2d,
    g_means, g_quats, g_scales, g_logits, g_sh0, g_shN,
    STRIDE: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of all attributes from the moments (``totals``, one slot each) of the splats in view.

    Rows are written in their order, those out of view (of rank -1) with zeros: reads as 0 make all that follows 0.
    """
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < n
    rank = tl.load(ranks + row, mask=inside, other=-1).to(tl.int64)
    seen = rank >= 0
    mean, quat, scale = load_geometry(means, quats, scales, row, seen)
    x, y, z = view_point(view, mean)
    inverse = 1 / tl.where(seen, z, 1.0)
    tx, ty = x * inverse, y * inverse
    slope_x, slope_y = limited_slope(tx, fx, cx, width), limited_slope(ty, fy, cy, height)
    fx_z, fy_z = fx * inverse, fy * inverse
    t0, t1 = affine_row(view, 0, fx_z, slope_x), affine_row(view, 1, fy_z, slope_y)
    q, q_inverse, s, m0, m1, m2 = axes_of(quat, scale)
    u, v = image_axes(t0, m0, m1, m2), image_axes(t1, m0, m1, m2)

    # dL/dΣ = ½ Fᵀ S F with S = Σ h uuᵀ, so dL/dU = Fᵀ S (F U). The rows of F U are a·u + b·v and c·v; by Lagrange's
    # identity the first is a·(v × (u × v) + blur·u)/|v|², which stays accurate for needles.
    total, record = totals + rank * rec.RECORD, records + rank * rec.RECORD
    a, b, c = load3(record + rec.A, seen)
    uu, uv, vv = load3(total + rec.SUM_UU, seen)
    uu, uv, vv = uu * (2 * rec.COVARIANCE_SCALE), uv * (2 * rec.COVARIANCE_SCALE), vv * (2 * rec.COVARIANCE_SCALE)
    per_yy = 1 / (dot3(v, v) + rec.BLUR)
    n = cross(u, v)
    n = cross(v, (n[0] * per_yy, n[1] * per_yy, n[2] * per_yy))
    blur = per_yy * rec.BLUR
    fu = (a * (blur * u[0] + n[0]), a * (blur * u[1] + n[1]), a * (blur * u[2] + n[2]))
    fv = (c * v[0], c * v[1], c * v[2])
    e = (uu * fu[0] + uv * fv[0], uu * fu[1] + uv * fv[1], uu * fu[2] + uv * fv[2])
    f = (uv * fu[0] + vv * fv[0], uv * fu[1] + vv * fv[1], uv * fu[2] + vv * fv[2])
    gu = (a * e[0], a * e[1], a * e[2])
    gv = (b * e[0] + c * f[0], b * e[1] + c * f[1], b * e[2] + c * f[2])

    gs = (fu[0] * e[0] + fv[0] * f[0], fu[1] * e[1] + fv[1] * f[1], fu[2] * e[2] + fv[2] * f[2])
    store3(g_scales + 3 * row, gs[0], gs[1], gs[2], inside)
    gm0, gm1 = scaled_row(t0[0], t1[0], gu, gv), scaled_row(t0[1], t1[1], gu, gv)
    gm2 = scaled_row(t0[2], t1[2], gu, gv)
    r0 = (gm0[0] * s[0], gm0[1] * s[1], gm0[2] * s[2])
    r1 = (gm1[0] * s[0], gm1[1] * s[1], gm1[2] * s[2])
    r2 = (gm2[0] * s[0], gm2[1] * s[1], gm2[2] * s[2])
    gw, gx, gy, gz = quaternion_gradient(q, q_inverse, r0, r1, r2)
    tl.store(g_quats + 4 * row, gw, mask=inside)
    store3(g_quats + 4 * row + 1, gx, gy, gz, inside)

    # J = [[fx/z, 0, -fx·sx/z], [0, fy/z, -fy·sy/z]]; sx = x/z except where it is limited.
    w0, w1, w2 = row_of(view, 0), row_of(view, 1), row_of(view, 2)
    g0 = (dot3(gu, m0), dot3(gu, m1), dot3(gu, m2))
    g1 = (dot3(gv, m0), dot3(gv, m1), dot3(gv, m2))
    j00, j02 = dot3(w0, g0), dot3(w2, g0)
    j11, j12 = dot3(w1, g1), dot3(w2, g1)
    g2x = tl.load(g_means2d + 2 * row, mask=seen, other=0.0)
    g2y = tl.load(g_means2d + 2 * row + 1, mask=seen, other=0.0)
    fx_zz, fy_zz = fx_z * inverse, fy_z * inverse
    free_x, free_y = tl.where(slope_x == tx, 1.0, 0.0), tl.where(slope_y == ty, 1.0, 0.0)
    vx = fx_z * g2x - free_x * fx_zz * j02
    vy = fy_z * g2y - free_y * fy_zz * j12
    vz = (1 + free_x) * fx_zz * slope_x * j02 + (1 + free_y) * fy_zz * slope_y * j12
    vz -= fx_zz * (x * g2x + j00) + fy_zz * (y * g2y + j11)
    vz += tl.load(total + rec.SUM_DEPTH, mask=seen, other=0.0)

    # A colour below 0 was clamped.
    rgb, g_rgb = load3(record + rec.RED, seen), load3(total + rec.SUM_RED, seen)
    red = tl.where(rgb[0] > 0, g_rgb[0], 0.0)
    green = tl.where(rgb[1] > 0, g_rgb[1], 0.0)
    blue = tl.where(rgb[2] > 0, g_rgb[2], 0.0)
    dx, dy, dz, d_inverse = unit_direction(view, mean)
    cx_, cy_, cz_ = color_backward(
        g_sh0, g_shN, shN, row, row * STRIDE, dx, dy, dz, red, green, blue, seen, inside, DEGREE
    )
    for k in range(3 * (DEGREE + 1) * (DEGREE + 1) - 3, STRIDE):  # of the bands that are not evaluated
        tl.store(g_shN + row * STRIDE + k, 0.0, mask=inside)
    radial = cx_ * dx + cy_ * dy + cz_ * dz
    g_x = w0[0] * vx + w1[0] * vy + w2[0] * vz + (cx_ - radial * dx) * d_inverse
    g_y = w0[1] * vx + w1[1] * vy + w2[1] * vz + (cy_ - radial * dy) * d_inverse
    g_z = w0[2] * vx + w1[2] * vy + w2[2] * vz + (cz_ - radial * dz) * d_inverse
    store3(g_means + 3 * row, g_x, g_y, g_z, inside)
    logit = tl.load(logits + row, mask=seen, other=0.0)
    h = tl.load(total + rec.SUM_H, mask=seen, other=0.0)
    tl.store(g_logits + row, h / (1 + tl.exp2(logit * rec.LOG2_E)), mask=inside)


class Lens(NamedTuple):
    """A camera as the kernels take it.

    Attributes:
        view: Rotation row by row, translation, camera position and near plane ``[16]`` float32 on the device of the
            splats.
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
    def of(cls, camera: Camera, device: torch.device) -> "Lens":
        """Pack a camera; for one that has been packed for the device before, nothing is copied."""
        lens = _lenses.get(camera, {}).get(device)
        if lens is None:
            view = to_device(torch.tensor([*camera.packed_view, camera.near], dtype=torch.float32), device)
            lens = cls(view, *camera.intrinsics, camera.width, camera.height)
            _lenses.setdefault(camera, {})[device] = lens
        return lens


# Packed cameras by device.
_lenses: WeakKeyDictionary[Camera, dict[torch.device, Lens]] = WeakKeyDictionary()


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


def _check_attributes(lens: Lens, attributes: tuple[Tensor, ...]) -> None:
    n, device, coefficients = len(attributes[0]), attributes[0].device, attributes[-1].shape[1]
    check_tensor("lens.view", lens.view, (16,), device)
    shapes = (n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, coefficients, 3)
    for name, attribute, shape in zip(ATTRIBUTES, attributes, shapes, strict=True):
        check_tensor(name, attribute, shape, device)


def _launch_projection(
    lens: Lens, attributes: tuple[Tensor, ...], degree: int, records: Tensor, boxes: Tensor, means2d: Tensor
) -> Tensor:
    n, shN = attributes[0].shape[0], attributes[-1]
    _check_attributes(lens, attributes)
    radii = torch.zeros(n, dtype=torch.int32, device=shN.device)
    if n:
        project_kernel[(triton.cdiv(n, BLOCK),)](
            *attributes, *lens, n, 3 * shN.shape[1], records, boxes, means2d, radii,
            DEGREE=degree, BLOCK=BLOCK, **COMPILE,
        )  # fmt: skip
    return radii


def project_radii(lens: Lens, attributes: tuple[Tensor, ...]) -> Tensor:
    """Radii ``[N]`` int32 of all splats, 0 where not in view; the colours in ``attributes`` are not read.

    Raises:
        ValueError: The tensors do not fit together.
        TypeError: A dtype is wrong.
    """
    unused = attributes[0]
    return _launch_projection(lens, attributes, RADIUS_ONLY, unused, unused, unused)


def project(lens: Lens, attributes: tuple[Tensor, ...], degree: int) -> Projected:
    """Project all splats and list those in view.

    Args:
        lens: The camera.
        attributes: The six raw attributes, contiguous float32, in the order of :class:`~nsvq_lightning.RawSplats`.
        degree: Highest SH degree that is evaluated, at most the stored one.

    Raises:
        ValueError: The tensors do not fit together.
        TypeError: A dtype is wrong.
    """
    means = attributes[0]
    n = means.shape[0]
    records = means.new_empty(n, rec.RECORD.value)
    boxes = torch.empty(n, 4, dtype=torch.int32, device=means.device)
    means2d = means.new_zeros(n, 2)
    radii = _launch_projection(lens, attributes, degree, records, boxes, means2d)
    ids = radii.nonzero()[:, 0]
    ids = ids[records[ids, rec.DEPTH.value].sort(stable=True).indices]
    return Projected(means2d, radii, ids, records[ids], boxes[ids])


def project_backward(
    lens: Lens,
    attributes: tuple[Tensor, ...],
    degree: int,
    ids: Tensor,
    records: Tensor,
    totals: Tensor,
    g_means2d: Tensor,
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

    Raises:
        ValueError: The tensors do not fit together.
        TypeError: A dtype is wrong.
    """
    _check_attributes(lens, attributes)
    device = attributes[0].device
    check_tensor("ids", ids, (len(ids),), device, torch.int64)
    check_tensor("records", records, (len(ids), rec.RECORD.value), device)
    check_tensor("totals", totals, (len(ids), rec.RECORD.value), device)
    check_tensor("g_means2d", g_means2d, (len(attributes[0]), 2), device)
    gradients = [torch.empty_like(attribute) for attribute in attributes]
    means, quats, scales, logits, _, shN = attributes
    n = means.shape[0]
    ranks = torch.full((n,), -1, dtype=torch.int32, device=device)
    ranks[ids] = torch.arange(len(ids), dtype=torch.int32, device=device)
    if n:
        project_backward_kernel[(triton.cdiv(n, BLOCK),)](
            means, quats, scales, logits, shN, *lens, n, ranks, records, totals, g_means2d, *gradients,
            STRIDE=3 * shN.shape[1], DEGREE=degree, BLOCK=BLOCK, **COMPILE,
        )  # fmt: skip
    return gradients
