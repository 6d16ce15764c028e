"""Projection, spherical harmonics and their backward pass, 16 splats at a time.

Equations: EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl et al. 2023, sec. 4).
"""

from __future__ import annotations

import numpy as np
from numba import prange

from nsvq_lightning.compute.jit import F, inline, kernel
from nsvq_lightning.compute.lanes import (
    exp2_clamped,
    fma,
    fnma,
    gather_columns,
    gather_rows1,
    gather_rows3,
    gather_rows4,
    get,
    load,
    load_rows3,
    load_rows4,
    log2,
    lowest_bit,
    mask_bits,
    prefetch,
    put,
    scatter_rows1,
    scatter_rows3,
    scatter_rows4,
    select,
    splat,
    store,
    transpose,
    vceil,
    vfabs,
    vfloor,
    vmax,
    vmin,
    vsqrt,
)
from nsvq_lightning.compute.rows import clear
from nsvq_lightning.rendering import constants, sh
from nsvq_lightning.rendering.cpu.records import (
    BLUE,
    CX,
    CY,
    DEPTH,
    EXTENT,
    FACTOR_SCALE,
    FX,
    FY,
    GREEN,
    GROUP_SHIFT,
    HEIGHT,
    HIGH_X,
    HIGH_Y,
    LOG2_ALPHA_MIN,
    LOG2_E,
    LOW_X,
    LOW_Y,
    ORIGIN,
    POSITION,
    RADIUS,
    RECORD,
    RED,
    ROTATION,
    SLOT,
    SUM_BLUE,
    SUM_DEPTH,
    SUM_GREEN,
    SUM_H,
    SUM_RED,
    SUM_UU,
    SUM_UV,
    SUM_VV,
    TILE_SHIFT,
    TRANSLATION,
    WIDTH,
    A,
    B,
    C,
    X,
    Y,
)
from nsvq_lightning.splats import rotations

NEAR = F(constants.NEAR)
BLUR = F(constants.BLUR)
BLUR_SQUARED = F(constants.BLUR**2)
MIN_SQUARED_NORM = F(rotations.MIN_SQUARED_NORM)
FINITE = F(constants.FINITE)
HUGE_FOOTPRINT, LARGEST_FOOTPRINT = F(constants.HUGE_FOOTPRINT), F(constants.LARGEST_FOOTPRINT)
HUGE_QUATERNION, SHRINK = F(constants.HUGE_QUATERNION), F(constants.SHRINK)
LN2 = F(np.log(2.0))
COVARIANCE_SCALE = F(2 * np.log(2.0) ** 2)
"""From moments of the scaled factor to dL/dΣ: ½ / (½ log2 e)²."""

C0, C1 = F(sh.C0), F(sh.C1)
C2A, C2B, C2C = (F(value) for value in sh.C2)
C3A, C3B, C3C, C3D, C3E = (F(value) for value in sh.C3)

AHEAD = 32
"""How many splats ahead the rows of a list are asked for."""
SH_ROW = 45
"""Floats of a row of degree-3 coefficients, which is read by whole vectors."""


@inline
def dot3(ax, ay, az, bx, by, bz):
    """Dot product of two vectors."""
    return fma(ax, bx, fma(ay, by, az * bz))


@inline
def rotate(camera, row, x, y, z):
    """One row of the camera rotation times a vector."""
    o = ROTATION + 3 * row
    return fma(splat(get(camera, o)), x, fma(splat(get(camera, o + 1)), y, splat(get(camera, o + 2)) * z))


@inline
def rotate_back(camera, column, x, y, z):
    """One column of the camera rotation times a vector."""
    o = ROTATION + column
    return fma(splat(get(camera, o)), x, fma(splat(get(camera, o + 3)), y, splat(get(camera, o + 6)) * z))


@inline
def view_depth(camera, means):
    """View-space z of 16 means."""
    return rotate(camera, 2, means[0], means[1], means[2]) + splat(get(camera, TRANSLATION + 2))


@inline
def axes_of(quat, log_scales):
    """Unit quaternion and its inverse norm, axis lengths, and the matrix M = R·diag(lengths), row by row."""
    one, two = splat(F(1)), splat(F(2))
    w, x, y, z = quat
    largest = vmax(vmax(vfabs(w), vfabs(x)), vmax(vfabs(y), vfabs(z)))
    shrink = select(largest > splat(HUGE_QUATERNION), splat(SHRINK), one)
    w, x, y, z = w * shrink, x * shrink, y * shrink, z * shrink
    squared = fma(w, w, fma(x, x, fma(y, y, z * z)))
    inverse = one / vsqrt(vmax(squared, splat(MIN_SQUARED_NORM)))
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    s0 = exp2_clamped(log_scales[0] * splat(LOG2_E))
    s1 = exp2_clamped(log_scales[1] * splat(LOG2_E))
    s2 = exp2_clamped(log_scales[2] * splat(LOG2_E))
    m = (
        fnma(two, fma(y, y, z * z), one) * s0,
        two * (x * y - w * z) * s1,
        two * (x * z + w * y) * s2,
        two * (x * y + w * z) * s0,
        fnma(two, fma(x, x, z * z), one) * s1,
        two * (y * z - w * x) * s2,
        two * (x * z - w * y) * s0,
        two * (y * z + w * x) * s1,
        fnma(two, fma(x, x, y * y), one) * s2,
    )
    return (w, x, y, z), inverse * shrink, (s0, s1, s2), m


@inline
def affine(camera, means):
    """View-space point, 1/z, slopes limited to the frustum, and T = J·W, the two rows of the local affine map."""
    x = rotate(camera, 0, means[0], means[1], means[2]) + splat(get(camera, TRANSLATION))
    y = rotate(camera, 1, means[0], means[1], means[2]) + splat(get(camera, TRANSLATION + 1))
    z = view_depth(camera, means)
    inverse = splat(F(1)) / z
    slope_x = vmin(splat(get(camera, HIGH_X)), vmax(splat(get(camera, LOW_X)), x * inverse))
    slope_y = vmin(splat(get(camera, HIGH_Y)), vmax(splat(get(camera, LOW_Y)), y * inverse))
    fx, fy = splat(get(camera, FX)) * inverse, splat(get(camera, FY)) * inverse
    jx, jy = -(fx * slope_x), -(fy * slope_y)
    o = ROTATION
    t0 = (
        fma(fx, splat(get(camera, o)), jx * splat(get(camera, o + 6))),
        fma(fx, splat(get(camera, o + 1)), jx * splat(get(camera, o + 7))),
        fma(fx, splat(get(camera, o + 2)), jx * splat(get(camera, o + 8))),
    )
    t1 = (
        fma(fy, splat(get(camera, o + 3)), jy * splat(get(camera, o + 6))),
        fma(fy, splat(get(camera, o + 4)), jy * splat(get(camera, o + 7))),
        fma(fy, splat(get(camera, o + 5)), jy * splat(get(camera, o + 8))),
    )
    return (x, y, z), inverse, (slope_x, slope_y), t0, t1


@inline
def image_axes(t, m):
    """One row of U = T·M: the splat's axes along one image axis."""
    return (
        dot3(t[0], t[1], t[2], m[0], m[3], m[6]),
        dot3(t[0], t[1], t[2], m[1], m[4], m[7]),
        dot3(t[0], t[1], t[2], m[2], m[5], m[8]),
    )


@inline
def cross(u, v):
    """The vector product u × v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@inline
def footprint(camera, means, quats, scales, logits):
    """Everything of a record but the colour, the tile rectangle, and which of 16 splats can change the image."""
    zero, one, half = splat(F(0)), splat(F(1)), splat(F(0.5))
    (x, y, z), inverse, _, t0, t1 = affine(camera, means)
    _, _, _, m = axes_of(quats, scales)
    u, v = image_axes(t0, m), image_axes(t1, m)
    xx = dot3(u[0], u[1], u[2], u[0], u[1], u[2])
    yy = dot3(v[0], v[1], v[2], v[0], v[1], v[2])
    xy = dot3(u[0], u[1], u[2], v[0], v[1], v[2])
    # |u|²|v|² - (u·v)² = |u × v|² (Lagrange): no cancellation for large splats.
    n0, n1, n2 = cross(u, v)
    size = xx + yy
    unit = select(size > splat(HUGE_FOOTPRINT), one / size, one)
    n0, n1, n2 = n0 * unit, n1 * unit, n2 * unit
    determinant = dot3(n0, n1, n2, n0, n1, n2) + fma(splat(BLUR), size, splat(BLUR_SQUARED)) * unit * unit
    xx, yy = xx + splat(BLUR), yy + splat(BLUR)

    px = fma(splat(get(camera, FX)), x * inverse, splat(get(camera, CX)))
    py = fma(splat(get(camera, FY)), y * inverse, splat(get(camera, CY)))
    log2_opacity = -log2(one + exp2_clamped(-(logits * splat(LOG2_E))))
    # α reaches 1/255 where u² + v² ≤ log2(255 o): a box of half sizes √(2 ln(255 o)·Σ_ii).
    reach = (log2_opacity - splat(LOG2_ALPHA_MIN)) * splat(F(2) * LN2)
    half_x, half_y = vsqrt(vmax(reach, zero) * xx), vsqrt(vmax(reach, zero) * yy)
    left, right = vmax(vceil(px - half_x - half), zero), vfloor(px + half_x - half)
    top, bottom = vmax(vceil(py - half_y - half), zero), vfloor(py + half_y - half)
    right = vmin(right, splat(get(camera, WIDTH)) - one)
    bottom = vmin(bottom, splat(get(camera, HEIGHT)) - one)

    finite = splat(FINITE)
    seen = (z > splat(NEAR)) & (reach > zero) & (left <= right) & (top <= bottom)
    seen = (
        seen
        & (size < splat(LARGEST_FOOTPRINT))
        & (determinant < finite)
        & (vfabs(px) < finite)
        & (vfabs(py) < finite)
        & (logits >= -finite)
    )
    # exp2_clamped gives a broken scale a value again; the raw one still shows it.
    seen = seen & (scales[0] + scales[1] + scales[2] < finite)

    factor = splat(FACTOR_SCALE)
    slope_y = xy / yy
    a = factor * vsqrt(yy * unit / determinant * unit)
    record = (px, py, a, -(a * slope_y), factor / vsqrt(yy), log2_opacity, z, xy / xx, slope_y)
    tile = splat(F(1.0 / (1 << TILE_SHIFT)))
    tiles = (vfloor(left * tile), vfloor(top * tile), vfloor(right * tile), vfloor(bottom * tile))
    return seen, record, tiles, vceil(vmax(half_x, half_y))


@inline
def unit_direction(camera, means):
    """Unit vector from the camera to the splat and the inverse distance."""
    x = means[0] - splat(get(camera, POSITION))
    y = means[1] - splat(get(camera, POSITION + 1))
    z = means[2] - splat(get(camera, POSITION + 2))
    inverse = splat(F(1)) / vsqrt(vmax(dot3(x, y, z, x, y, z), splat(F(1e-20))))
    return (x * inverse, y * inverse, z * inverse), inverse


@inline
def prefetch_sh(array, ids, start, end, stride, used):
    """Ask for the SH rows of 16 splats of the list ahead of their turn, ``used`` floats of each."""
    if start < end:
        for lane in range(16):
            row = stride * np.int64(get(ids, start + lane))
            for k in range(0, used, 16):
                prefetch(array, row + k)


@inline
def coefficients_of(degree):
    """Floats in an SH row beyond the constant term."""
    return 3 * ((degree + 1) * (degree + 1) - 1)


@inline
def clear_bands(columns, degree, evaluated):
    """Zero the columns of the bands above ``degree``."""
    for k in range(coefficients_of(degree), coefficients_of(evaluated)):
        store(columns, 16 * k, splat(F(0)))


@inline
def gather_sh(shN, ids, start, stride, count, columns):
    """The first ``count`` coefficients of 16 rows, one vector a column, into the scratch array ``columns``."""
    if stride == SH_ROW:
        rows = gather_columns(shN, ids, start, stride, 0)
        for k in range(16):
            store(columns, 16 * k, rows[k])
        if count > 16:
            rows = gather_columns(shN, ids, start, stride, 16)
            for k in range(16):
                store(columns, 16 * (16 + k), rows[k])
            rows = gather_columns(shN, ids, start, stride, SH_ROW - 16)
            for k in range(16):
                store(columns, 16 * (SH_ROW - 16 + k), rows[k])
    else:
        for lane in range(16):
            row = np.int64(get(ids, start + lane)) * stride
            for k in range(count):
                put(columns, 16 * k + lane, get(shN, row + k))


@inline
def add_band(columns, k, basis, rgb):
    """Add coefficient k (counted without the constant one) times its basis value to a colour."""
    o = 48 * k
    return (
        fma(load(columns, o), basis, rgb[0]),
        fma(load(columns, o + 16), basis, rgb[1]),
        fma(load(columns, o + 32), basis, rgb[2]),
    )


@inline
def bands1(d):
    """Basis of degree 1 at unit direction d."""
    k = splat(C1)
    return -(k * d[1]), k * d[2], -(k * d[0])


@inline
def bands2(d):
    """Basis of degree 2."""
    x, y, z = d
    a = splat(C2A)
    xx, yy, zz = x * x, y * y, z * z
    return a * (x * y), -(a * (y * z)), splat(C2B) * (zz + zz - xx - yy), -(a * (x * z)), splat(C2C) * (xx - yy)


@inline
def bands3(d):
    """Basis of degree 3."""
    x, y, z = d
    three, four = splat(F(3)), splat(F(4))
    xx, yy, zz = x * x, y * y, z * z
    a, c = splat(C3A), splat(C3C)
    around = four * zz - xx - yy
    return (
        -(a * y * (three * xx - yy)),
        splat(C3B) * (x * y) * z,
        -(c * y * around),
        splat(C3D) * z * (zz + zz - three * (xx + yy)),
        -(c * x * around),
        splat(C3E) * z * (xx - yy),
        -(a * x * (xx - three * yy)),
    )


@inline
def color(degree, d, sh0, columns):
    """0.5 + Σ coefficient·basis for 16 splats, before the clamp at 0."""
    half, k = splat(F(0.5)), splat(C0)
    rgb = fma(sh0[0], k, half), fma(sh0[1], k, half), fma(sh0[2], k, half)
    if degree > 0:
        b1 = bands1(d)
        for i in range(3):
            rgb = add_band(columns, i, b1[i], rgb)
    if degree > 1:
        b2 = bands2(d)
        for i in range(5):
            rgb = add_band(columns, 3 + i, b2[i], rgb)
    if degree > 2:
        b3 = bands3(d)
        for i in range(7):
            rgb = add_band(columns, 8 + i, b3[i], rgb)
    return rgb


@inline
def load_means(means, start, count, scratch):
    """16 means; the last, incomplete vector is read from a padded copy."""
    if count < 16:
        for k in range(3 * count):
            put(scratch, k, get(means, 3 * start + k))
        return load_rows3(scratch, 0)
    return load_rows3(means, 3 * start)


@inline
def load_shapes(quats, scales, logits, start, count, scratch):
    """16 quaternions, log scales and opacity logits, an incomplete vector as in :func:`load_means`."""
    if count < 16:
        for k in range(4 * count):
            put(scratch, k, get(quats, 4 * start + k))
        quat = load_rows4(scratch, 0)
        for k in range(3 * count):
            put(scratch, k, get(scales, 3 * start + k))
        scale = load_rows3(scratch, 0)
        for k in range(count):
            put(scratch, k, get(logits, start + k))
        return quat, scale, load(scratch, 0)
    return load_rows4(quats, 4 * start), load_rows3(scales, 3 * start), load(logits, start)


@inline
def project_range(camera, means, quats, scales, logits, first, last, records, integers, ids, scratch):
    """Records of the visible splats of a range; returns how many there are and how many slots they need."""
    zero = splat(F(0))
    visible = 0
    slots = 0
    for start in range(first, last, 16):
        count = min(16, last - start)
        mean = load_means(means, start, count, scratch)
        lanes = (1 << count) - 1
        if mask_bits(view_depth(camera, mean) > splat(NEAR)) & lanes == 0:
            continue
        quat, scale, logit = load_shapes(quats, scales, logits, start, count, scratch)
        seen, record, tiles, radius = footprint(camera, mean, quat, scale, logit)
        bits = mask_bits(seen) & lanes
        if bits == 0:
            continue
        x, y, a, b, c, opacity, depth, slope_x, slope_y = record
        rows = transpose((x, y, a, b, c, opacity, zero, zero, zero, depth, slope_x, slope_y, zero, zero, zero, zero))
        for lane in range(16):
            store(scratch, 128 + 16 * lane, rows[lane])
        for k in range(4):
            store(scratch, 16 * k, tiles[k])
        store(scratch, 64, radius)
        while bits != 0:
            lane = lowest_bit(bits)
            bits &= bits - 1
            row = start + lane
            store(records, RECORD * row, load(scratch, 128 + 16 * lane))
            x0, y0 = np.int64(get(scratch, lane)), np.int64(get(scratch, 16 + lane))
            x1, y1 = np.int64(get(scratch, 32 + lane)), np.int64(get(scratch, 48 + lane))
            put(integers, RECORD * row + SLOT, slots)
            put(integers, RECORD * row + ORIGIN, x0 | (y0 << 16))
            put(integers, RECORD * row + EXTENT, (x1 - x0 + 1) | ((y1 - y0 + 1) << 16))
            put(integers, RECORD * row + RADIUS, np.int64(min(get(scratch, 64 + lane), F(1e9))))
            slots += ((x1 >> GROUP_SHIFT) - (x0 >> GROUP_SHIFT) + 1) * ((y1 >> GROUP_SHIFT) - (y0 >> GROUP_SHIFT) + 1)
            put(ids, first + visible, row)
            visible += 1
    return visible, slots


@inline
def color_range(camera, means, sh0, shN, stride, degree, evaluated, ids, first, last, records, scratch):
    """Colours into the records of ``ids[first:last]``; the list is padded to whole vectors."""
    zero = splat(F(0))
    coefficients = coefficients_of(evaluated)
    for start in range(first, last, 16):
        prefetch_sh(shN, ids, start + AHEAD, last, stride, coefficients)
        mean = gather_rows3(means, ids, start)
        direction, _ = unit_direction(camera, mean)
        if evaluated > 0:
            gather_sh(shN, ids, start, stride, coefficients, scratch)
            clear_bands(scratch, degree, evaluated)
        r, g, b = color(evaluated, direction, gather_rows3(sh0, ids, start), scratch)
        # In this order NaN stays: the loss must show it.
        store(scratch, 0, vmax(zero, r))
        store(scratch, 16, vmax(zero, g))
        store(scratch, 32, vmax(zero, b))
        for lane in range(min(16, last - start)):
            o = RECORD * np.int64(get(ids, start + lane)) + RED
            put(records, o, get(scratch, lane))
            put(records, o + 1, get(scratch, 16 + lane))
            put(records, o + 2, get(scratch, 32 + lane))


@inline
def vector_range(count, thread, threads):
    """First and end of a thread's share of ``count`` splats: whole vectors, but for the last of all."""
    vectors = (count + 15) // 16
    return 16 * (vectors * thread // threads), min(count, 16 * (vectors * (thread + 1) // threads))


@kernel
def project_splats(threads, camera, means, quats, scales, logits, records, integers, found, counts, slots, scratch):
    """Project all splats: records of the visible ones; ``found`` holds a run of rows for each thread's range."""
    for thread in prange(threads):
        first, last = vector_range(logits.shape[0], thread, threads)
        counts[thread], slots[thread] = project_range(
            camera, means, quats, scales, logits, first, last, records, integers, found, scratch[thread]
        )


@kernel
def find_visible(threads, camera, means, quats, scales, logits, found, runs, scratch):
    """Only the rows of the visible splats; thread t leaves them in ``found`` from ``runs[t, 0]`` to ``runs[t, 1]``."""
    for thread in prange(threads):
        first, last = vector_range(logits.shape[0], thread, threads)
        at = first
        for start in range(first, last, 16):
            count = min(16, last - start)
            mean = load_means(means, start, count, scratch[thread])
            bits = mask_bits(view_depth(camera, mean) > splat(NEAR)) & ((1 << count) - 1)
            if bits == 0:
                continue
            quat, scale, logit = load_shapes(quats, scales, logits, start, count, scratch[thread])
            seen, _, _, _ = footprint(camera, mean, quat, scale, logit)
            bits &= mask_bits(seen)
            while bits != 0:
                put(found, at, start + lowest_bit(bits))
                bits &= bits - 1
                at += 1
        runs[thread, 0], runs[thread, 1] = first, at


@kernel
def finish_records(
    threads,
    camera,
    means,
    sh0,
    shN,
    stride,
    degree,
    evaluated,
    found,
    counts,
    slots,
    records,
    integers,
    ids,
    keys,
    order,
    boxes,
    means2d,
    radii,
    scratch,
):
    """Join the runs of all threads to ``ids`` (ascending rows, padded by 16), number the slots and add the colours.

    Also writes, by place in ``ids``, the depths as ``keys``, the places themselves as ``order`` and the tiles that a
    splat touches as ``boxes`` (first column and row, columns and rows, 16 bits each), and the projected centres
    ``means2d [N·2]`` and ``radii [N]`` of the visible splats.
    """
    total = counts.sum()
    for thread in prange(threads):
        first, _ = vector_range(records.shape[0] // RECORD, thread, threads)
        start, slot = counts[:thread].sum(), slots[:thread].sum()
        for k in range(counts[thread]):
            row = np.int64(get(found, first + k))
            put(ids, start + k, row)
            put(integers, RECORD * row + SLOT, np.int64(get(integers, RECORD * row + SLOT)) + slot)
            # Depths are positive, so their bits sort as integers.
            put(keys, start + k, get(integers, RECORD * row + DEPTH))
            put(order, start + k, start + k)
            extent = np.int64(get(integers, RECORD * row + EXTENT))
            put(boxes, start + k, np.int64(get(integers, RECORD * row + ORIGIN)) | (extent << 32))
            put(means2d, 2 * row, get(records, RECORD * row + X))
            put(means2d, 2 * row + 1, get(records, RECORD * row + Y))
            put(radii, row, get(integers, RECORD * row + RADIUS))
        if start + counts[thread] == total and counts[thread] > 0:
            for k in range(16):
                put(ids, total + k, get(ids, total - 1))
    for thread in prange(threads):
        first, last = vector_range(total, thread, threads)
        color_range(camera, means, sh0, shN, stride, degree, evaluated, ids, first, last, records, scratch[thread])


@inline
def quaternion_gradient(q, inverse, r):
    """dL/dq of an unnormalised quaternion from dL/dR (row by row)."""
    two = splat(F(2))
    w, x, y, z = q
    gw = two * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]))
    gx = two * (y * (r[1] + r[3]) + z * (r[2] + r[6]) + w * (r[7] - r[5]) - two * x * (r[4] + r[8]))
    gy = two * (x * (r[1] + r[3]) + z * (r[5] + r[7]) + w * (r[2] - r[6]) - two * y * (r[0] + r[8]))
    gz = two * (x * (r[2] + r[6]) + y * (r[5] + r[7]) + w * (r[3] - r[1]) - two * z * (r[0] + r[4]))
    radial = fma(gw, w, dot3(gx, gy, gz, x, y, z))
    return (
        fnma(radial, w, gw) * inverse,
        fnma(radial, x, gx) * inverse,
        fnma(radial, y, gy) * inverse,
        fnma(radial, z, gz) * inverse,
    )


@inline
def direction_gradient(degree, d, e):
    """dL/d(direction) from the scratch vectors ``e[16·k]`` = Σ_channel coefficient·gradient of each band."""
    x, y, z = d
    zero, two, three, four, six = splat(F(0)), splat(F(2)), splat(F(3)), splat(F(4)), splat(F(6))
    gx, gy, gz = zero, zero, zero
    if degree > 0:
        k = splat(C1)
        gx, gy, gz = -(k * load(e, 32)), -(k * load(e, 0)), k * load(e, 16)
    if degree > 1:
        a, b, c = splat(C2A), splat(C2B), splat(C2C)
        e0, e1, e2, e3, e4 = load(e, 48), load(e, 64), load(e, 80), load(e, 96), load(e, 112)
        gx = gx + a * (y * e0 - z * e3) + two * x * (c * e4 - b * e2)
        gy = gy + a * (x * e0 - z * e1) - two * y * (b * e2 + c * e4)
        gz = gz + four * b * z * e2 - a * (y * e1 + x * e3)
    if degree > 2:
        a, b, c, f, g = splat(C3A), splat(C3B), splat(C3C), splat(C3D), splat(C3E)
        e0, e1, e2, e3 = load(e, 128), load(e, 144), load(e, 160), load(e, 176)
        e4, e5, e6 = load(e, 192), load(e, 208), load(e, 224)
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        gx = gx - six * a * xy * e0 + b * yz * e1 + two * c * xy * e2 - six * f * xz * e3
        gx = gx - c * (four * zz - three * xx - yy) * e4 + two * g * xz * e5 - three * a * (xx - yy) * e6
        gy = gy - three * a * (xx - yy) * e0 + b * xz * e1 - c * (four * zz - xx - three * yy) * e2
        gy = gy - six * f * yz * e3 + two * c * xy * e4 - two * g * yz * e5 + six * a * xy * e6
        gz = gz + b * xy * e1 - two * four * c * (yz * e2 + xz * e4) + three * f * (two * zz - xx - yy) * e3
        gz = gz + g * (xx - yy) * e5
    return gx, gy, gz


@inline
def put_band(gradient, e, columns, k, basis, rgb):
    """Gradient columns of coefficient k, and its share of the direction gradient."""
    o = 48 * k
    total = load(columns, o) * rgb[0]
    total = fma(load(columns, o + 16), rgb[1], total)
    store(e, 16 * k, fma(load(columns, o + 32), rgb[2], total))
    for channel in range(3):
        store(gradient, o + 16 * channel, basis * rgb[channel])


@inline
def clear_rows(first, last, stride, g_means, g_quats, g_scales, g_logits, g_sh0, g_shN):
    """Zero the gradients of rows that are not in view."""
    clear(g_means, 3 * first, 3 * last)
    clear(g_quats, 4 * first, 4 * last)
    clear(g_scales, 3 * first, 3 * last)
    clear(g_logits, first, last)
    clear(g_sh0, 3 * first, 3 * last)
    clear(g_shN, stride * first, stride * last)


@inline
def scatter_sh(gradient, columns, ids, start, stride, count):
    """Write 16 rows of SH gradients from the scratch columns; the inverse of :func:`gather_sh`."""
    if stride == SH_ROW and count == SH_ROW:
        for first in (0, 16, SH_ROW - 16):
            o = 16 * first
            rows = transpose((
                load(columns, o), load(columns, o + 16), load(columns, o + 32), load(columns, o + 48),
                load(columns, o + 64), load(columns, o + 80), load(columns, o + 96), load(columns, o + 112),
                load(columns, o + 128), load(columns, o + 144), load(columns, o + 160), load(columns, o + 176),
                load(columns, o + 192), load(columns, o + 208), load(columns, o + 224), load(columns, o + 240),
            ))  # fmt: skip
            for lane in range(16):
                store(gradient, np.int64(get(ids, start + lane)) * stride + first, rows[lane])
    else:
        for lane in range(16):
            row = np.int64(get(ids, start + lane)) * stride
            for k in range(count):
                put(gradient, row + k, get(columns, 16 * k + lane))
            clear(gradient, row + count, row + stride)


@inline
def color_backward(camera, degree, evaluated, stride, mean, shN, ids, start, rgb, g_sh0, g_shN, scratch):
    """Gradients of the SH coefficients; returns that of the mean through the viewing direction."""
    zero = splat(F(0))
    d, inverse = unit_direction(camera, mean)
    coefficients = coefficients_of(evaluated)
    columns, gradient, e = scratch[:768], scratch[768:1536], scratch[1536:]
    if evaluated > 0:
        gather_sh(shN, ids, start, stride, coefficients, columns)
        clear_bands(columns, degree, evaluated)
    k = splat(C0)
    scatter_rows3(g_sh0, ids, start, (k * rgb[0], k * rgb[1], k * rgb[2]))
    if evaluated == 0:
        scatter_sh(g_shN, gradient, ids, start, stride, 0)
        return zero, zero, zero
    b1 = bands1(d)
    for i in range(3):
        put_band(gradient, e, columns, i, b1[i], rgb)
    if evaluated > 1:
        b2 = bands2(d)
        for i in range(5):
            put_band(gradient, e, columns, 3 + i, b2[i], rgb)
    if evaluated > 2:
        b3 = bands3(d)
        for i in range(7):
            put_band(gradient, e, columns, 8 + i, b3[i], rgb)
    clear_bands(gradient, degree, evaluated)
    scatter_sh(g_shN, gradient, ids, start, stride, coefficients)
    gx, gy, gz = direction_gradient(evaluated, d, e)
    radial = dot3(gx, gy, gz, d[0], d[1], d[2])
    return fnma(radial, d[0], gx) * inverse, fnma(radial, d[1], gy) * inverse, fnma(radial, d[2], gz) * inverse


@inline
def geometry_backward(camera, mean, quat, scale, record, total, g2x, g2y):
    """Gradients of mean (without the colour's share), quaternion and log-scales of 16 splats.

    ``total`` are the 16 sums of a slot, ``g2x``, ``g2y`` the gradient of the projected centre.
    """
    two = splat(F(2))
    (x, y, _), inverse, (slope_x, slope_y), t0, t1 = affine(camera, mean)
    q, q_inverse, lengths, m = axes_of(quat, scale)
    u, v = image_axes(t0, m), image_axes(t1, m)

    # dL/dΣ = ½ Fᵀ S F with S = Σ h uuᵀ, so dL/dU = Fᵀ S (F U). The rows of F U are a·u + b·v and c·v; by Lagrange's
    # identity the first is a·(v × (u × v) + blur·u)/|v|², which keeps its digits on needles.
    a, b, c = record[A], record[B], record[C]
    k = two * splat(COVARIANCE_SCALE)
    uu, uv, vv = k * total[SUM_UU], k * total[SUM_UV], k * total[SUM_VV]
    per_yy = splat(F(1)) / (dot3(v[0], v[1], v[2], v[0], v[1], v[2]) + splat(BLUR))
    n = cross(u, v)
    n = cross(v, (n[0] * per_yy, n[1] * per_yy, n[2] * per_yy))
    blur = splat(BLUR) * per_yy
    r = a * fma(blur, u[0], n[0]), a * fma(blur, u[1], n[1]), a * fma(blur, u[2], n[2])
    s = c * v[0], c * v[1], c * v[2]
    e = fma(uu, r[0], uv * s[0]), fma(uu, r[1], uv * s[1]), fma(uu, r[2], uv * s[2])
    f = fma(uv, r[0], vv * s[0]), fma(uv, r[1], vv * s[1]), fma(uv, r[2], vv * s[2])
    gu = a * e[0], a * e[1], a * e[2]
    gv = fma(b, e[0], c * f[0]), fma(b, e[1], c * f[1]), fma(b, e[2], c * f[2])
    g_scale = fma(r[0], e[0], s[0] * f[0]), fma(r[1], e[1], s[1] * f[1]), fma(r[2], e[2], s[2] * f[2])

    gm = (
        fma(t0[0], gu[0], t1[0] * gv[0]), fma(t0[0], gu[1], t1[0] * gv[1]), fma(t0[0], gu[2], t1[0] * gv[2]),
        fma(t0[1], gu[0], t1[1] * gv[0]), fma(t0[1], gu[1], t1[1] * gv[1]), fma(t0[1], gu[2], t1[1] * gv[2]),
        fma(t0[2], gu[0], t1[2] * gv[0]), fma(t0[2], gu[1], t1[2] * gv[1]), fma(t0[2], gu[2], t1[2] * gv[2]),
    )  # fmt: skip
    g_rotation = (
        gm[0] * lengths[0], gm[1] * lengths[1], gm[2] * lengths[2],
        gm[3] * lengths[0], gm[4] * lengths[1], gm[5] * lengths[2],
        gm[6] * lengths[0], gm[7] * lengths[1], gm[8] * lengths[2],
    )  # fmt: skip
    g_quat = quaternion_gradient(q, q_inverse, g_rotation)

    g0 = (
        dot3(gu[0], gu[1], gu[2], m[0], m[1], m[2]),
        dot3(gu[0], gu[1], gu[2], m[3], m[4], m[5]),
        dot3(gu[0], gu[1], gu[2], m[6], m[7], m[8]),
    )
    g1 = (
        dot3(gv[0], gv[1], gv[2], m[0], m[1], m[2]),
        dot3(gv[0], gv[1], gv[2], m[3], m[4], m[5]),
        dot3(gv[0], gv[1], gv[2], m[6], m[7], m[8]),
    )
    # J = [[fx/z, 0, -fx·sx/z], [0, fy/z, -fy·sy/z]]; sx = x/z except where it is clamped.
    j00, j02 = rotate(camera, 0, g0[0], g0[1], g0[2]), rotate(camera, 2, g0[0], g0[1], g0[2])
    j11, j12 = rotate(camera, 1, g1[0], g1[1], g1[2]), rotate(camera, 2, g1[0], g1[1], g1[2])
    fx, fy = splat(get(camera, FX)) * inverse, splat(get(camera, FY)) * inverse
    fx_z, fy_z = fx * inverse, fy * inverse
    one, zero = splat(F(1)), splat(F(0))
    tx, ty = x * inverse, y * inverse
    free_x = select((slope_x >= tx) & (slope_x <= tx), one, zero)
    free_y = select((slope_y >= ty) & (slope_y <= ty), one, zero)
    vx = fnma(free_x * fx_z, j02, fx * g2x)
    vy = fnma(free_y * fy_z, j12, fy * g2y)
    vz = (one + free_x) * fx_z * slope_x * j02 + (one + free_y) * fy_z * slope_y * j12
    vz = vz - fx_z * (x * g2x + j00) - fy_z * (y * g2y + j11)
    vz = vz + total[SUM_DEPTH]
    g_mean = (
        rotate_back(camera, 0, vx, vy, vz),
        rotate_back(camera, 1, vx, vy, vz),
        rotate_back(camera, 2, vx, vy, vz),
    )
    return g_mean, g_quat, g_scale


@kernel
def project_backward(
    threads,
    camera,
    means,
    quats,
    scales,
    logits,
    sh0,
    shN,
    stride,
    degree,
    evaluated,
    ids,
    count,
    records,
    integers,
    sums,
    g_means2d,
    g_means,
    g_quats,
    g_scales,
    g_logits,
    g_sh0,
    g_shN,
    scratch,
):
    """Gradients of all raw attributes from the sums of the slots of the visible splats; 0 for the others.

    ``sums[16·slot]`` of a splat's first slot holds its total; ``g_means2d [N·2]`` the gradient of its projected centre.
    """
    coefficients = coefficients_of(evaluated)
    for thread in prange(threads):
        work = scratch[thread]
        slot = work[2048:].view(np.int32)
        # Between its first and last visible splat every thread clears the rows that it passes by.
        begin, end = vector_range(count, thread, threads)
        row = np.int64(get(ids, begin - 1)) + 1 if begin > 0 else 0
        for i in range(begin, end):
            here = np.int64(get(ids, i))
            if here > row:
                clear_rows(row, here, stride, g_means, g_quats, g_scales, g_logits, g_sh0, g_shN)
            row = here + 1
        if thread == threads - 1:
            clear_rows(row, logits.shape[0], stride, g_means, g_quats, g_scales, g_logits, g_sh0, g_shN)
        for start in range(begin, end, 16):
            prefetch_sh(shN, ids, start + AHEAD, end, stride, coefficients)
            prefetch_sh(g_shN, ids, start + AHEAD, end, stride, stride)
            if start + AHEAD < end:
                for lane in range(16):
                    row = RECORD * np.int64(get(ids, start + AHEAD + lane))
                    prefetch(sums, RECORD * np.int64(get(integers, row + SLOT)))
            for lane in range(16):
                row = np.int64(get(ids, start + lane))
                put(slot, lane, get(integers, RECORD * row + SLOT))
                put(work, lane, get(g_means2d, 2 * row))
                put(work, 16 + lane, get(g_means2d, 2 * row + 1))
            g2x, g2y = load(work, 0), load(work, 16)
            total = gather_columns(sums, slot, 0, RECORD, 0)
            record = gather_columns(records, ids, start, RECORD, 0)
            mean = gather_rows3(means, ids, start)
            quat, scale = gather_rows4(quats, ids, start), gather_rows3(scales, ids, start)
            g_mean, g_quat, g_scale = geometry_backward(camera, mean, quat, scale, record, total, g2x, g2y)
            zero = splat(F(0))
            # A colour below 0 was cut off.
            rgb = (
                select(record[RED] > zero, total[SUM_RED], zero),
                select(record[GREEN] > zero, total[SUM_GREEN], zero),
                select(record[BLUE] > zero, total[SUM_BLUE], zero),
            )
            gx, gy, gz = color_backward(
                camera, degree, evaluated, stride, mean, shN, ids, start, rgb, g_sh0, g_shN, work
            )
            scatter_rows3(g_means, ids, start, (g_mean[0] + gx, g_mean[1] + gy, g_mean[2] + gz))
            scatter_rows4(g_quats, ids, start, g_quat)
            scatter_rows3(g_scales, ids, start, g_scale)
            logit = gather_rows1(logits, ids, start)
            one = splat(F(1))
            transparent = one / (one + exp2_clamped(logit * splat(LOG2_E)))
            scatter_rows1(g_logits, ids, start, total[SUM_H] * transparent)
