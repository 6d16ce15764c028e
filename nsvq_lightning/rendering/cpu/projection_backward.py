"""The backward pass of the projection, 16 splats at a time: from the sums of a splat to gradients of its attributes."""

from __future__ import annotations

import numpy as np
from numba import prange

from nsvq_lightning.compute.jit import F, inline, kernel
from nsvq_lightning.compute.rows import clear
from nsvq_lightning.compute.simd import (
    broadcast,
    exp2_clamped,
    fma,
    fnma,
    gather_columns,
    gather_rows1,
    gather_rows3,
    gather_rows4,
    get,
    load,
    prefetch,
    put,
    scatter_rows1,
    scatter_rows3,
    scatter_rows4,
    select,
)
from nsvq_lightning.rendering.cpu.harmonics import AHEAD, coefficients_of, color_backward, prefetch_sh
from nsvq_lightning.rendering.cpu.projection import BLUR, affine, axes_of, image_axes
from nsvq_lightning.rendering.cpu.records import (
    BLUE,
    FX,
    FY,
    GREEN,
    LOG2_E,
    RECORD,
    RED,
    SLOT,
    SUM_BLUE,
    SUM_DEPTH,
    SUM_GREEN,
    SUM_H,
    SUM_RED,
    SUM_UU,
    SUM_UV,
    SUM_VV,
    A,
    B,
    C,
    cross,
    dot3,
    rotate,
    rotate_back,
    vector_range,
)

COVARIANCE_SCALE = F(2 * np.log(2.0) ** 2)
"""Converts moments of the scaled factor to dL/dΣ: ½ / (½ log2 e)²."""


@inline
def quaternion_gradient(q, inverse, r):
    """dL/dq of an unnormalised quaternion from dL/dR (row by row)."""
    two = broadcast(F(2))
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
def clear_rows(first, last, stride, g_means, g_quats, g_scales, g_logits, g_sh0, g_shN):
    """Zero the gradients of rows that are not in view."""
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
    fx, fy = broadcast(get(camera, FX)) * inverse, broadcast(get(camera, FY)) * inverse
    fx_z, fy_z = fx * inverse, fy * inverse
    one, zero = broadcast(F(1)), broadcast(F(0))
    tx, ty = x * inverse, y * inverse
    free_x = select((slope_x >= tx) & (slope_x <= tx), one, zero)
    free_y = select((slope_y >= ty) & (slope_y <= ty), one, zero)
    vx = fnma(free_x * fx_z, j02, fx * g2x)
    vy = fnma(free_y * fy_z, j12, fy * g2y)
    vz = (one + free_x) * fx_z * slope_x * j02 + (one + free_y) * fy_z * slope_y * j12
    vz = vz - fx_z * (x * g2x + j00) - fy_z * (y * g2y + j11)
    vz = vz + g_depth
    g_mean = (
        rotate_back(camera, 0, vx, vy, vz),
        rotate_back(camera, 1, vx, vy, vz),
        rotate_back(camera, 2, vx, vy, vz),
    )
    return g_mean, g_quat


@inline
def geometry_backward(camera, mean, quat, scale, record, total, g2x, g2y):
    """Gradients of mean (without the colour's share), quaternion and log-scales of 16 splats.

    ``total`` are the 16 sums of a slot, ``g2x``, ``g2y`` the gradient of the projected centre.
    """
    two = broadcast(F(2))
    view, axes = affine(camera, mean), axes_of(quat, scale)
    _, _, _, t0, t1 = view
    _, _, _, m = axes
    u, v = image_axes(t0, m), image_axes(t1, m)

    # dL/dΣ = ½ Fᵀ S F with S = Σ h uuᵀ, so dL/dU = Fᵀ S (F U). The rows of F U are a·u + b·v and c·v; by Lagrange's
    # identity the first is a·(v × (u × v) + blur·u)/|v|², which stays accurate for needles.
    a, b, c = record[A], record[B], record[C]
    k = two * broadcast(COVARIANCE_SCALE)
    uu, uv, vv = k * total[SUM_UU], k * total[SUM_UV], k * total[SUM_VV]
    per_yy = broadcast(F(1)) / (dot3(v[0], v[1], v[2], v[0], v[1], v[2]) + broadcast(BLUR))
    n = cross(u, v)
    n = cross(v, (n[0] * per_yy, n[1] * per_yy, n[2] * per_yy))
    blur = broadcast(BLUR) * per_yy
    r = a * fma(blur, u[0], n[0]), a * fma(blur, u[1], n[1]), a * fma(blur, u[2], n[2])
    s = c * v[0], c * v[1], c * v[2]
    e = fma(uu, r[0], uv * s[0]), fma(uu, r[1], uv * s[1]), fma(uu, r[2], uv * s[2])
    f = fma(uv, r[0], vv * s[0]), fma(uv, r[1], vv * s[1]), fma(uv, r[2], vv * s[2])
    gu = a * e[0], a * e[1], a * e[2]
    gv = fma(b, e[0], c * f[0]), fma(b, e[1], c * f[1]), fma(b, e[2], c * f[2])
    g_scale = fma(r[0], e[0], s[0] * f[0]), fma(r[1], e[1], s[1] * f[1]), fma(r[2], e[2], s[2] * f[2])
    g_mean, g_quat = axes_backward(camera, view, axes, gu, gv, g2x, g2y, total[SUM_DEPTH])
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
        # Between its first and last visible splat, every thread clears the rows that it skips.
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
            zero = broadcast(F(0))
            # A colour below 0 was clamped.
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
            one = broadcast(F(1))
            transparent = one / (one + exp2_clamped(logit * broadcast(LOG2_E)))
            scatter_rows1(g_logits, ids, start, total[SUM_H] * transparent)
