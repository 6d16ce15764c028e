"""Spherical harmonics up to degree 3 inside a kernel: colours and their gradients.

Order and signs are those of :mod:`nsvq_lightning.rendering.sh`. A row of higher coefficients begins at ``shN + base``,
with three channels each.
"""

import triton
import triton.language as tl

from nsvq_lightning.rendering import sh

C0, C1 = tl.constexpr(sh.C0), tl.constexpr(sh.C1)
C2A, C2B, C2C = (tl.constexpr(value) for value in sh.C2)
C3A, C3B, C3C, C3D, C3E = (tl.constexpr(value) for value in sh.C3)


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
def bands1(x, y, z):
    """Basis of degree 1 at the unit direction (x, y, z)."""
    return y * -C1, z * C1, x * -C1


@triton.jit
def bands2(x, y, z):
    """Basis of degree 2."""
    xx, yy, zz = x * x, y * y, z * z
    return x * y * C2A, y * z * -C2A, (zz + zz - xx - yy) * C2B, x * z * -C2A, (xx - yy) * C2C


@triton.jit
def bands3(x, y, z):
    """Basis of degree 3."""
    xx, yy, zz = x * x, y * y, z * z
    around = 4 * zz - xx - yy
    return (
        y * (3 * xx - yy) * -C3A,
        x * y * z * C3B,
        y * around * -C3C,
        z * (zz + zz - 3 * (xx + yy)) * C3D,
        x * around * -C3C,
        z * (xx - yy) * C3E,
        x * (xx - 3 * yy) * -C3A,
    )


@triton.jit
def add_band(shN, base, k, basis, r, g, b, mask):
    """Add coefficient k, counted without the constant one, times its basis value to a colour."""
    cr, cg, cb = load3(shN + base + 3 * k, mask)
    return r + cr * basis, g + cg * basis, b + cb * basis


@triton.jit
def color(sh0, shN, row, base, x, y, z, mask, DEGREE: tl.constexpr):
    """0.5 + Σ coefficient·basis, before the clamp at 0."""
    r, g, b = load3(sh0 + 3 * row, mask)
    r, g, b = r * C0 + 0.5, g * C0 + 0.5, b * C0 + 0.5
    if DEGREE > 0:
        b1 = bands1(x, y, z)
        for k in tl.static_range(3):
            r, g, b = add_band(shN, base, k, b1[k], r, g, b, mask)
    if DEGREE > 1:
        b2 = bands2(x, y, z)
        for k in tl.static_range(5):
            r, g, b = add_band(shN, base, 3 + k, b2[k], r, g, b, mask)
    if DEGREE > 2:
        b3 = bands3(x, y, z)
        for k in tl.static_range(7):
            r, g, b = add_band(shN, base, 8 + k, b3[k], r, g, b, mask)
    return r, g, b


@triton.jit
def put_band(g_shN, shN, base, k, basis, r, g, b, mask, inside):
    """Store the gradient of coefficient k; returns Σ_channel coefficient·gradient, the gradient of the basis value."""
    cr, cg, cb = load3(shN + base + 3 * k, mask)
    store3(g_shN + base + 3 * k, basis * r, basis * g, basis * b, inside)
    return cr * r + cg * g + cb * b


@triton.jit
def color_backward(g_sh0, g_shN, shN, row, base, x, y, z, r, g, b, mask, inside, DEGREE: tl.constexpr):
    """Store the gradients of the coefficients from those of the colour (r, g, b); returns that of the direction.

    Coefficients are read where ``mask`` says, gradients written to all rows ``inside`` the table.
    """
    store3(g_sh0 + 3 * row, r * C0, g * C0, b * C0, inside)
    gx, gy, gz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    if DEGREE > 0:
        b0, b1, b2 = bands1(x, y, z)
        gy -= put_band(g_shN, shN, base, 0, b0, r, g, b, mask, inside) * C1
        gz += put_band(g_shN, shN, base, 1, b1, r, g, b, mask, inside) * C1
        gx -= put_band(g_shN, shN, base, 2, b2, r, g, b, mask, inside) * C1
    if DEGREE > 1:
        b0, b1, b2, b3, b4 = bands2(x, y, z)
        e0 = put_band(g_shN, shN, base, 3, b0, r, g, b, mask, inside) * C2A
        e1 = put_band(g_shN, shN, base, 4, b1, r, g, b, mask, inside) * C2A
        e2 = put_band(g_shN, shN, base, 5, b2, r, g, b, mask, inside) * C2B
        e3 = put_band(g_shN, shN, base, 6, b3, r, g, b, mask, inside) * C2A
        e4 = put_band(g_shN, shN, base, 7, b4, r, g, b, mask, inside) * C2C
        gx += y * e0 - z * e3 + 2 * x * (e4 - e2)
        gy += x * e0 - z * e1 - 2 * y * (e2 + e4)
        gz += 4 * z * e2 - y * e1 - x * e3
    if DEGREE > 2:
        b0, b1, b2, b3, b4, b5, b6 = bands3(x, y, z)
        e0 = put_band(g_shN, shN, base, 8, b0, r, g, b, mask, inside) * C3A
        e1 = put_band(g_shN, shN, base, 9, b1, r, g, b, mask, inside) * C3B
        e2 = put_band(g_shN, shN, base, 10, b2, r, g, b, mask, inside) * C3C
        e3 = put_band(g_shN, shN, base, 11, b3, r, g, b, mask, inside) * C3D
        e4 = put_band(g_shN, shN, base, 12, b4, r, g, b, mask, inside) * C3C
        e5 = put_band(g_shN, shN, base, 13, b5, r, g, b, mask, inside) * C3E
        e6 = put_band(g_shN, shN, base, 14, b6, r, g, b, mask, inside) * C3A
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        gx += yz * e1 - 6 * xy * e0 + 2 * xy * e2 - 6 * xz * e3 - (4 * zz - 3 * xx - yy) * e4
        gx += 2 * xz * e5 - 3 * (xx - yy) * e6
        gy += xz * e1 - 3 * (xx - yy) * e0 - (4 * zz - xx - 3 * yy) * e2 - 6 * yz * e3 + 2 * xy * e4
        gy += 6 * xy * e6 - 2 * yz * e5
        gz += xy * e1 - 8 * (yz * e2 + xz * e4) + 3 * (2 * zz - xx - yy) * e3 + (xx - yy) * e5
    return gx, gy, gz
