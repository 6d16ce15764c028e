"""Projection of splats onto the image plane, 16 at a time.

Equations: EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl et al. 2023, sec. 4).
"""

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline, parallel
from nsvq_lightning.rendering import constants
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.cpu.harmonics import color_range
from nsvq_lightning.splats import conventions

BLUR = F(constants.BLUR)
BLUR_SQUARED = F(constants.BLUR**2)
MIN_SQUARED_NORM = F(conventions.MIN_SQUARED_NORM)
FINITE = F(constants.FINITE)
HUGE_FOOTPRINT, LARGEST_FOOTPRINT = F(constants.HUGE_FOOTPRINT), F(constants.LARGEST_FOOTPRINT)
HUGE_QUATERNION, SHRINK = F(constants.HUGE_QUATERNION), F(constants.SHRINK)
LN2 = F(np.log(2.0))
# Square of the smallest factor by which anti-aliasing dims.
LEAST_LIGHT = F(constants.FAINTEST**2)


@inline
def view_depth(camera, mean):
    """View-space z of 16 means."""
    return rec.rotate(camera, 2, mean) + simd.load_one(camera, rec.TRANSLATION + 2)


@inline
def axes_of(quat, log_scales):
    """Unit quaternion and its inverse norm, axis lengths, and the rows of the matrix M = R·diag(lengths)."""
    w, x, y, z = quat
    largest = simd.maximum(simd.maximum(simd.abs(w), simd.abs(x)), simd.maximum(simd.abs(y), simd.abs(z)))
    shrink = simd.where(largest > HUGE_QUATERNION, SHRINK, 1)
    w, x, y, z = w * shrink, x * shrink, y * shrink, z * shrink
    squared = simd.fma(w, w, simd.fma(x, x, simd.fma(y, y, z * z)))
    inverse = 1 / simd.sqrt(simd.maximum(squared, MIN_SQUARED_NORM))
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    s0 = simd.exp2_clamped(log_scales[0] * rec.LOG2_E)
    s1 = simd.exp2_clamped(log_scales[1] * rec.LOG2_E)
    s2 = simd.exp2_clamped(log_scales[2] * rec.LOG2_E)
    xx, yy, zz = simd.fma(y, y, z * z), simd.fma(x, x, z * z), simd.fma(x, x, y * y)
    m0 = simd.fnma(2, xx, 1) * s0, 2 * (x * y - w * z) * s1, 2 * (x * z + w * y) * s2
    m1 = 2 * (x * y + w * z) * s0, simd.fnma(2, yy, 1) * s1, 2 * (y * z - w * x) * s2
    m2 = 2 * (x * z - w * y) * s0, 2 * (y * z + w * x) * s1, simd.fnma(2, zz, 1) * s2
    return (w, x, y, z), inverse * shrink, (s0, s1, s2), (m0, m1, m2)


@inline
def affine_row(camera, k, scale, slope):
    """Row k of T = J·W, the local affine map: ``scale`` is focal/z, W the rotation."""
    near, far = rec.load3(camera, rec.ROTATION + 3 * k, 1), rec.load3(camera, rec.ROTATION + 6, 1)
    return rec.fma3(scale, near, rec.scale3(-(scale * slope), far))


@inline
def affine(camera, mean):
    """View-space point, 1/z, slopes limited to the frustum, and T = J·W, the two rows of the local affine map."""
    x = rec.rotate(camera, 0, mean) + simd.load_one(camera, rec.TRANSLATION)
    y = rec.rotate(camera, 1, mean) + simd.load_one(camera, rec.TRANSLATION + 1)
    z = view_depth(camera, mean)
    inverse = 1 / z
    slope_x = simd.minimum(
        simd.load_one(camera, rec.HIGH_X), simd.maximum(simd.load_one(camera, rec.LOW_X), x * inverse)
    )
    slope_y = simd.minimum(
        simd.load_one(camera, rec.HIGH_Y), simd.maximum(simd.load_one(camera, rec.LOW_Y), y * inverse)
    )
    t0 = affine_row(camera, 0, simd.load_one(camera, rec.FX) * inverse, slope_x)
    t1 = affine_row(camera, 1, simd.load_one(camera, rec.FY) * inverse, slope_y)
    return (x, y, z), inverse, (slope_x, slope_y), t0, t1


@inline
def image_axes(t, m):
    """One row of U = T·M: the splat's axes along one image axis."""
    m0, m1, m2 = m
    return (rec.dot3(t, (m0[0], m1[0], m2[0])), rec.dot3(t, (m0[1], m1[1], m2[1])), rec.dot3(t, (m0[2], m1[2], m2[2])))


@inline
def footprint(camera, means, quats, scales, logits):
    """All of a record except the colour, the tile rectangle, and which of 16 splats can change the image."""
    (x, y, z), inverse, _, t0, t1 = affine(camera, means)
    _, _, _, m = axes_of(quats, scales)
    u, v = image_axes(t0, m), image_axes(t1, m)
    xx, yy, xy = rec.dot3(u, u), rec.dot3(v, v), rec.dot3(u, v)
    # |u|²|v|² - (u·v)² = |u × v|² (Lagrange): no cancellation for large splats.
    size = xx + yy
    unit = simd.where(size > HUGE_FOOTPRINT, 1 / size, 1)
    n = rec.scale3(unit, rec.cross(u, v))
    determinant = rec.dot3(n, n) + simd.fma(BLUR, size, BLUR_SQUARED) * unit * unit
    xx, yy = xx + BLUR, yy + BLUR

    px = simd.fma(simd.load_one(camera, rec.FX), x * inverse, simd.load_one(camera, rec.CX))
    py = simd.fma(simd.load_one(camera, rec.FY), y * inverse, simd.load_one(camera, rec.CY))
    log2_opacity = -simd.log2(1 + simd.exp2_clamped(-(logits * rec.LOG2_E)))
    # α reaches 1/255 where u² + v² ≤ log2(255 o): a box of half sizes √(2 ln(255 o)·Σ_ii).
    reach = (log2_opacity - rec.LOG2_ALPHA_MIN) * (F(2) * LN2)
    half_x, half_y = simd.sqrt(simd.maximum(reach, 0) * xx), simd.sqrt(simd.maximum(reach, 0) * yy)
    left, right = simd.maximum(simd.ceil(px - half_x - 0.5), 0), simd.floor(px + half_x - 0.5)
    top, bottom = simd.maximum(simd.ceil(py - half_y - 0.5), 0), simd.floor(py + half_y - 0.5)
    right = simd.minimum(right, simd.load_one(camera, rec.WIDTH) - 1)
    bottom = simd.minimum(bottom, simd.load_one(camera, rec.HEIGHT) - 1)

    seen = (z > simd.load_one(camera, rec.NEAR)) & (reach > 0) & (left <= right) & (top <= bottom)
    seen = seen & (size < LARGEST_FOOTPRINT) & (determinant < FINITE)
    seen = seen & (simd.abs(px) < FINITE) & (simd.abs(py) < FINITE) & (logits >= -FINITE)
    # exp2_clamped makes a broken scale finite; the raw one still shows that it is broken.
    seen = seen & (scales[0] + scales[1] + scales[2] < FINITE)

    slope_y = xy / yy
    a = rec.FACTOR_SCALE * simd.sqrt(yy * unit / determinant * unit)
    record = (px, py, a, -(a * slope_y), rec.FACTOR_SCALE / simd.sqrt(yy), log2_opacity, z, xy / xx, slope_y)
    tile = F(1.0 / rec.TILE)
    tiles = (simd.floor(left * tile), simd.floor(top * tile), simd.floor(right * tile), simd.floor(bottom * tile))
    return seen, record, tiles, simd.ceil(simd.maximum(half_x, half_y))


@inline
def load_means(means, start, count, scratch):
    """16 means; the last, incomplete vector is read from a padded copy."""
    if count < 16:
        for k in range(3 * count):
            simd.put(scratch, k, simd.get(means, 3 * start + k))
        return simd.load_rows3(scratch, 0)
    return simd.load_rows3(means, 3 * start)


@inline
def load_shapes(quats, scales, logits, start, count, scratch):
    """16 quaternions, log scales and opacity logits, an incomplete vector as in :func:`load_means`."""
    if count < 16:
        for k in range(4 * count):
            simd.put(scratch, k, simd.get(quats, 4 * start + k))
        quat = simd.load_rows4(scratch, 0)
        for k in range(3 * count):
            simd.put(scratch, k, simd.get(scales, 3 * start + k))
        scale = simd.load_rows3(scratch, 0)
        for k in range(count):
            simd.put(scratch, k, simd.get(logits, start + k))
        return quat, scale, simd.load(scratch, 0)
    return simd.load_rows4(quats, 4 * start), simd.load_rows3(scales, 3 * start), simd.load(logits, start)


@inline
def project_range(camera, means, quats, scales, logits, first, last, records, integers, ids, scratch):
    """Write the records of a range's visible splats; returns how many there are and how many slots they need."""
    zero = simd.broadcast(0)
    visible = 0
    slots = 0
    for start in range(first, last, 16):
        count = min(16, last - start)
        mean = load_means(means, start, count, scratch)
        lanes = (1 << count) - 1
        if simd.mask_bits(view_depth(camera, mean) > simd.load_one(camera, rec.NEAR)) & lanes == 0:
            continue
        quat, scale, logit = load_shapes(quats, scales, logits, start, count, scratch)
        seen, record, tiles, radius = footprint(camera, mean, quat, scale, logit)
        bits = simd.mask_bits(seen) & lanes
        if bits == 0:
            continue
        x, y, a, b, c, opacity, depth, slope_x, slope_y = record
        fields = (x, y, a, b, c, opacity, zero, zero, zero, depth, slope_x, slope_y, zero, zero, zero, zero)
        rows = simd.transpose(fields)
        for lane in range(16):
            simd.store(scratch, 128 + 16 * lane, rows[lane])
        for k in range(4):
            simd.store(scratch, 16 * k, tiles[k])
        simd.store(scratch, 64, radius)
        while bits != 0:
            lane = simd.lowest_bit(bits)
            bits &= bits - 1
            row = start + lane
            simd.store(records, rec.RECORD * row, simd.load(scratch, 128 + 16 * lane))
            x0, y0 = np.int64(simd.get(scratch, lane)), np.int64(simd.get(scratch, 16 + lane))
            x1, y1 = np.int64(simd.get(scratch, 32 + lane)), np.int64(simd.get(scratch, 48 + lane))
            simd.put(integers, rec.RECORD * row + rec.SLOT, slots)
            simd.put(integers, rec.RECORD * row + rec.ORIGIN, x0 | (y0 << 16))
            simd.put(integers, rec.RECORD * row + rec.EXTENT, (x1 - x0 + 1) | ((y1 - y0 + 1) << 16))
            simd.put(integers, rec.RECORD * row + rec.RADIUS, np.int64(min(simd.get(scratch, 64 + lane), F(1e9))))
            columns = (x1 >> rec.GROUP_SHIFT) - (x0 >> rec.GROUP_SHIFT) + 1
            slots += columns * ((y1 >> rec.GROUP_SHIFT) - (y0 >> rec.GROUP_SHIFT) + 1)
            simd.put(ids, first + visible, row)
            visible += 1
    return visible, slots


@parallel
def project_splats(
    thread, threads, camera, means, quats, scales, logits, records, integers, found, counts, slots, scratch
):
    """Write the records of all visible splats; ``found`` gets a run of rows for each thread's range."""
    first, last = rec.vector_range(logits.shape[0], thread, threads)
    counts[thread], slots[thread] = project_range(
        camera, means, quats, scales, logits, first, last, records, integers, found, scratch[thread]
    )


@parallel
def join_runs(thread, threads, runs, records, integers, listed, means2d, radii):
    """Join the runs of all threads into ``ids`` (ascending rows, padded by 16), and number the slots.

    ``runs`` are what :func:`project_splats` found, ``listed`` ids, keys, order and boxes.

    Also writes, by place in ``ids``, the depths as ``keys``, the places themselves as ``order`` and the tiles that a
    splat touches as ``boxes`` (first column and row, number of columns and rows, 16 bits each), and the projected
    centres ``means2d [N·2]`` and ``radii [N]`` of the visible splats.
    """
    found, counts, slots = runs
    ids, keys, order, boxes = listed
    total = counts.sum()
    first, _ = rec.vector_range(records.shape[0] // rec.RECORD, thread, threads)
    start, slot = counts[:thread].sum(), slots[:thread].sum()
    for k in range(counts[thread]):
        row = np.int64(simd.get(found, first + k))
        simd.put(ids, start + k, row)
        place = rec.RECORD * row + rec.SLOT
        simd.put(integers, place, np.int64(simd.get(integers, place)) + slot)
        # Depths are positive, so their bits sort as integers.
        simd.put(keys, start + k, simd.get(integers, rec.RECORD * row + rec.DEPTH))
        simd.put(order, start + k, start + k)
        extent = np.int64(simd.get(integers, rec.RECORD * row + rec.EXTENT))
        simd.put(boxes, start + k, np.int64(simd.get(integers, rec.RECORD * row + rec.ORIGIN)) | (extent << 32))
        simd.put(means2d, 2 * row, simd.get(records, rec.RECORD * row + rec.X))
        simd.put(means2d, 2 * row + 1, simd.get(records, rec.RECORD * row + rec.Y))
        simd.put(radii, row, simd.get(integers, rec.RECORD * row + rec.RADIUS))
    if start + counts[thread] == total and counts[thread] > 0:
        for k in range(16):
            simd.put(ids, total + k, simd.get(ids, total - 1))


@parallel
def add_colors(thread, threads, camera, means, colors, bands, ids, count, records, scratch):
    """Write the colours of the visible splats to their records.

    ``colors`` are sh0 and shN, ``bands`` the floats in a row of shN and the degree that counts.
    """
    first, last = rec.vector_range(count, thread, threads)
    color_range(camera, means, colors, bands, ids, first, last, records, scratch[thread])


@inline
def light(u, v):
    """The light that the blur leaves, squared; det Σ, the sum of the variances, what the blur adds to det Σ, u × v."""
    n = rec.cross(u, v)
    area, size = rec.dot3(n, n), rec.dot3(u, u) + rec.dot3(v, v)
    added = BLUR * size + BLUR_SQUARED
    squared = simd.where(size < HUGE_FOOTPRINT, area / (area + added), 1)
    return simd.maximum(squared, LEAST_LIGHT), area, size, added, n


@parallel
def keep_light(thread, threads, camera, means, quats, scales, ids, count, factors):
    """Factors ``[count]`` of the splats ``ids``; both arrays have room for a last, incomplete vector."""
    first, last = rec.vector_range(count, thread, threads)
    for start in range(first, last, 16):
        _, _, _, t0, t1 = affine(camera, simd.gather_rows3(means, ids, start))
        _, _, _, m = axes_of(simd.gather_rows4(quats, ids, start), simd.gather_rows3(scales, ids, start))
        squared, _, _, _, _ = light(image_axes(t0, m), image_axes(t1, m))
        simd.store(factors, start, simd.sqrt(squared))
