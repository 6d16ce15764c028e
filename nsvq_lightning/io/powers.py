"""Powers of two as quantization steps: what is rounded to them once stays where it is when it is rounded again."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["coarsest_power", "nearest_power", "power_above", "power_below"]

_MANTISSA_BITS = 24


def power_below(value: float) -> float:
    """The largest power of two that is at most a positive ``value``; exact, unlike a logarithm."""
    return math.ldexp(1.0, math.frexp(value)[1] - 1)


def power_above(value: float) -> float:
    """The smallest power of two that is at least a positive ``value``."""
    below = power_below(value)
    return below if below == value else 2 * below


def nearest_power(value: float) -> float:
    """The power of two whose ratio to a positive ``value`` is between √½ and √2."""
    below = power_below(value)
    return below if value / below <= math.sqrt(2.0) else 2 * below


def coarsest_power(values: NDArray[np.float32]) -> float:
    """The largest power of two of which all ``values`` are integer multiples, 0 if all are 0; they must be finite."""
    mantissas, exponents = np.frexp(values[values != 0])
    if not mantissas.size:
        return 0.0
    wholes = np.ldexp(mantissas, _MANTISSA_BITS).astype(np.int64)
    lowest = (wholes & -wholes).astype(np.float64)  # the lowest bit that is set
    return math.ldexp(1.0, int((np.frexp(lowest)[1] - 1 + exponents).min()) - _MANTISSA_BITS)
