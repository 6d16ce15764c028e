"""The algebra of L1 and D-SSIM, the same code on a CPU and on a GPU (:mod:`nsvq_lightning.compute.formulas`).

p is the image, q the target, in [0, 1]. Their *moments* are p, q, p² + q² and p·q.
"""

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline
from nsvq_lightning.quality.ssim import SSIM_C1, SSIM_C2

C1, C2 = F(SSIM_C1), F(SSIM_C2)


@inline
def clamped(raw):
    """The image clamped to [0, 1]; not by minimum and maximum, since NaN must stay NaN."""
    return simd.where(raw < 0, 0.0, simd.where(raw > 1, 1.0, raw))


@inline
def moments(tap, p, q):
    """The moments of the middle row, times its tap."""
    return tap * p, tap * q, tap * simd.fma(p, p, q * q), tap * (p * q)


@inline
def add_moments(sums, tap, p, q, r, s):
    """Add the moments of two rows that share a tap: (p, q) above and (r, s) below."""
    return (
        simd.fma(tap, p + r, sums[0]),
        simd.fma(tap, q + s, sums[1]),
        simd.fma(tap, simd.fma(p, p, r * r) + simd.fma(q, q, s * s), sums[2]),
        simd.fma(tap, simd.fma(p, q, r * s), sums[3]),
    )


@inline
def similarity(m1, m2, squares, product):
    """SSIM from the blurred moments, and its derivatives with respect to blurred p, p² and p·q."""
    m12 = m1 * m2
    means = simd.fma(m1, m1, m2 * m2)
    variances = squares - means
    covariance = product - m12
    a = simd.fma(2.0, m12, C1)
    d = simd.fma(2.0, covariance, C2)
    e = means + C1
    f = variances + C2
    ef = 1 / (e * f)
    e, f = f * ef, e * ef
    value = a * d * ef
    by_product = 2 * a * ef
    by_square = -(value * f)
    by_mean = 2 * (m2 * d * ef - m1 * value * e - m1 * by_square) - m2 * by_product
    return value, (by_mean, by_square, by_product)


@inline
def pixel_gradient(raw, p, q, derivatives, l1_step, ssim_step):
    """Gradient of the loss from the blurred derivatives of SSIM, 0 where the image was clamped."""
    by_mean, by_square, by_product = derivatives
    g = simd.fma(q, by_product, simd.fma(2 * p, by_square, by_mean))
    sign = simd.where(p > q, l1_step, simd.where(p < q, -l1_step, 0.0))
    return simd.where((raw >= 0) & (raw <= 1), simd.fma(-ssim_step, g, sign), 0.0)
