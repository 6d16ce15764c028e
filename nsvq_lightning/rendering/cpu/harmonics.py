"""Colours from spherical harmonics and their backward pass, 16 splats at a time."""

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import inline, parallel
from nsvq_lightning.compute.rows import clear, vector_share
from nsvq_lightning.compute.simd import fma, get, integer, load, prefetch, put, store
from nsvq_lightning.rendering import formulas
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.formulas import C0, bands1, bands2, bands3, unit_direction

# How many splats ahead the rows of a list are prefetched.
AHEAD = 32

# Floats in a row of degree-3 coefficients, which is read in whole vectors.
SH_ROW = 45
# Floats in the columns of 16 rows.
COLUMNS = 16 * 48


@inline
def prefetch_sh(array, ids, start, end, stride, used):
    """Prefetch the SH rows of 16 later splats of the list, ``used`` floats of each."""
    if start < end:
        for lane in range(16):
            row = integer(ids, start + lane) * stride
            for k in range(0, used, 16):
                prefetch(array, row + k)


@inline
def coefficients_of(degree):
    """Floats in an SH row beyond the constant term."""
    return 3 * ((degree + 1) * (degree + 1) - 1)


@inline
def gather_sh(shN, ids, start, stride, count, columns):
    """Gather the first ``count`` coefficients of 16 rows, one vector per column, into the scratch array ``columns``."""
    if stride == SH_ROW:
        for block in range(3 if count > 16 else 1):  # one copy of the code instead of three
            first = min(16 * block, SH_ROW - 16)
            rows = simd.gather_columns(shN, ids, start, stride, first)
            for k in range(16):
                store(columns, 16 * (first + k), rows[k])
    else:
        for lane in range(16):
            row = integer(ids, start + lane) * stride
            for k in range(count):
                put(columns, 16 * k + lane, get(shN, row + k))


@inline
def add_bands(columns, first, basis, rgb):
    """Add coefficients from the ``first`` on, counted without the constant one, times basis values to a colour."""
    for i in range(len(basis)):
        o = 48 * (first + i)
        coefficient = load(columns, o), load(columns, o + 16), load(columns, o + 32)
        rgb = formulas.fma3(basis[i], coefficient, rgb)
    return rgb


@inline
def color(degree, d, sh0, columns):
    """0.5 + Σ coefficient·basis for 16 splats, before the clamp at 0."""
    rgb = fma(sh0[0], C0, 0.5), fma(sh0[1], C0, 0.5), fma(sh0[2], C0, 0.5)
    if degree > 0:
        rgb = add_bands(columns, 0, bands1(d), rgb)
    if degree > 1:
        rgb = add_bands(columns, 3, bands2(d), rgb)
    if degree > 2:
        rgb = add_bands(columns, 8, bands3(d), rgb)
    return rgb


@parallel
def add_colors(part, parts, camera, means, colors, bands, ids, count, records):
    """Write the colours of the visible splats to their records; ``ids`` are padded to whole vectors.

    ``colors`` are sh0 and shN, ``bands`` the floats in a row of shN and the degree that counts.
    """
    first, last = vector_share(count, part, parts)
    scratch = simd.scratch(COLUMNS)
    (sh0, shN), (stride, degree) = colors, bands
    coefficients = coefficients_of(degree)
    for start in range(first, last, 16):
        prefetch_sh(shN, ids, start + AHEAD, last, stride, coefficients)
        mean = simd.gather_rows3(means, ids, start)
        direction, _ = unit_direction(rec.get3(camera, rec.POSITION), mean)
        if degree > 0:
            gather_sh(shN, ids, start, stride, coefficients, scratch)
        rgb = formulas.clamped(color(degree, direction, simd.gather_rows3(sh0, ids, start), scratch))
        for channel in range(3):
            store(scratch, 16 * channel, rgb[channel])
        for lane in range(min(16, last - start)):
            o = rec.record_of(ids, start + lane) + rec.RED
            for channel in range(3):
                put(records, o + channel, get(scratch, 16 * channel + lane))


@inline
def direction_gradient(degree, d, e):
    """dL/d(direction) from the scratch vectors ``e[16·k]`` = Σ_channel coefficient·gradient of each band."""
    g = formulas.direction_gradient1(simd.load_vectors(e, 0)[:3])
    if degree > 1:
        g = formulas.direction_gradient2(g, d, simd.load_vectors(e, 0)[3:8])
    if degree > 2:
        g = formulas.direction_gradient3(g, d, simd.load_vectors(e, 0)[8:15])
    return g


@inline
def put_bands(gradient, e, columns, first, basis, rgb):
    """Write the gradient columns of coefficients from the ``first`` on, and their shares of the direction gradient."""
    for i in range(len(basis)):
        o = 48 * (first + i)
        total = load(columns, o) * rgb[0]
        total = fma(load(columns, o + 16), rgb[1], total)
        store(e, 16 * (first + i), fma(load(columns, o + 32), rgb[2], total))
        for channel in range(3):
            store(gradient, o + 16 * channel, basis[i] * rgb[channel])


@inline
def scatter_sh(gradient, columns, ids, start, stride, count):
    """Write 16 rows of SH gradients from the scratch columns; the inverse of :func:`gather_sh`."""
    if stride == SH_ROW and count == SH_ROW:
        for first in (0, 16, SH_ROW - 16):
            rows = simd.transpose(simd.load_vectors(columns, 16 * first))
            for lane in range(16):
                store(gradient, integer(ids, start + lane) * stride + first, rows[lane])
    else:
        for lane in range(16):
            row = integer(ids, start + lane) * stride
            for k in range(count):
                put(gradient, row + k, get(columns, 16 * k + lane))
            clear(gradient, row + count, row + stride)


@inline
def color_backward(camera, bands, mean, shN, ids, start, rgb, g_sh0, g_shN):
    """Gradients of the SH coefficients; returns that of the mean through the viewing direction."""
    stride, degree = bands
    d, inverse = unit_direction(rec.get3(camera, rec.POSITION), mean)
    coefficients = coefficients_of(degree)
    columns, gradient, e = simd.scratch(COLUMNS), simd.scratch(COLUMNS), simd.scratch(256)
    if degree > 0:
        gather_sh(shN, ids, start, stride, coefficients, columns)
    simd.scatter_rows3(g_sh0, ids, start, formulas.scale3(C0, rgb))
    if degree == 0:
        scatter_sh(g_shN, gradient, ids, start, stride, 0)
        return simd.broadcast(0), simd.broadcast(0), simd.broadcast(0)
    put_bands(gradient, e, columns, 0, bands1(d), rgb)
    if degree > 1:
        put_bands(gradient, e, columns, 3, bands2(d), rgb)
    if degree > 2:
        put_bands(gradient, e, columns, 8, bands3(d), rgb)
    scatter_sh(g_shN, gradient, ids, start, stride, coefficients)
    return formulas.mean_gradient(d, inverse, direction_gradient(degree, d, e))
