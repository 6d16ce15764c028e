"""3D vectors for 16 splats at a time, and each thread's share of the splats."""

from __future__ import annotations

from nsvq_lightning.compute.jit import inline
from nsvq_lightning.compute.lanes import broadcast, fma, get
from nsvq_lightning.rendering.cpu.records import ROTATION


@inline
def dot3(ax, ay, az, bx, by, bz):
    """Dot product of two vectors."""
    return fma(ax, bx, fma(ay, by, az * bz))


@inline
def rotate(camera, row, x, y, z):
    """One row of the camera rotation times a vector."""
    o = ROTATION + 3 * row
    return fma(broadcast(get(camera, o)), x, fma(broadcast(get(camera, o + 1)), y, broadcast(get(camera, o + 2)) * z))


@inline
def rotate_back(camera, column, x, y, z):
    """One column of the camera rotation times a vector."""
    o = ROTATION + column
    return fma(broadcast(get(camera, o)), x, fma(broadcast(get(camera, o + 3)), y, broadcast(get(camera, o + 6)) * z))


@inline
def cross(u, v):
    """The vector product u × v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@inline
def vector_range(count, thread, threads):
    """First and end of a thread's share of ``count`` splats: whole vectors, except for the very last one."""
    vectors = (count + 15) // 16
    return 16 * (vectors * thread // threads), min(count, 16 * (vectors * (thread + 1) // threads))
