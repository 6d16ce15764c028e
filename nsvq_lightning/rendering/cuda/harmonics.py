"""Spherical harmonics up to degree 3 inside a kernel: colours and their gradients.

A row of higher coefficients begins at ``shN + base``,
with three channels each.
"""

import triton
import triton.language as tl

from nsvq_lightning.compute.formulas import for_triton
from nsvq_lightning.rendering import formulas as shared

formulas = for_triton(shared)


@triton.jit
def load3(pointer, mask):
    """Three consecutive floats at each of the pointers."""
    a = tl.load(pointer, mask=mask, other=0.0)
    b = tl.load(pointer + 1, mask=mask, other=0.0)
    c = tl.load(pointer + 2, mask=mask, other=0.0)
    return a, b, c


@triton.jit
def store3(pointer, a, b, c, mask):
    """The inverse of :func:`load3`."""
    tl.store(pointer, a, mask=mask)
    tl.store(pointer + 1, b, mask=mask)
    tl.store(pointer + 2, c, mask=mask)


@triton.jit
def add_band(shN, base, k, basis, r, g, b, mask):
    """Add coefficient k, counted without the constant one, times its basis value to a colour."""
    cr, cg, cb = load3(shN + base + 3 * k, mask)
    return r + cr * basis, g + cg * basis, b + cb * basis


@triton.jit
def color(sh0, shN, row, base, d, mask, DEGREE: tl.constexpr):
    """0.5 + Σ coefficient·basis at unit direction d, before the clamp at 0."""
    r, g, b = load3(sh0 + 3 * row, mask)
    r, g, b = r * formulas.C0 + 0.5, g * formulas.C0 + 0.5, b * formulas.C0 + 0.5
    if DEGREE > 0:
        b1 = formulas.bands1(d)
        for k in tl.static_range(3):
            r, g, b = add_band(shN, base, k, b1[k], r, g, b, mask)
    if DEGREE > 1:
        b2 = formulas.bands2(d)
        for k in tl.static_range(5):
            r, g, b = add_band(shN, base, 3 + k, b2[k], r, g, b, mask)
    if DEGREE > 2:
        b3 = formulas.bands3(d)
        for k in tl.static_range(7):
            r, g, b = add_band(shN, base, 8 + k, b3[k], r, g, b, mask)
    return r, g, b


@triton.jit
def put_band(g_shN, shN, base, k, basis, rgb, mask, inside):
    """Store the gradient of coefficient k; returns Σ_channel coefficient·gradient, the gradient of the basis value."""
    store3(g_shN + base + 3 * k, basis * rgb[0], basis * rgb[1], basis * rgb[2], inside)
    return formulas.dot3(load3(shN + base + 3 * k, mask), rgb)


@triton.jit
def color_backward(g_sh0, g_shN, shN, row, base, d, rgb, mask, inside, DEGREE: tl.constexpr):
    """Store the gradients of the coefficients from those of the colour; returns that of the direction d.

    Coefficients are read where ``mask`` says, gradients written to all rows ``inside`` the table.
    """
    r, g, b = formulas.scale3(formulas.C0, rgb)
    store3(g_sh0 + 3 * row, r, g, b, inside)
    gradient = (tl.zeros_like(r), tl.zeros_like(r), tl.zeros_like(r))
    if DEGREE > 0:
        b0, b1, b2 = formulas.bands1(d)
        e0 = put_band(g_shN, shN, base, 0, b0, rgb, mask, inside)
        e1 = put_band(g_shN, shN, base, 1, b1, rgb, mask, inside)
        e2 = put_band(g_shN, shN, base, 2, b2, rgb, mask, inside)
        gradient = formulas.direction_gradient1((e0, e1, e2))
    if DEGREE > 1:
        b0, b1, b2, b3, b4 = formulas.bands2(d)
        e0 = put_band(g_shN, shN, base, 3, b0, rgb, mask, inside)
        e1 = put_band(g_shN, shN, base, 4, b1, rgb, mask, inside)
        e2 = put_band(g_shN, shN, base, 5, b2, rgb, mask, inside)
        e3 = put_band(g_shN, shN, base, 6, b3, rgb, mask, inside)
        e4 = put_band(g_shN, shN, base, 7, b4, rgb, mask, inside)
        gradient = formulas.direction_gradient2(gradient, d, (e0, e1, e2, e3, e4))
    if DEGREE > 2:
        b0, b1, b2, b3, b4, b5, b6 = formulas.bands3(d)
        e0 = put_band(g_shN, shN, base, 8, b0, rgb, mask, inside)
        e1 = put_band(g_shN, shN, base, 9, b1, rgb, mask, inside)
        e2 = put_band(g_shN, shN, base, 10, b2, rgb, mask, inside)
        e3 = put_band(g_shN, shN, base, 11, b3, rgb, mask, inside)
        e4 = put_band(g_shN, shN, base, 12, b4, rgb, mask, inside)
        e5 = put_band(g_shN, shN, base, 13, b5, rgb, mask, inside)
        e6 = put_band(g_shN, shN, base, 14, b6, rgb, mask, inside)
        gradient = formulas.direction_gradient3(gradient, d, (e0, e1, e2, e3, e4, e5, e6))
    return gradient
