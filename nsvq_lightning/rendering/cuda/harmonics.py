"""Spherical harmonics up to degree 3 inside a kernel: colours and their gradients.

The constant coefficients begin at ``first``, the higher ones at ``row``, with three channels each.
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
def store3(pointer, values, mask):
    """The inverse of :func:`load3`."""
    tl.store(pointer, values[0], mask=mask)
    tl.store(pointer + 1, values[1], mask=mask)
    tl.store(pointer + 2, values[2], mask=mask)


@triton.jit
def add_band(row, k, basis, rgb, mask):
    """Add coefficient k, counted without the constant one, times its basis value to a colour."""
    r, g, b = load3(row + 3 * k, mask)
    return rgb[0] + r * basis, rgb[1] + g * basis, rgb[2] + b * basis


@triton.jit
def color(first, row, d, mask, DEGREE: tl.constexpr):
    """0.5 + Σ coefficient·basis at unit direction d, before the clamp at 0."""
    r, g, b = load3(first, mask)
    rgb = (r * formulas.C0 + 0.5, g * formulas.C0 + 0.5, b * formulas.C0 + 0.5)
    if DEGREE > 0:
        b1 = formulas.bands1(d)
        for k in tl.static_range(3):
            rgb = add_band(row, k, b1[k], rgb, mask)
    if DEGREE > 1:
        b2 = formulas.bands2(d)
        for k in tl.static_range(5):
            rgb = add_band(row, 3 + k, b2[k], rgb, mask)
    if DEGREE > 2:
        b3 = formulas.bands3(d)
        for k in tl.static_range(7):
            rgb = add_band(row, 8 + k, b3[k], rgb, mask)
    return rgb


@triton.jit
def put_band(rows, k, basis, rgb, masks):
    """Store the gradient of coefficient k; returns Σ_channel coefficient·gradient, the gradient of the basis value."""
    row, g_row = rows
    mask, inside = masks
    store3(g_row + 3 * k, formulas.scale3(basis, rgb), inside)
    return formulas.dot3(load3(row + 3 * k, mask), rgb)


@triton.jit
def color_backward(g_first, rows, d, rgb, masks, DEGREE: tl.constexpr):
    """Store the gradients of the coefficients from those of the colour; returns that of the direction d.

    ``rows`` are those of the higher coefficients and of their gradients, ``masks`` which coefficients are read, and
    which gradients are written: all inside the table.
    """
    store3(g_first, formulas.scale3(formulas.C0, rgb), masks[1])
    gradient = (tl.zeros_like(rgb[0]), tl.zeros_like(rgb[0]), tl.zeros_like(rgb[0]))
    if DEGREE > 0:
        b1 = formulas.bands1(d)
        e1 = (
            put_band(rows, 0, b1[0], rgb, masks),
            put_band(rows, 1, b1[1], rgb, masks),
            put_band(rows, 2, b1[2], rgb, masks),
        )
        gradient = formulas.direction_gradient1(e1)
    if DEGREE > 1:
        b2 = formulas.bands2(d)
        e2 = (
            put_band(rows, 3, b2[0], rgb, masks),
            put_band(rows, 4, b2[1], rgb, masks),
            put_band(rows, 5, b2[2], rgb, masks),
            put_band(rows, 6, b2[3], rgb, masks),
            put_band(rows, 7, b2[4], rgb, masks),
        )
        gradient = formulas.direction_gradient2(gradient, d, e2)
    if DEGREE > 2:
        b3 = formulas.bands3(d)
        e3 = (
            put_band(rows, 8, b3[0], rgb, masks),
            put_band(rows, 9, b3[1], rgb, masks),
            put_band(rows, 10, b3[2], rgb, masks),
            put_band(rows, 11, b3[3], rgb, masks),
            put_band(rows, 12, b3[4], rgb, masks),
            put_band(rows, 13, b3[5], rgb, masks),
            put_band(rows, 14, b3[6], rgb, masks),
        )
        gradient = formulas.direction_gradient3(gradient, d, e3)
    return gradient
