"""Projection of splats onto the image plane, 16 at a time.

Equations: EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl et al. 2023, sec. 4).
"""

from __future__ import annotations

import numpy as np
from numba import prange

from nsvq_lightning.compute.jit import F, inline, kernel
from nsvq_lightning.compute.simd import (
    broadcast,
    exp2_clamped,
    fma,
    fnma,
    get,
    load,
    load_rows3,
    load_rows4,
    log2,
    lowest_bit,
    mask_bits,
    put,
    select,
    store,
    transpose,
    vceil,
    vfabs,
    vfloor,
    vmax,
    vmin,
    vsqrt,
)
from nsvq_lightning.rendering import constants
from nsvq_lightning.rendering.cpu.harmonics import color_range
from nsvq_lightning.rendering.cpu.records import (
    CX,
    CY,
    DEPTH,
    EXTENT,
    FACTOR_SCALE,
    FX,
    FY,
    GROUP_SHIFT,
    HEIGHT,
    HIGH_X,
    HIGH_Y,
    LOG2_ALPHA_MIN,
    LOG2_E,
    LOW_X,
    LOW_Y,
    ORIGIN,
    RADIUS,
    RECORD,
    ROTATION,
    SLOT,
    TILE_SHIFT,
    TRANSLATION,
    WIDTH,
    X,
    Y,
    cross,
    dot3,
    rotate,
    vector_range,
)
from nsvq_lightning.splats import conventions

NEAR = F(constants.NEAR)
BLUR = F(constants.BLUR)
BLUR_SQUARED = F(constants.BLUR**2)
MIN_SQUARED_NORM = F(conventions.MIN_SQUARED_NORM)
FINITE = F(constants.FINITE)
HUGE_FOOTPRINT, LARGEST_FOOTPRINT = F(constants.HUGE_FOOTPRINT), F(constants.LARGEST_FOOTPRINT)
HUGE_QUATERNION, SHRINK = F(constants.HUGE_QUATERNION), F(constants.SHRINK)
LN2 = F(np.log(2.0))


@inline
def view_depth(camera, means):
    """View-space z of 16 means."""
    return rotate(camera, 2, means[0], means[1], means[2]) + broadcast(get(camera, TRANSLATION + 2))


@inline
def axes_of(quat, log_scales):
    """Unit quaternion and its inverse norm, axis lengths, and the matrix M = R·diag(lengths), row by row."""
    one, two = broadcast(F(1)), broadcast(F(2))
    w, x, y, z = quat
    largest = vmax(vmax(vfabs(w), vfabs(x)), vmax(vfabs(y), vfabs(z)))
    shrink = select(largest > broadcast(HUGE_QUATERNION), broadcast(SHRINK), one)
    w, x, y, z = w * shrink, x * shrink, y * shrink, z * shrink
    squared = fma(w, w, fma(x, x, fma(y, y, z * z)))
    inverse = one / vsqrt(vmax(squared, broadcast(MIN_SQUARED_NORM)))
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    s0 = exp2_clamped(log_scales[0] * broadcast(LOG2_E))
    s1 = exp2_clamped(log_scales[1] * broadcast(LOG2_E))
    s2 = exp2_clamped(log_scales[2] * broadcast(LOG2_E))
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
    x = rotate(camera, 0, means[0], means[1], means[2]) + broadcast(get(camera, TRANSLATION))
    y = rotate(camera, 1, means[0], means[1], means[2]) + broadcast(get(camera, TRANSLATION + 1))
    z = view_depth(camera, means)
    inverse = broadcast(F(1)) / z
    slope_x = vmin(broadcast(get(camera, HIGH_X)), vmax(broadcast(get(camera, LOW_X)), x * inverse))
    slope_y = vmin(broadcast(get(camera, HIGH_Y)), vmax(broadcast(get(camera, LOW_Y)), y * inverse))
    fx, fy = broadcast(get(camera, FX)) * inverse, broadcast(get(camera, FY)) * inverse
    jx, jy = -(fx * slope_x), -(fy * slope_y)
    o = ROTATION
    t0 = (
        fma(fx, broadcast(get(camera, o)), jx * broadcast(get(camera, o + 6))),
        fma(fx, broadcast(get(camera, o + 1)), jx * broadcast(get(camera, o + 7))),
        fma(fx, broadcast(get(camera, o + 2)), jx * broadcast(get(camera, o + 8))),
    )
    t1 = (
        fma(fy, broadcast(get(camera, o + 3)), jy * broadcast(get(camera, o + 6))),
        fma(fy, broadcast(get(camera, o + 4)), jy * broadcast(get(camera, o + 7))),
        fma(fy, broadcast(get(camera, o + 5)), jy * broadcast(get(camera, o + 8))),
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
def footprint(camera, means, quats, scales, logits):
    """All of a record except the colour, the tile rectangle, and which of 16 splats can change the image."""
    zero, one, half = broadcast(F(0)), broadcast(F(1)), broadcast(F(0.5))
    (x, y, z), inverse, _, t0, t1 = affine(camera, means)
    _, _, _, m = axes_of(quats, scales)
    u, v = image_axes(t0, m), image_axes(t1, m)
    xx = dot3(u[0], u[1], u[2], u[0], u[1], u[2])
    yy = dot3(v[0], v[1], v[2], v[0], v[1], v[2])
    xy = dot3(u[0], u[1], u[2], v[0], v[1], v[2])
    # |u|²|v|² - (u·v)² = |u × v|² (Lagrange): no cancellation for large splats.
    n0, n1, n2 = cross(u, v)
    size = xx + yy
    unit = select(size > broadcast(HUGE_FOOTPRINT), one / size, one)
    n0, n1, n2 = n0 * unit, n1 * unit, n2 * unit
    determinant = dot3(n0, n1, n2, n0, n1, n2) + fma(broadcast(BLUR), size, broadcast(BLUR_SQUARED)) * unit * unit
    xx, yy = xx + broadcast(BLUR), yy + broadcast(BLUR)

    px = fma(broadcast(get(camera, FX)), x * inverse, broadcast(get(camera, CX)))
    py = fma(broadcast(get(camera, FY)), y * inverse, broadcast(get(camera, CY)))
    log2_opacity = -log2(one + exp2_clamped(-(logits * broadcast(LOG2_E))))
    # α reaches 1/255 where u² + v² ≤ log2(255 o): a box of half sizes √(2 ln(255 o)·Σ_ii).
    reach = (log2_opacity - broadcast(LOG2_ALPHA_MIN)) * broadcast(F(2) * LN2)
    half_x, half_y = vsqrt(vmax(reach, zero) * xx), vsqrt(vmax(reach, zero) * yy)
    left, right = vmax(vceil(px - half_x - half), zero), vfloor(px + half_x - half)
    top, bottom = vmax(vceil(py - half_y - half), zero), vfloor(py + half_y - half)
    right = vmin(right, broadcast(get(camera, WIDTH)) - one)
    bottom = vmin(bottom, broadcast(get(camera, HEIGHT)) - one)

    finite = broadcast(FINITE)
    seen = (z > broadcast(NEAR)) & (reach > zero) & (left <= right) & (top <= bottom)
    seen = (
        seen
        & (size < broadcast(LARGEST_FOOTPRINT))
        & (determinant < finite)
        & (vfabs(px) < finite)
        & (vfabs(py) < finite)
        & (logits >= -finite)
    )
    # exp2_clamped makes a broken scale finite; the raw one still shows that it is broken.
    seen = seen & (scales[0] + scales[1] + scales[2] < finite)

    factor = broadcast(FACTOR_SCALE)
    slope_y = xy / yy
    a = factor * vsqrt(yy * unit / determinant * unit)
    record = (px, py, a, -(a * slope_y), factor / vsqrt(yy), log2_opacity, z, xy / xx, slope_y)
    tile = broadcast(F(1.0 / (1 << TILE_SHIFT)))
    tiles = (vfloor(left * tile), vfloor(top * tile), vfloor(right * tile), vfloor(bottom * tile))
    return seen, record, tiles, vceil(vmax(half_x, half_y))


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
    """Write the records of a range's visible splats; returns how many there are and how many slots they need."""
    zero = broadcast(F(0))
    visible = 0
    slots = 0
    for start in range(first, last, 16):
        count = min(16, last - start)
        mean = load_means(means, start, count, scratch)
        lanes = (1 << count) - 1
        if mask_bits(view_depth(camera, mean) > broadcast(NEAR)) & lanes == 0:
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


@kernel
def project_splats(threads, camera, means, quats, scales, logits, records, integers, found, counts, slots, scratch):
    """Write the records of all visible splats; ``found`` gets a run of rows for each thread's range."""
    for thread in prange(threads):
        first, last = vector_range(logits.shape[0], thread, threads)
        counts[thread], slots[thread] = project_range(
            camera, means, quats, scales, logits, first, last, records, integers, found, scratch[thread]
        )


@kernel
def find_visible(threads, camera, means, quats, scales, logits, found, runs, scratch):
    """Find the rows of the visible splats; thread t writes them to ``found`` from ``runs[t, 0]`` to ``runs[t, 1]``."""
    for thread in prange(threads):
        first, last = vector_range(logits.shape[0], thread, threads)
        at = first
        for start in range(first, last, 16):
            count = min(16, last - start)
            mean = load_means(means, start, count, scratch[thread])
            bits = mask_bits(view_depth(camera, mean) > broadcast(NEAR)) & ((1 << count) - 1)
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
    """Join the runs of all threads into ``ids`` (ascending rows, padded by 16), number the slots and add the colours.

    Also writes, by place in ``ids``, the depths as ``keys``, the places themselves as ``order`` and the tiles that a
    splat touches as ``boxes`` (first column and row, number of columns and rows, 16 bits each), and the projected
    centres ``means2d [N·2]`` and ``radii [N]`` of the visible splats.
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
