"""Spherical harmonics up to degree 3 inside a kernel: colours and their gradients.

The constant coefficients begin at ``first``, the higher ones at ``row``, with three channels each.
"""

import triton
import triton.language as tl
from triton.language import constexpr

from nsvq_lightning.compute.formulas import for_triton
from nsvq_lightning.rendering import formulas as shared

formulas = for_triton(shared)


@triton.jit
def places(SIZE: constexpr):
    """The numbers ``[SIZE]`` of what this program works on, where each program has as many."""
    return tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)


@triton.jit
def load_if(pointer, mask):
    """What a pointer leads to; 0 where the mask is not set."""
    return tl.load(pointer, mask=mask, other=0)


@triton.jit
def load_row(pointer, count, mask):
    """Consecutive floats at each of the pointers."""
    values = ()
    for k in tl.static_range(count):
        values += (load_if(pointer + k, mask),)
    return values


@triton.jit
def store_row(pointer, values, mask):
    """The inverse of :func:`load_row`."""
    for k in tl.static_range(len(values)):
        tl.store(pointer + k, values[k], mask=mask)


@triton.jit
def add_bands(row, first, basis, rgb, mask):
    """Add coefficients from the ``first`` on, counted without the constant one, times basis values to a colour."""
    for k in tl.static_range(len(basis)):
        r, g, b = load_row(row + 3 * (first + k), 3, mask)
        rgb = (rgb[0] + r * basis[k], rgb[1] + g * basis[k], rgb[2] + b * basis[k])
    return rgb


@triton.jit
def color(first, row, d, mask, DEGREE: constexpr):
    """0.5 + Σ coefficient·basis at unit direction d, before the clamp at 0."""
    r, g, b = load_row(first, 3, mask)
    rgb = (r * formulas.C0 + 0.5, g * formulas.C0 + 0.5, b * formulas.C0 + 0.5)
    if DEGREE > 0:
        rgb = add_bands(row, 0, formulas.bands1(d), rgb, mask)
    if DEGREE > 1:
        rgb = add_bands(row, 3, formulas.bands2(d), rgb, mask)
    if DEGREE > 2:
        rgb = add_bands(row, 8, formulas.bands3(d), rgb, mask)
    return rgb


@triton.jit
def put_bands(rows, first, basis, rgb, masks):
    """Store the gradients of coefficients from the ``first`` on; returns those of their basis values.

    These are Σ_channel coefficient·gradient.
    """
    row, g_row = rows
    mask, inside = masks
    gradients = ()
    for k in tl.static_range(len(basis)):
        o = 3 * (first + k)
        store_row(g_row + o, formulas.scale3(basis[k], rgb), inside)
        gradients += (formulas.dot3(load_row(row + o, 3, mask), rgb),)
    return gradients


@triton.jit
def color_backward(g_first, rows, d, rgb, masks, DEGREE: constexpr):
    """Store the gradients of the coefficients from those of the colour; returns that of the direction d.

    ``rows`` are those of the higher coefficients and of their gradients, ``masks`` which coefficients are read, and
    which gradients are written: all inside the table.
    """
    store_row(g_first, formulas.scale3(formulas.C0, rgb), masks[1])
    gradient = (tl.zeros_like(rgb[0]), tl.zeros_like(rgb[0]), tl.zeros_like(rgb[0]))
    if DEGREE > 0:
        gradient = formulas.direction_gradient1(put_bands(rows, 0, formulas.bands1(d), rgb, masks))
    if DEGREE > 1:
        e = put_bands(rows, 3, formulas.bands2(d), rgb, masks)
        gradient = formulas.direction_gradient2(gradient, d, e)
    if DEGREE > 2:
        e = put_bands(rows, 8, formulas.bands3(d), rgb, masks)
        gradient = formulas.direction_gradient3(gradient, d, e)
    return gradient
