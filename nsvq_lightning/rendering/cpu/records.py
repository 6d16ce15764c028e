"""The data that the stages of the CPU back-end pass to one another.

A *record* is one visible splat on the image plane, 16 floats (one cache line), written by the projection at the
splat's own row. Its exponent is kept as a sum of squares, ``log2 α = LOG2_OPACITY - u² - v²`` with ``u = A·dx +
B·dy`` and ``v = C·dy``: (A, B; 0, C) is the Cholesky factor of the inverse covariance times √(½·log2 e). The errors
of the usual conic form are 10 to 40 times larger on needles and on splats of hundreds of pixels.

A *group* is a square of 4x4 tiles of 16x16 pixels, the unit of work of the blend. A *slot* is 16 floats in which one
group sums the gradients of one splat. Slots are numbered splat by splat, so that every splat's total is summed in one
fixed order, whichever thread processed which group: results have the same bits for any number of threads.
"""

import numpy as np

from nsvq_lightning.compute.jit import inline
from nsvq_lightning.compute.memory import Array
from nsvq_lightning.compute.simd import get, integer
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.formulas import TILE

# Floats in a record and in a slot.
RECORD = 16

# Fields of a record.
# SLOPE_X, SLOPE_Y: dy/dx and dx/dy of the exponent's ridges, for the largest value on a rectangle. The last four hold
# integers: first slot; first tile column and row; tile columns and rows (16 bits each); radius in pixels.
X, Y, A, B, C, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH, SLOPE_X, SLOPE_Y, SLOT, ORIGIN, EXTENT, RADIUS = range(RECORD)

# Fields of a slot: with h = α·dL/dα, sums over pixels of w·g (colour), h, h·u, h·v, h·u², h·u·v, h·v², w·g (depth) and,
# with absolute gradients, |h·u|, |B·h·u + C·h·v|, w·pixel weight.
SUM_RED, SUM_GREEN, SUM_BLUE, SUM_H, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV = range(9)
SUM_DEPTH, ABS_X, ABS_Y, SUM_WEIGHT = range(9, 13)

# Elements of the camera array of `pack_camera`.
ROTATION, TRANSLATION, POSITION = 0, 9, 12
FX, FY, CX, CY, LOW_X, HIGH_X, LOW_Y, HIGH_Y, WIDTH, HEIGHT, NEAR = range(15, 26)
# Largest image side in pixels: a record has 16 bits, one of them the sign, for a tile's column or row.
MAX_SIDE = TILE * (2**15 - 1)


def pack_camera(camera: Camera) -> Array:
    """A camera as kernels read it.

    Raises:
        ValueError: The image is too large.
    """
    width, height = camera.size
    if max(width, height) > MAX_SIDE:
        raise ValueError(f"an image side may have {MAX_SIDE} pixels, got {width}x{height}; render it in parts")
    lens = *camera.intrinsics, *camera.slope_limits, width, height, camera.near
    return np.array([*camera.packed_view, *lens], np.float32)


GROUP_SHIFT = 2
# Tiles in a group.
GROUP_TILES = 1 << 2 * GROUP_SHIFT


@inline
def get3(array, offset):
    """Three consecutive numbers."""
    return get(array, offset), get(array, offset + 1), get(array, offset + 2)


@inline
def record_of(rows, i):
    """Where the record of the i-th of some rows begins."""
    return RECORD * integer(rows, i)


@inline
def load_view(camera):
    """The view of :mod:`nsvq_lightning.rendering.formulas`."""
    rotation = get3(camera, ROTATION), get3(camera, ROTATION + 3), get3(camera, ROTATION + 6)
    focal = get(camera, FX), get(camera, FY)
    slopes_x = get(camera, LOW_X), get(camera, HIGH_X)
    slopes_y = get(camera, LOW_Y), get(camera, HIGH_Y)
    return rotation, get3(camera, TRANSLATION), focal, slopes_x, slopes_y
