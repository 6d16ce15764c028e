"""The data that the kernels pass to one another.

A constant stands to the right of what it multiplies: on the left, Triton's interpreter makes the product a constant.

A *record* is one visible splat on the image plane; records lie front to back. Its exponent is kept as a sum of
squares, ``log2 α = LOG2_OPACITY - u² - v²`` with ``u = A·dx + B·dy`` and ``v = C·dy``: (A, B; 0, C) is the Cholesky
factor of the inverse covariance times √(½·log2 e).

A *slot* holds the gradients that one tile sums for one splat, as moments in (u, v). The slots of a splat are
consecutive, so that its total is summed in one fixed order and no kernel needs an atomic: a render gives the same bits
every time.
"""

from triton.language import constexpr

from nsvq_lightning.rendering import formulas

# Stride between records, or slots, in floats: whole 16-byte words.
RECORD = constexpr(12)
# Floats used in a record or slot.
FIELDS = constexpr(10)
# Stride between slots, in floats, with absolute gradients.
ABSGRAD_SLOT = constexpr(16)
# Floats used in such a slot.
ABSGRAD_FIELDS = constexpr(13)

# Fields of a record.
X, Y, A, B, C, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH = (constexpr(field) for field in range(10))

# Fields of a slot: with h = α·dL/dα, sums over pixels of w·g (colour), h, h·u, h·v, h·u², h·u·v, h·v², w·g (depth) and,
# with absolute gradients, |h·u|, |B·h·u + C·h·v|, w·pixel weight.
SUM_RED, SUM_GREEN, SUM_BLUE, SUM_H, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, SUM_DEPTH, ABS_X, ABS_Y, SUM_WEIGHT = (
    constexpr(field) for field in range(13)
)

# Side of a tile in pixels.
TILE = constexpr(formulas.TILE)
