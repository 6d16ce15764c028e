"""Opacities in [0, 1] and their logits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["finite_logits", "logits_of_bytes", "opacity_of"]

_OPAQUE = 20.0
"""Magnitude of the logit that replaces ±inf: its sigmoid is 1 in float32, and training can still move it."""


def opacity_of(logits: NDArray[np.float32]) -> NDArray[np.float64]:
    """Opacities in [0, 1] of logits of any shape."""
    opacities: NDArray[np.float64] = 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -80, 80)))
    return opacities


def finite_logits(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """The logits with ±20 in place of ±inf, which 0 and 255 become where opacities are stored as bytes."""
    return np.where(np.isinf(logits), np.copysign(np.float32(_OPAQUE), logits), logits)


def logits_of_bytes(levels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Finite logits of opacities given in 255ths."""
    shares = np.arange(256) / 255
    with np.errstate(divide="ignore"):
        table = np.log(shares) - np.log1p(-shares)
    return finite_logits(table.astype(np.float32))[levels]
