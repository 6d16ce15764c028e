"""Colours from spherical harmonics and their backward pass, 16 splats at a time."""

from __future__ import annotations

import numpy as np

from nsvq_lightning.compute.jit import F, inline
from nsvq_lightning.compute.rows import clear
from nsvq_lightning.compute.simd import (
    broadcast,
    fma,
    fnma,
    gather_columns,
    gather_rows3,
    get,
    load,
    prefetch,
    put,
    scatter_rows3,
    store,
    transpose,
    vmax,
    vsqrt,
)
from nsvq_lightning.rendering import sh
from nsvq_lightning.rendering.cpu.records import POSITION, RECORD, RED, dot3

C0, C1 = F(sh.C0), F(sh.C1)
C2A, C2B, C2C = (F(value) for value in sh.C2)
C3A, C3B, C3C, C3D, C3E = (F(value) for value in sh.C3)
AHEAD = 32
"""How many splats ahead the rows of a list are prefetched."""
SH_ROW = 45
"""Floats in a row of degree-3 coefficients, which is read in whole vectors."""


@inline
def unit_direction(camera, means):
    """Unit vector from the camera to the splat and the inverse distance."""
    x = means[0] - broadcast(get(camera, POSITION))
    y = means[1] - broadcast(get(camera, POSITION + 1))
    z = means[2] - broadcast(get(camera, POSITION + 2))
    inverse = broadcast(F(1)) / vsqrt(vmax(dot3(x, y, z, x, y, z), broadcast(F(1e-20))))
    return (x * inverse, y * inverse, z * inverse), inverse


@inline
def prefetch_sh(array, ids, start, end, stride, used):
    """Prefetch the SH rows of 16 later splats of the list, ``used`` floats of each."""
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
        store(columns, 16 * k, broadcast(F(0)))


@inline
def gather_sh(shN, ids, start, stride, count, columns):
    """Gather the first ``count`` coefficients of 16 rows, one vector per column, into the scratch array ``columns``."""
    if stride == SH_ROW:
        for block in range(3 if count > 16 else 1):  # one copy of the code instead of three
            first = min(16 * block, SH_ROW - 16)
            rows = gather_columns(shN, ids, start, stride, first)
            for k in range(16):
                store(columns, 16 * (first + k), rows[k])
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
    k = broadcast(C1)
    return -(k * d[1]), k * d[2], -(k * d[0])


@inline
def bands2(d):
    """Basis of degree 2."""
    x, y, z = d
    a = broadcast(C2A)
    xx, yy, zz = x * x, y * y, z * z
    return a * (x * y), -(a * (y * z)), broadcast(C2B) * (zz + zz - xx - yy), -(a * (x * z)), broadcast(C2C) * (xx - yy)


@inline
def bands3(d):
    """Basis of degree 3."""
    x, y, z = d
    three, four = broadcast(F(3)), broadcast(F(4))
    xx, yy, zz = x * x, y * y, z * z
    a, c = broadcast(C3A), broadcast(C3C)
    around = four * zz - xx - yy
    return (
        -(a * y * (three * xx - yy)),
        broadcast(C3B) * (x * y) * z,
        -(c * y * around),
        broadcast(C3D) * z * (zz + zz - three * (xx + yy)),
        -(c * x * around),
        broadcast(C3E) * z * (xx - yy),
        -(a * x * (xx - three * yy)),
    )


@inline
def color(degree, d, sh0, columns):
    """0.5 + Σ coefficient·basis for 16 splats, before the clamp at 0."""
    half, k = broadcast(F(0.5)), broadcast(C0)
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
def color_range(camera, means, sh0, shN, stride, degree, evaluated, ids, first, last, records, scratch):
    """Write colours to the records of ``ids[first:last]``; the list is padded to whole vectors."""
    zero = broadcast(F(0))
    coefficients = coefficients_of(evaluated)
    for start in range(first, last, 16):
        prefetch_sh(shN, ids, start + AHEAD, last, stride, coefficients)
        mean = gather_rows3(means, ids, start)
        direction, _ = unit_direction(camera, mean)
        if evaluated > 0:
            gather_sh(shN, ids, start, stride, coefficients, scratch)
            clear_bands(scratch, degree, evaluated)
        r, g, b = color(evaluated, direction, gather_rows3(sh0, ids, start), scratch)
        # This order of arguments keeps NaN, so that the loss shows it.
        store(scratch, 0, vmax(zero, r))
        store(scratch, 16, vmax(zero, g))
        store(scratch, 32, vmax(zero, b))
        for lane in range(min(16, last - start)):
            o = RECORD * np.int64(get(ids, start + lane)) + RED
            put(records, o, get(scratch, lane))
            put(records, o + 1, get(scratch, 16 + lane))
            put(records, o + 2, get(scratch, 32 + lane))


@inline
def direction_gradient(degree, d, e):
    """dL/d(direction) from the scratch vectors ``e[16·k]`` = Σ_channel coefficient·gradient of each band."""
    x, y, z = d
    zero, two, three, four, six = broadcast(F(0)), broadcast(F(2)), broadcast(F(3)), broadcast(F(4)), broadcast(F(6))
    gx, gy, gz = zero, zero, zero
    if degree > 0:
        k = broadcast(C1)
        gx, gy, gz = -(k * load(e, 32)), -(k * load(e, 0)), k * load(e, 16)
    if degree > 1:
        a, b, c = broadcast(C2A), broadcast(C2B), broadcast(C2C)
        e0, e1, e2, e3, e4 = load(e, 48), load(e, 64), load(e, 80), load(e, 96), load(e, 112)
        gx = gx + a * (y * e0 - z * e3) + two * x * (c * e4 - b * e2)
        gy = gy + a * (x * e0 - z * e1) - two * y * (b * e2 + c * e4)
        gz = gz + four * b * z * e2 - a * (y * e1 + x * e3)
    if degree > 2:
        a, b, c, f, g = broadcast(C3A), broadcast(C3B), broadcast(C3C), broadcast(C3D), broadcast(C3E)
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
    """Write the gradient columns of coefficient k, and its share of the direction gradient."""
    o = 48 * k
    total = load(columns, o) * rgb[0]
    total = fma(load(columns, o + 16), rgb[1], total)
    store(e, 16 * k, fma(load(columns, o + 32), rgb[2], total))
    for channel in range(3):
        store(gradient, o + 16 * channel, basis * rgb[channel])


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
    zero = broadcast(F(0))
    d, inverse = unit_direction(camera, mean)
    coefficients = coefficients_of(evaluated)
    columns, gradient, e = scratch[:768], scratch[768:1536], scratch[1536:]
    if evaluated > 0:
        gather_sh(shN, ids, start, stride, coefficients, columns)
        clear_bands(columns, degree, evaluated)
    k = broadcast(C0)
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
