"""Colours from spherical harmonics and their backward pass, 16 splats at a time."""

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline
from nsvq_lightning.compute.rows import clear
from nsvq_lightning.rendering import sh
from nsvq_lightning.rendering.cpu import records as rec

C0, C1 = F(sh.C0), F(sh.C1)
C2A, C2B, C2C = (F(value) for value in sh.C2)
C3A, C3B, C3C, C3D, C3E = (F(value) for value in sh.C3)
# How many splats ahead the rows of a list are prefetched.
AHEAD = 32


@inline
def unit_direction(camera, means):
    """Unit vector from the camera to the splat and the inverse distance."""
    position = rec.load3(camera, rec.POSITION, 1)
    d = means[0] - position[0], means[1] - position[1], means[2] - position[2]
    inverse = 1 / simd.sqrt(simd.maximum(rec.dot3(d, d), 1e-20))
    return rec.scale3(inverse, d), inverse


@inline
def prefetch_sh(array, ids, start, end, stride, used):
    """Prefetch the SH rows of 16 later splats of the list, ``used`` floats of each."""
    if start < end:
        for lane in range(16):
            row = stride * np.int64(simd.get(ids, start + lane))
            for k in range(0, used, 16):
                simd.prefetch(array, row + k)


@inline
def coefficients_of(degree):
    """Floats in an SH row beyond the constant term."""
    return 3 * ((degree + 1) * (degree + 1) - 1)


# Floats in a row of degree-3 coefficients, which is read in whole vectors.
SH_ROW = 45


@inline
def gather_sh(shN, ids, start, stride, count, columns):
    """Gather the first ``count`` coefficients of 16 rows, one vector per column, into the scratch array ``columns``."""
    if stride == SH_ROW:
        for block in range(3 if count > 16 else 1):  # one copy of the code instead of three
            first = min(16 * block, SH_ROW - 16)
            rows = simd.gather_columns(shN, ids, start, stride, first)
            for k in range(16):
                simd.store(columns, 16 * (first + k), rows[k])
    else:
        for lane in range(16):
            row = np.int64(simd.get(ids, start + lane)) * stride
            for k in range(count):
                simd.put(columns, 16 * k + lane, simd.get(shN, row + k))


@inline
def add_band(columns, k, basis, rgb):
    """Add coefficient k (counted without the constant one) times its basis value to a colour."""
    o = 48 * k
    return (
        simd.fma(simd.load(columns, o), basis, rgb[0]),
        simd.fma(simd.load(columns, o + 16), basis, rgb[1]),
        simd.fma(simd.load(columns, o + 32), basis, rgb[2]),
    )


@inline
def bands1(d):
    """Basis of degree 1 at unit direction d."""
    return -(C1 * d[1]), C1 * d[2], -(C1 * d[0])


@inline
def bands2(d):
    """Basis of degree 2."""
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    return C2A * (x * y), -(C2A * (y * z)), C2B * (zz + zz - xx - yy), -(C2A * (x * z)), C2C * (xx - yy)


@inline
def bands3(d):
    """Basis of degree 3."""
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
def color(degree, d, sh0, columns):
    """0.5 + Σ coefficient·basis for 16 splats, before the clamp at 0."""
    rgb = simd.fma(sh0[0], C0, 0.5), simd.fma(sh0[1], C0, 0.5), simd.fma(sh0[2], C0, 0.5)
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
def color_range(camera, means, colors, bands, ids, first, last, records, scratch):
    """Write colours to the records of ``ids[first:last]``; the list is padded to whole vectors."""
    (sh0, shN), (stride, degree) = colors, bands
    coefficients = coefficients_of(degree)
    for start in range(first, last, 16):
        prefetch_sh(shN, ids, start + AHEAD, last, stride, coefficients)
        mean = simd.gather_rows3(means, ids, start)
        direction, _ = unit_direction(camera, mean)
        if degree > 0:
            gather_sh(shN, ids, start, stride, coefficients, scratch)
        r, g, b = color(degree, direction, simd.gather_rows3(sh0, ids, start), scratch)
        # This order of arguments keeps NaN, so that the loss shows it.
        simd.store(scratch, 0, simd.maximum(0, r))
        simd.store(scratch, 16, simd.maximum(0, g))
        simd.store(scratch, 32, simd.maximum(0, b))
        for lane in range(min(16, last - start)):
            o = rec.RECORD * np.int64(simd.get(ids, start + lane)) + rec.RED
            simd.put(records, o, simd.get(scratch, lane))
            simd.put(records, o + 1, simd.get(scratch, 16 + lane))
            simd.put(records, o + 2, simd.get(scratch, 32 + lane))


@inline
def direction_gradient(degree, d, e):
    """dL/d(direction) from the scratch vectors ``e[16·k]`` = Σ_channel coefficient·gradient of each band."""
    x, y, z = d
    gx, gy, gz = simd.broadcast(0), simd.broadcast(0), simd.broadcast(0)
    if degree > 0:
        gx, gy, gz = -(C1 * simd.load(e, 32)), -(C1 * simd.load(e, 0)), C1 * simd.load(e, 16)
    if degree > 1:
        a, b, c = C2A, C2B, C2C
        e0, e1, e2, e3, e4 = simd.load(e, 48), simd.load(e, 64), simd.load(e, 80), simd.load(e, 96), simd.load(e, 112)
        gx = gx + a * (y * e0 - z * e3) + 2 * x * (c * e4 - b * e2)
        gy = gy + a * (x * e0 - z * e1) - 2 * y * (b * e2 + c * e4)
        gz = gz + 4 * b * z * e2 - a * (y * e1 + x * e3)
    if degree > 2:
        a, b, c, f, g = C3A, C3B, C3C, C3D, C3E
        e0, e1, e2, e3 = simd.load(e, 128), simd.load(e, 144), simd.load(e, 160), simd.load(e, 176)
        e4, e5, e6 = simd.load(e, 192), simd.load(e, 208), simd.load(e, 224)
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        gx = gx - 6 * a * xy * e0 + b * yz * e1 + 2 * c * xy * e2 - 6 * f * xz * e3
        gx = gx - c * (4 * zz - 3 * xx - yy) * e4 + 2 * g * xz * e5 - 3 * a * (xx - yy) * e6
        gy = gy - 3 * a * (xx - yy) * e0 + b * xz * e1 - c * (4 * zz - xx - 3 * yy) * e2
        gy = gy - 6 * f * yz * e3 + 2 * c * xy * e4 - 2 * g * yz * e5 + 6 * a * xy * e6
        gz = gz + b * xy * e1 - 2 * 4 * c * (yz * e2 + xz * e4) + 3 * f * (2 * zz - xx - yy) * e3
        gz = gz + g * (xx - yy) * e5
    return gx, gy, gz


@inline
def put_band(gradient, e, columns, k, basis, rgb):
    """Write the gradient columns of coefficient k, and its share of the direction gradient."""
    o = 48 * k
    total = simd.load(columns, o) * rgb[0]
    total = simd.fma(simd.load(columns, o + 16), rgb[1], total)
    simd.store(e, 16 * k, simd.fma(simd.load(columns, o + 32), rgb[2], total))
    for channel in range(3):
        simd.store(gradient, o + 16 * channel, basis * rgb[channel])


@inline
def scatter_sh(gradient, columns, ids, start, stride, count):
    """Write 16 rows of SH gradients from the scratch columns; the inverse of :func:`gather_sh`."""
    if stride == SH_ROW and count == SH_ROW:
        for first in (0, 16, SH_ROW - 16):
            rows = simd.transpose(simd.load_vectors(columns, 16 * first))
            for lane in range(16):
                simd.store(gradient, np.int64(simd.get(ids, start + lane)) * stride + first, rows[lane])
    else:
        for lane in range(16):
            row = np.int64(simd.get(ids, start + lane)) * stride
            for k in range(count):
                simd.put(gradient, row + k, simd.get(columns, 16 * k + lane))
            clear(gradient, row + count, row + stride)


@inline
def color_backward(camera, bands, mean, shN, ids, start, rgb, g_sh0, g_shN, scratch):
    """Gradients of the SH coefficients; returns that of the mean through the viewing direction."""
    stride, degree = bands
    d, inverse = unit_direction(camera, mean)
    coefficients = coefficients_of(degree)
    columns, gradient, e = scratch[:768], scratch[768:1536], scratch[1536:]
    if degree > 0:
        gather_sh(shN, ids, start, stride, coefficients, columns)
    simd.scatter_rows3(g_sh0, ids, start, rec.scale3(C0, rgb))
    if degree == 0:
        scatter_sh(g_shN, gradient, ids, start, stride, 0)
        return simd.broadcast(0), simd.broadcast(0), simd.broadcast(0)
    b1 = bands1(d)
    for i in range(3):
        put_band(gradient, e, columns, i, b1[i], rgb)
    if degree > 1:
        b2 = bands2(d)
        for i in range(5):
            put_band(gradient, e, columns, 3 + i, b2[i], rgb)
    if degree > 2:
        b3 = bands3(d)
        for i in range(7):
            put_band(gradient, e, columns, 8 + i, b3[i], rgb)
    scatter_sh(g_shN, gradient, ids, start, stride, coefficients)
    g = direction_gradient(degree, d, e)
    return rec.scale3(inverse, rec.fma3(-rec.dot3(g, d), d, g))
