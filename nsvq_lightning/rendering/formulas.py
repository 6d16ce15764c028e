"""The algebra of the renderer's kernels, the same code on a CPU and on a GPU (:mod:`nsvq_lightning.compute.formulas`).

Numbers are of many splats, or pixels, at a time; a vector is a triple of them. A *view* is the camera as formulas take
it: the three rows of its rotation, its translation, both focal lengths in pixels, and for x and y the lowest and the
highest slope at which a Jacobian is evaluated. *Sampling* is the nearest and the farthest distance that training saw a
splat from, and (focal length here / there)², or None, which is known when a kernel is compiled: then it has no code for
it.

Equations: EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl et al. 2023, sec. 4).
"""

import math

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline
from nsvq_lightning.rendering import constants, sh
from nsvq_lightning.splats import conventions

ALPHA_MAX = F(constants.ALPHA_MAX)
TRANSMITTANCE_MIN = F(constants.TRANSMITTANCE_MIN)
BLUR, BLUR_SQUARED = F(constants.BLUR), F(constants.BLUR**2)
MIN_SQUARED_NORM = F(conventions.MIN_SQUARED_NORM)
FINITE = F(constants.FINITE)
# Square of the smallest factor by which sampling dims.
MIN_LIGHT = F(constants.FAINTEST**2)
MAX_RATIO = F(constants.MAX_RATIO)
HUGE_FOOTPRINT, LARGEST_FOOTPRINT = F(constants.HUGE_FOOTPRINT), F(constants.LARGEST_FOOTPRINT)
HUGE_QUATERNION, SHRINK = F(constants.HUGE_QUATERNION), F(constants.SHRINK)
LOG2_ALPHA_MIN = F(math.log2(constants.ALPHA_MIN))
LOG2_E, TWO_LN2 = F(math.log2(math.e)), F(2 * math.log(2))
# √(½·log2 e): turns the Cholesky factor of the inverse covariance into that of the binary exponent.
FACTOR_SCALE = F(math.sqrt(0.5 * math.log2(math.e)))
# Twice ½ / (½ log2 e)², which converts moments of the scaled factor to dL/dΣ.
MOMENT_SCALE = F(4 * math.log(2) ** 2)
# Side of a tile in pixels.
TILE = 16
PER_TILE = F(1 / TILE)

C0, C1 = F(sh.C0), F(sh.C1)
C2A, C2B, C2C = (F(value) for value in sh.C2)
C3A, C3B, C3C, C3D, C3E = (F(value) for value in sh.C3)


@inline
def dot3(a, b):
    """Dot product of two vectors."""
    return simd.fma(a[0], b[0], simd.fma(a[1], b[1], a[2] * b[2]))


@inline
def scale3(k, v):
    """The vector k·v."""
    return k * v[0], k * v[1], k * v[2]


@inline
def add3(v, w):
    """The vector v + w."""
    return v[0] + w[0], v[1] + w[1], v[2] + w[2]


@inline
def times3(v, w):
    """The products of the components of two vectors."""
    return v[0] * w[0], v[1] * w[1], v[2] * w[2]


@inline
def fma3(k, v, w):
    """The vector k·v + w."""
    return simd.fma(k, v[0], w[0]), simd.fma(k, v[1], w[1]), simd.fma(k, v[2], w[2])


@inline
def cross(u, v):
    """The vector product u × v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@inline
def exp2_clamped(x):
    """2**x with x limited to [-125, 125]: never 0, never infinite; NaN becomes 2**-125."""
    return simd.exp2(simd.minimum(simd.maximum(x, -125.0), 125.0))


@inline
def times(m, v):
    """The product of a matrix, three rows, and a vector."""
    return dot3(m[0], v), dot3(m[1], v), dot3(m[2], v)


@inline
def columns(m):
    """The columns of a matrix, which are the rows of its transpose."""
    r0, r1, r2 = m
    return (r0[0], r1[0], r2[0]), (r0[1], r1[1], r2[1]), (r0[2], r1[2], r2[2])


@inline
def view_point(view, mean):
    """View-space x, y, z."""
    rotation, translation, _, _, _ = view
    return add3(times(rotation, mean), translation)


@inline
def affine_row(near, far, scale, slope):
    """A row of T = J·W, the local affine map, from two of the rotation W; ``scale`` is focal/z."""
    return fma3(scale, near, scale3(-(scale * slope), far))


@inline
def affine(view, point):
    """1/z of a view-space point, its slopes limited to the frustum, and both rows of T = J·W."""
    rotation, _, focal, slopes_x, slopes_y = view
    x, y, z = point
    inverse = 1 / z
    slope_x = simd.minimum(slopes_x[1], simd.maximum(slopes_x[0], x * inverse))
    slope_y = simd.minimum(slopes_y[1], simd.maximum(slopes_y[0], y * inverse))
    t0 = affine_row(rotation[0], rotation[2], focal[0] * inverse, slope_x)
    t1 = affine_row(rotation[1], rotation[2], focal[1] * inverse, slope_y)
    return inverse, (slope_x, slope_y), t0, t1


@inline
def axes_of(quat, log_scales):
    """Unit quaternion and its inverse norm, axis lengths, and the rows of the matrix M = R·diag(lengths)."""
    w, x, y, z = quat
    largest = simd.maximum(simd.maximum(simd.abs(w), simd.abs(x)), simd.maximum(simd.abs(y), simd.abs(z)))
    shrink = simd.where(largest > HUGE_QUATERNION, SHRINK, 1.0)
    w, x, y, z = w * shrink, x * shrink, y * shrink, z * shrink
    squared = simd.fma(w, w, simd.fma(x, x, simd.fma(y, y, z * z)))
    inverse = 1 / simd.sqrt(simd.maximum(squared, MIN_SQUARED_NORM))
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    s0 = exp2_clamped(log_scales[0] * LOG2_E)
    s1 = exp2_clamped(log_scales[1] * LOG2_E)
    s2 = exp2_clamped(log_scales[2] * LOG2_E)
    xx, yy, zz = simd.fma(y, y, z * z), simd.fma(x, x, z * z), simd.fma(x, x, y * y)
    m0 = simd.fma(-2.0, xx, 1.0) * s0, 2 * (x * y - w * z) * s1, 2 * (x * z + w * y) * s2
    m1 = 2 * (x * y + w * z) * s0, simd.fma(-2.0, yy, 1.0) * s1, 2 * (y * z - w * x) * s2
    m2 = 2 * (x * z - w * y) * s0, 2 * (y * z + w * x) * s1, simd.fma(-2.0, zz, 1.0) * s2
    return (w, x, y, z), inverse * shrink, (s0, s1, s2), (m0, m1, m2)


@inline
def image_axes(t, m):
    """One row of U = T·M: the splat's axes along one image axis."""
    return times(columns(m), t)


@inline
def pixel_range(centre, half, size):
    """First and last of ``size`` pixels whose centres are at most ``half`` from another; the last below 0 for none."""
    return simd.maximum(simd.ceil(centre - half - 0.5), 0.0), simd.minimum(simd.floor(centre + half - 0.5), size - 1)


@inline
def trained_distance(point, sampling):
    """The nearest distance of training to that of a splat, and that of the splat, both squared."""
    nearest, farthest, _ = sampling
    squared = dot3(point, point)
    nearest, farthest = nearest * nearest, farthest * farthest
    return simd.where(squared < nearest, nearest, simd.where(squared > farthest, farthest, squared)), squared


@inline
def sampling_ratio(point, sampling):
    """r²: pixels per unit of world at a splat, relative to training, squared."""
    _, _, size = sampling
    trained, now = trained_distance(point, sampling)
    return size * simd.minimum(trained / now, MAX_RATIO)


@inline
def blurred(area, size, unit, ratio):
    """Determinant, in ``unit``s, of a covariance of determinant ``area`` in them and trace ``size`` with blur·ratio."""
    return area + simd.fma(BLUR * ratio, size, BLUR_SQUARED * ratio * ratio) * unit * unit


@inline
def footprint(view, screen, point, quat, log_scales, logit, sampling):
    """Which splats can change the image, their records without the colour, their tiles and radii.

    ``screen`` are principal point, width and height in pixels, and the near plane. The blur that a splat was trained
    with is blur·r² here, see :func:`sampling_ratio`. Where that is less than a pixel's own, opacities are multiplied by
    √(det(Σ + blur·r²·I) / det(Σ + blur·I)), but for splats so large that the blur does not matter.
    """
    cx, cy, width, height, near = screen
    x, y, z = point
    inverse, _, t0, t1 = affine(view, point)
    _, _, _, m = axes_of(quat, log_scales)
    u, v = image_axes(t0, m), image_axes(t1, m)
    xx, yy, xy = dot3(u, u), dot3(v, v), dot3(u, v)
    # |u|²|v|² - (u·v)² = |u × v|² (Lagrange): no cancellation for large splats.
    size = xx + yy
    unit = simd.where(size > HUGE_FOOTPRINT, 1 / size, 1.0)
    n = scale3(unit, cross(u, v))
    area = dot3(n, n)
    if sampling is None:
        determinant = area + simd.fma(BLUR, size, BLUR_SQUARED) * unit * unit
        xx, yy = xx + BLUR, yy + BLUR
    else:
        ratio = sampling_ratio(point, sampling)
        added = simd.maximum(ratio, 1.0)
        determinant = blurred(area, size, unit, added)
        xx, yy = simd.fma(added, BLUR, xx), simd.fma(added, BLUR, yy)
    _, _, focal, _, _ = view
    px, py = simd.fma(focal[0], x * inverse, cx), simd.fma(focal[1], y * inverse, cy)
    log2_opacity = -simd.log2(1 + exp2_clamped(-(logit * LOG2_E)))
    if sampling is not None:
        kept = blurred(area, size, unit, ratio) / determinant
        light = 0.5 * simd.log2(simd.maximum(kept, MIN_LIGHT))
        log2_opacity = log2_opacity + simd.where((ratio < 1) & (size < HUGE_FOOTPRINT), light, 0.0)
    # α reaches 1/255 where u² + v² ≤ log2(255 o): a box of half sizes √(2 ln(255 o)·Σ_ii).
    reach = (log2_opacity - LOG2_ALPHA_MIN) * TWO_LN2
    within = simd.maximum(reach, 0.0)
    half_x, half_y = simd.sqrt(within * xx), simd.sqrt(within * yy)
    left, right = pixel_range(px, half_x, width)
    top, bottom = pixel_range(py, half_y, height)

    seen = (z > near) & (reach > 0) & (left <= right) & (top <= bottom)
    seen = seen & (size < LARGEST_FOOTPRINT) & (determinant < FINITE)
    seen = seen & (simd.abs(px) < FINITE) & (simd.abs(py) < FINITE) & (logit >= -FINITE)
    # exp2_clamped makes a broken scale finite; the raw one still shows that it is broken.
    seen = seen & (log_scales[0] + log_scales[1] + log_scales[2] < FINITE)

    slope_y = xy / yy
    a = FACTOR_SCALE * simd.sqrt(yy * unit / determinant * unit)
    record = (px, py, a, -(a * slope_y), FACTOR_SCALE / simd.sqrt(yy), log2_opacity, z, xy / xx, slope_y)
    first = simd.floor(left * PER_TILE), simd.floor(top * PER_TILE)
    last = simd.floor(right * PER_TILE), simd.floor(bottom * PER_TILE)
    return seen, record, first, last, simd.ceil(simd.maximum(half_x, half_y))


@inline
def unit_direction(position, mean):
    """Unit vector from the camera to the splat and the inverse distance."""
    d = mean[0] - position[0], mean[1] - position[1], mean[2] - position[2]
    inverse = 1 / simd.sqrt(simd.maximum(dot3(d, d), 1e-20))
    return scale3(inverse, d), inverse


@inline
def bands1(d):
    """Spherical harmonics of degree 1 at unit direction d; order and signs are those of ``rendering/sh.py``."""
    return -(C1 * d[1]), C1 * d[2], -(C1 * d[0])


@inline
def bands2(d):
    """Those of degree 2."""
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    return C2A * (x * y), -(C2A * (y * z)), C2B * (zz + zz - xx - yy), -(C2A * (x * z)), C2C * (xx - yy)


@inline
def bands3(d):
    """Those of degree 3."""
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    around = 4 * zz - xx - yy
    return (
        -(C3A * y * (3 * xx - yy)),
        C3B * (x * y) * z,
        -(C3C * y * around),
        C3D * z * (zz + zz - 3 * (xx + yy)),
        -(C3C * x * around),
        C3E * z * (xx - yy),
        -(C3A * x * (xx - 3 * yy)),
    )


@inline
def direction_gradient1(e):
    """dL/d(direction) from the gradients ``e`` of the three :func:`bands1`."""
    return -(C1 * e[2]), -(C1 * e[0]), C1 * e[1]


@inline
def direction_gradient2(before, d, e):
    """A gradient and that from the five :func:`bands2`."""
    gx, gy, gz = before
    x, y, z = d
    a, b, c = C2A, C2B, C2C
    gx = gx + a * (y * e[0] - z * e[3]) + 2 * x * (c * e[4] - b * e[2])
    gy = gy + a * (x * e[0] - z * e[1]) - 2 * y * (b * e[2] + c * e[4])
    gz = gz + 4 * b * z * e[2] - a * (y * e[1] + x * e[3])
    return gx, gy, gz


@inline
def direction_gradient3(before, d, e):
    """A gradient and that from the seven :func:`bands3`."""
    gx, gy, gz = before
    x, y, z = d
    e0, e1, e2, e3, e4, e5, e6 = e
    a, b, c, f, g = C3A, C3B, C3C, C3D, C3E
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    gx = gx - 6 * a * xy * e0 + b * yz * e1 + 2 * c * xy * e2 - 6 * f * xz * e3
    gx = gx - c * (4 * zz - 3 * xx - yy) * e4 + 2 * g * xz * e5 - 3 * a * (xx - yy) * e6
    gy = gy - 3 * a * (xx - yy) * e0 + b * xz * e1 - c * (4 * zz - xx - 3 * yy) * e2
    gy = gy - 6 * f * yz * e3 + 2 * c * xy * e4 - 2 * g * yz * e5 + 6 * a * xy * e6
    gz = gz + b * xy * e1 - 2 * 4 * c * (yz * e2 + xz * e4) + 3 * f * (2 * zz - xx - yy) * e3
    gz = gz + g * (xx - yy) * e5
    return gx, gy, gz


@inline
def mean_gradient(d, inverse, g):
    """dL/d(mean) through the direction d, from dL/dd."""
    return scale3(inverse, fma3(-dot3(g, d), d, g))


@inline
def clamped(rgb):
    """Colours of at least 0; NaN stays, so that the loss shows it."""
    return simd.where(rgb[0] < 0, 0.0, rgb[0]), simd.where(rgb[1] < 0, 0.0, rgb[1]), simd.where(rgb[2] < 0, 0.0, rgb[2])


@inline
def unclamped(rgb, g):
    """The gradient of colours before they were clamped."""
    return simd.where(rgb[0] > 0, g[0], 0.0), simd.where(rgb[1] > 0, g[1], 0.0), simd.where(rgb[2] > 0, g[2], 0.0)


@inline
def logit_gradient(logit, h):
    """dL/d(logit) from α·dL/dα."""
    return h * (1 / (1 + exp2_clamped(logit * LOG2_E)))


@inline
def quaternion_gradient(q, inverse, r):
    """dL/dq of an unnormalised quaternion from the rows of dL/dR."""
    w, x, y, z = q
    r0, r1, r2 = r
    gw = 2 * (x * (r2[1] - r1[2]) + y * (r0[2] - r2[0]) + z * (r1[0] - r0[1]))
    gx = 2 * (y * (r0[1] + r1[0]) + z * (r0[2] + r2[0]) + w * (r2[1] - r1[2]) - 2 * x * (r1[1] + r2[2]))
    gy = 2 * (x * (r0[1] + r1[0]) + z * (r1[2] + r2[1]) + w * (r0[2] - r2[0]) - 2 * y * (r0[0] + r2[2]))
    gz = 2 * (x * (r0[2] + r2[0]) + y * (r1[2] + r2[1]) + w * (r1[0] - r0[1]) - 2 * z * (r0[0] + r1[1]))
    radial = simd.fma(gw, w, dot3((gx, gy, gz), (x, y, z)))
    rest = scale3(inverse, fma3(-radial, (x, y, z), (gx, gy, gz)))
    return simd.fma(-radial, w, gw) * inverse, rest[0], rest[1], rest[2]


@inline
def axes_backward(view, point, local, axes, gu, gv, centre, g_depth):
    """Gradients of mean and quaternion from those of the rows ``gu``, ``gv`` of U = T·M.

    ``local`` is what :func:`affine` returns, ``axes`` what :func:`axes_of` does; ``centre`` is the gradient of the
    projected centre, ``g_depth`` that of the depth.
    """
    rotation, _, focal, _, _ = view
    x, y, _ = point
    inverse, slopes, t0, t1 = local
    slope_x, slope_y = slopes
    q, q_inverse, lengths, m = axes
    gm0 = fma3(t0[0], gu, scale3(t1[0], gv))
    gm1 = fma3(t0[1], gu, scale3(t1[1], gv))
    gm2 = fma3(t0[2], gu, scale3(t1[2], gv))
    g_rotation = times3(gm0, lengths), times3(gm1, lengths), times3(gm2, lengths)
    g_quat = quaternion_gradient(q, q_inverse, g_rotation)

    g0, g1 = times(m, gu), times(m, gv)
    # J = [[fx/z, 0, -fx·sx/z], [0, fy/z, -fy·sy/z]]; sx = x/z except where it is clamped.
    j00, _, j02 = times(rotation, g0)
    _, j11, j12 = times(rotation, g1)
    g2x, g2y = centre
    fx, fy = focal[0] * inverse, focal[1] * inverse
    fx_z, fy_z = fx * inverse, fy * inverse
    tx, ty = x * inverse, y * inverse
    free_x = simd.where((slope_x >= tx) & (slope_x <= tx), 1.0, 0.0)
    free_y = simd.where((slope_y >= ty) & (slope_y <= ty), 1.0, 0.0)
    vx = simd.fma(-(free_x * fx_z), j02, fx * g2x)
    vy = simd.fma(-(free_y * fy_z), j12, fy * g2y)
    vz = (1 + free_x) * fx_z * slope_x * j02 + (1 + free_y) * fy_z * slope_y * j12
    vz = vz - fx_z * (x * g2x + j00) - fy_z * (y * g2y + j11)
    return times(columns(rotation), (vx, vy, vz + g_depth)), g_quat


@inline
def light_gradient(u, v, ratio, h):
    """Gradients of the rows u and v of U and of r² < 1 through the factor of sampling, from that of its logarithm.

    With A = det Σ, S the sum of the variances, D(x) = A + x·S + x² and k = b·r², the factor is ρ = √(D(k)/D(b)), and
    d log ρ = ½·(1/D(k) − 1/D(b))·dA + ½·(k/D(k) − b/D(b))·dS + ½·(S + 2k)/D(k)·dk, where
    dA = 2·((v × n)·du + (n × u)·dv) with n = u × v, and dS = 2·(u·du + v·dv).
    """
    n = cross(u, v)
    area, size = dot3(n, n), dot3(u, u) + dot3(v, v)
    kept, whole = blurred(area, size, 1.0, ratio), blurred(area, size, 1.0, 1.0)
    # At the floor, within the sampling of training, and where the blur does not matter, the factor is constant.
    free = (size < HUGE_FOOTPRINT) & (kept > MIN_LIGHT * whole) & (ratio < 1)
    per_kept, lost = h / kept, BLUR * (1 - ratio)
    by_size = simd.where(free, lost * per_kept * (BLUR_SQUARED * ratio - area) / whole, 0.0)
    by_n = scale3(simd.where(free, lost * per_kept * (size + BLUR * (1 + ratio)) / whole, 0.0), n)
    by_ratio = simd.where(free, 0.5 * BLUR * per_kept * (size + 2 * BLUR * ratio), 0.0)
    return fma3(by_size, u, cross(v, by_n)), fma3(by_size, v, cross(by_n, u)), by_ratio


@inline
def geometry_backward(view, point, quat, log_scales, factor, moments, h, centre, g_depth, sampling):
    """Gradients of mean (without the colour's share), quaternion and log-scales.

    ``factor`` are A, B and C of the record, ``moments`` the sums of h·u², h·u·v and h·v², ``h`` the sum of h alone.
    """
    local, axes = affine(view, point), axes_of(quat, log_scales)
    _, _, t0, t1 = local
    _, _, _, m = axes
    u, v = image_axes(t0, m), image_axes(t1, m)

    # dL/dΣ = ½ Fᵀ S F with S = Σ h uuᵀ, so dL/dU = Fᵀ S (F U). The rows of F U are a·u + b·v and c·v; by Lagrange's
    # identity the first is a·(v × (u × v) + blur·u)/|v|², which stays accurate for needles.
    a, b, c = factor
    uu, uv, vv = scale3(MOMENT_SCALE, moments)
    if sampling is None:
        per_yy = 1 / (dot3(v, v) + BLUR)
        share = BLUR * per_yy
    else:
        ratio = sampling_ratio(point, sampling)
        blur = BLUR * simd.maximum(ratio, 1.0)
        per_yy = 1 / (dot3(v, v) + blur)
        share = blur * per_yy
    n = cross(v, scale3(per_yy, cross(u, v)))
    r, s = scale3(a, fma3(share, u, n)), scale3(c, v)
    e, f = fma3(uu, r, scale3(uv, s)), fma3(uv, r, scale3(vv, s))
    gu, gv = scale3(a, e), fma3(b, e, scale3(c, f))
    g_scale = simd.fma(r[0], e[0], s[0] * f[0]), simd.fma(r[1], e[1], s[1] * f[1]), simd.fma(r[2], e[2], s[2] * f[2])
    if sampling is not None:
        light_u, light_v, by_ratio = light_gradient(u, v, ratio, h)
        gu, gv = add3(gu, light_u), add3(gv, light_v)
        g_scale = add3(g_scale, add3(times3(light_u, u), times3(light_v, v)))
    g_mean, g_quat = axes_backward(view, point, local, axes, gu, gv, centre, g_depth)
    if sampling is not None:
        # Where r² > 1, the blur is b·r², and dL/db half the trace of Fᵀ S F.
        trace = simd.fma(uu, a * a, uu * (b * b)) + simd.fma(2 * uv, b * c, vv * (c * c))
        by_ratio = simd.where(ratio > 1, 0.5 * BLUR * trace, by_ratio)
        # Outside the distances of training, r² falls with the square of the distance.
        trained, now = trained_distance(point, sampling)
        moved = (trained < now) | (trained > now) & (trained < MAX_RATIO * now)  # x / x need not be 1 on a GPU
        per_distance = simd.where(moved, -2 * by_ratio * ratio / now, 0.0)
        rotation, _, _, _, _ = view
        g_mean = add3(g_mean, times(columns(rotation), scale3(per_distance, point)))
    return g_mean, g_quat, g_scale


@inline
def exponent(a, b, c, u0, v0, peak, x, y):
    """log2 α at (x, y), and the two factors u = A·x + B·y + u0 and v = C·y + v0 of the exponent."""
    u = simd.fma(a, x, simd.fma(b, y, u0))
    v = simd.fma(c, y, v0)
    return simd.fma(-u, u, simd.fma(-v, v, peak)), u, v


@inline
def alpha_of(power):
    """α before the cap, and α, 0 below 1/255, where log2 α before the cap is ``power``."""
    raw = simd.exp2(power)
    return raw, simd.where(power >= LOG2_ALPHA_MIN, simd.minimum(raw, ALPHA_MAX), 0.0)


@inline
def blend_step(power, t):
    """What a splat does to pixels with transmittance ``t`` where log2 α before the cap is ``power``.

    Returns α before the cap, α, 0 below 1/255, the transmittance after it, whether that leaves the pixel open, and the
    weight of the splat's colour.
    """
    raw, alpha = alpha_of(power)
    after = simd.fma(-alpha, t, t)
    is_open = after >= TRANSMITTANCE_MIN
    return raw, alpha, after, is_open, simd.where(is_open, alpha * t, 0.0)
