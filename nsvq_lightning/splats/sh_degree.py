"""How many coefficients each SH degree has; without torch, so that reading a file header is fast."""

from __future__ import annotations

import math

__all__ = ["shN_degree", "sh_coefficients"]


def sh_coefficients(degree: int) -> int:
    """Number of higher spherical-harmonic coefficients per colour channel, (degree + 1)² - 1.

    Raises:
        ValueError: ``degree`` is not in 0..3.
    """
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"the SH degree must be 0, 1, 2 or 3, got {degree}")
    return (degree + 1) ** 2 - 1


def shN_degree(coefficients: int) -> int:
    """Degree that has this many higher coefficients per colour channel.

    Raises:
        ValueError: No degree from 0 to 3 has.
    """
    degree = math.isqrt(max(coefficients, 0) + 1) - 1
    if degree > 3 or sh_coefficients(degree) != coefficients:
        raise ValueError(f"SH degrees 0 to 3 have 0, 3, 8 or 15 higher coefficients, got {coefficients}")
    return degree
