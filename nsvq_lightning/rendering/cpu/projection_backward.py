"""The backward passes of the projection and of anti-aliasing, 16 splats at a time, to gradients of the attributes."""

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline, parallel
from nsvq_lightning.compute.rows import clear
from nsvq_lightning.rendering.cpu import projection
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.cpu.harmonics import AHEAD, coefficients_of, color_backward, prefetch_sh


@inline
def quaternion_gradient(q, inverse, r):
    """dL/dq of an unnormalised quaternion from the rows of dL/dR."""
    w, x, y, z = q
    r0, r1, r2 = r
    gw = 2 * (x * (r2[1] - r1[2]) + y * (r0[2] - r2[0]) + z * (r1[0] - r0[1]))
    gx = 2 * (y * (r0[1] + r1[0]) + z * (r0[2] + r2[0]) + w * (r2[1] - r1[2]) - 2 * x * (r1[1] + r2[2]))
    gy = 2 * (x * (r0[1] + r1[0]) + z * (r1[2] + r2[1]) + w * (r0[2] - r2[0]) - 2 * y * (r0[0] + r2[2]))
    gz = 2 * (x * (r0[2] + r2[0]) + y * (r1[2] + r2[1]) + w * (r1[0] - r0[1]) - 2 * z * (r0[0] + r1[1]))
    radial = simd.fma(gw, w, rec.dot3((gx, gy, gz), (x, y, z)))
    rest = rec.scale3(inverse, rec.fma3(-radial, (x, y, z), (gx, gy, gz)))
    return simd.fnma(radial, w, gw) * inverse, rest[0], rest[1], rest[2]


@inline
def clear_rows(first, last, stride, gradients):
    """Zero the gradients of rows that are not in view."""
    g_means, g_quats, g_scales, g_logits, g_sh0, g_shN = gradients
    clear(g_means, 3 * first, 3 * last)
    clear(g_quats, 4 * first, 4 * last)
    clear(g_scales, 3 * first, 3 * last)
    clear(g_logits, first, last)
    clear(g_sh0, 3 * first, 3 * last)
    clear(g_shN, stride * first, stride * last)


@inline
def axes_backward(camera, view, axes, gu, gv, g2x, g2y, g_depth):
    """Gradients of mean and quaternion of 16 splats from those of the rows ``gu``, ``gv`` of U = T·M.

    ``view`` is what :func:`affine` returns, ``axes`` what :func:`axes_of` does; ``g2x``, ``g2y`` are the gradient of
    the projected centre, ``g_depth`` that of the depth.
    """
    (x, y, _), inverse, (slope_x, slope_y), t0, t1 = view
    q, q_inverse, lengths, m = axes
    gm0 = rec.fma3(t0[0], gu, rec.scale3(t1[0], gv))
    gm1 = rec.fma3(t0[1], gu, rec.scale3(t1[1], gv))
    gm2 = rec.fma3(t0[2], gu, rec.scale3(t1[2], gv))
    g_rotation = rec.times3(gm0, lengths), rec.times3(gm1, lengths), rec.times3(gm2, lengths)
    g_quat = quaternion_gradient(q, q_inverse, g_rotation)

    g0 = rec.dot3(gu, m[0]), rec.dot3(gu, m[1]), rec.dot3(gu, m[2])
    g1 = rec.dot3(gv, m[0]), rec.dot3(gv, m[1]), rec.dot3(gv, m[2])
    # J = [[fx/z, 0, -fx·sx/z], [0, fy/z, -fy·sy/z]]; sx = x/z except where it is clamped.
    j00, j02 = rec.rotate(camera, 0, g0), rec.rotate(camera, 2, g0)
    j11, j12 = rec.rotate(camera, 1, g1), rec.rotate(camera, 2, g1)
    fx, fy = simd.load_one(camera, rec.FX) * inverse, simd.load_one(camera, rec.FY) * inverse
    fx_z, fy_z = fx * inverse, fy * inverse
    tx, ty = x * inverse, y * inverse
    free_x = simd.where((slope_x >= tx) & (slope_x <= tx), 1, 0)
    free_y = simd.where((slope_y >= ty) & (slope_y <= ty), 1, 0)
    vx = simd.fnma(free_x * fx_z, j02, fx * g2x)
    vy = simd.fnma(free_y * fy_z, j12, fy * g2y)
    vz = (1 + free_x) * fx_z * slope_x * j02 + (1 + free_y) * fy_z * slope_y * j12
    vz = vz - fx_z * (x * g2x + j00) - fy_z * (y * g2y + j11)
    v = vx, vy, vz + g_depth
    return (rec.rotate_back(camera, 0, v), rec.rotate_back(camera, 1, v), rec.rotate_back(camera, 2, v)), g_quat


# Converts moments of the scaled factor to dL/dΣ: ½ / (½ log2 e)².
COVARIANCE_SCALE = F(2 * np.log(2.0) ** 2)


@inline
def geometry_backward(camera, mean, quat, scale, record, total, g2x, g2y):
    """Gradients of mean (without the colour's share), quaternion and log-scales of 16 splats.

    ``total`` are the 16 sums of a slot, ``g2x``, ``g2y`` the gradient of the projected centre.
    """
    view, axes = projection.affine(camera, mean), projection.axes_of(quat, scale)
    _, _, _, t0, t1 = view
    _, _, _, m = axes
    u, v = projection.image_axes(t0, m), projection.image_axes(t1, m)

    # dL/dΣ = ½ Fᵀ S F with S = Σ h uuᵀ, so dL/dU = Fᵀ S (F U). The rows of F U are a·u + b·v and c·v; by Lagrange's
    # identity the first is a·(v × (u × v) + blur·u)/|v|², which stays accurate for needles.
    a, b, c = record[rec.A], record[rec.B], record[rec.C]
    k = F(2) * COVARIANCE_SCALE
    uu, uv, vv = k * total[rec.SUM_UU], k * total[rec.SUM_UV], k * total[rec.SUM_VV]
    per_yy = 1 / (rec.dot3(v, v) + projection.BLUR)
    n = rec.cross(v, rec.scale3(per_yy, rec.cross(u, v)))
    r, s = rec.scale3(a, rec.fma3(projection.BLUR * per_yy, u, n)), rec.scale3(c, v)
    e, f = rec.fma3(uu, r, rec.scale3(uv, s)), rec.fma3(uv, r, rec.scale3(vv, s))
    gu, gv = rec.scale3(a, e), rec.fma3(b, e, rec.scale3(c, f))
    g_scale = simd.fma(r[0], e[0], s[0] * f[0]), simd.fma(r[1], e[1], s[1] * f[1]), simd.fma(r[2], e[2], s[2] * f[2])
    g_mean, g_quat = axes_backward(camera, view, axes, gu, gv, g2x, g2y, total[rec.SUM_DEPTH])
    return g_mean, g_quat, g_scale


@parallel
def project_backward(
    thread, threads, camera, geometry, shN, bands, ids, count, records, integers, sums, g_means2d, gradients, scratch
):
    """Gradients of all raw attributes from the sums of the slots of the visible splats; 0 for the others.

    ``sums[16·slot]`` of a splat's first slot holds its total; ``g_means2d [N·2]`` the gradient of its projected centre.
    ``geometry`` are means, quaternions, log-scales and logits, ``bands`` as in :func:`finish_records`.
    """
    means, quats, scales, logits = geometry
    g_means, g_quats, g_scales, g_logits, g_sh0, g_shN = gradients
    stride, coefficients = bands[0], coefficients_of(bands[1])
    work = scratch[thread]
    slot = work[2048:].view(np.int32)
    # Between its first and last visible splat, every thread clears the rows that it skips.
    begin, end = rec.vector_range(count, thread, threads)
    row = np.int64(simd.get(ids, begin - 1)) + 1 if begin > 0 else 0
    for i in range(begin, end):
        here = np.int64(simd.get(ids, i))
        if here > row:
            clear_rows(row, here, stride, gradients)
        row = here + 1
    if thread == threads - 1:
        clear_rows(row, logits.shape[0], stride, gradients)
    for start in range(begin, end, 16):
        prefetch_sh(shN, ids, start + AHEAD, end, stride, coefficients)
        prefetch_sh(g_shN, ids, start + AHEAD, end, stride, stride)
        if start + AHEAD < end:
            for lane in range(16):
                row = rec.RECORD * np.int64(simd.get(ids, start + AHEAD + lane))
                simd.prefetch(sums, rec.RECORD * np.int64(simd.get(integers, row + rec.SLOT)))
        for lane in range(16):
            row = np.int64(simd.get(ids, start + lane))
            simd.put(slot, lane, simd.get(integers, rec.RECORD * row + rec.SLOT))
            simd.put(work, lane, simd.get(g_means2d, 2 * row))
            simd.put(work, 16 + lane, simd.get(g_means2d, 2 * row + 1))
        g2x, g2y = simd.load(work, 0), simd.load(work, 16)
        total = simd.gather_columns(sums, slot, 0, rec.RECORD, 0)
        record = simd.gather_columns(records, ids, start, rec.RECORD, 0)
        mean = simd.gather_rows3(means, ids, start)
        quat, scale = simd.gather_rows4(quats, ids, start), simd.gather_rows3(scales, ids, start)
        g_mean, g_quat, g_scale = geometry_backward(camera, mean, quat, scale, record, total, g2x, g2y)
        # A colour below 0 was clamped.
        red = simd.where(record[rec.RED] > 0, total[rec.SUM_RED], 0)
        green = simd.where(record[rec.GREEN] > 0, total[rec.SUM_GREEN], 0)
        blue = simd.where(record[rec.BLUE] > 0, total[rec.SUM_BLUE], 0)
        rgb = red, green, blue
        gx, gy, gz = color_backward(camera, bands, mean, shN, ids, start, rgb, g_sh0, g_shN, work)
        simd.scatter_rows3(g_means, ids, start, (g_mean[0] + gx, g_mean[1] + gy, g_mean[2] + gz))
        simd.scatter_rows4(g_quats, ids, start, g_quat)
        simd.scatter_rows3(g_scales, ids, start, g_scale)
        logit = simd.gather_rows1(logits, ids, start)[0]
        transparent = 1 / (1 + simd.exp2_clamped(logit * rec.LOG2_E))
        simd.scatter_rows1(g_logits, ids, start, (total[rec.SUM_H] * transparent,))


@parallel
def keep_light_backward(
    thread, threads, camera, means, quats, scales, ids, count, gradient, g_means, g_quats, g_scales
):
    """Gradients of the rows ``ids`` of all means, quaternions and log-scales from that of their factors ``[count]``.

    With A = det Σ, S the sum of the variances and D = A + b·S + b², the factor is ρ = √(A/D), and
    dρ = ½·ρ·((b·S + b²)/(A·D)·dA − b/D·dS), where dA = 2·((v × n)·du + (n × u)·dv) with n = u × v.
    """
    first, last = rec.vector_range(count, thread, threads)
    for start in range(first, last, 16):
        view = projection.affine(camera, simd.gather_rows3(means, ids, start))
        axes = projection.axes_of(simd.gather_rows4(quats, ids, start), simd.gather_rows3(scales, ids, start))
        _, _, _, t0, t1 = view
        _, _, _, m = axes
        u, v = projection.image_axes(t0, m), projection.image_axes(t1, m)
        squared, area, size, added, n = projection.light(u, v)
        # At the floor, and where the blur does not count, the factor is constant.
        free = (size < projection.HUGE_FOOTPRINT) & (squared > projection.LEAST_LIGHT)
        # A huge splat's v × n would overflow, and 0 · ∞ is not 0.
        u = simd.where(free, u[0], 0), simd.where(free, u[1], 0), simd.where(free, u[2], 0)
        v = simd.where(free, v[0], 0), simd.where(free, v[1], 0), simd.where(free, v[2], 0)
        whole = area + added
        g = simd.where(free, simd.load(gradient, start) * simd.sqrt(squared) / whole, 0)
        by_area = simd.where(free, g * added / area, 0)
        by_size = g * projection.BLUR
        vn, nu = rec.cross(v, n), rec.cross(n, u)
        gu = by_area * vn[0] - by_size * u[0], by_area * vn[1] - by_size * u[1], by_area * vn[2] - by_size * u[2]
        gv = by_area * nu[0] - by_size * v[0], by_area * nu[1] - by_size * v[1], by_area * nu[2] - by_size * v[2]
        g_mean, g_quat = axes_backward(camera, view, axes, gu, gv, 0, 0, 0)
        simd.scatter_rows3(g_means, ids, start, g_mean)
        simd.scatter_rows4(g_quats, ids, start, g_quat)
        g_scale = gu[0] * u[0] + gv[0] * v[0], gu[1] * u[1] + gv[1] * v[1], gu[2] * u[2] + gv[2] * v[2]
        simd.scatter_rows3(g_scales, ids, start, g_scale)
