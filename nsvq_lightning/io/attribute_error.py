"""How far the values in a file are from those of the scene that it was written from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.io.opacity import opacity_of
from nsvq_lightning.splats.arrays import SplatArrays
from nsvq_lightning.splats.conventions import unit

__all__ = ["attribute_errors"]


def attribute_errors(read: SplatArrays, written: SplatArrays) -> dict[str, float]:
    """Root mean square errors over the splats, by quantity.

    Args:
        read: What the file holds, N splats.
        written: What it was written from, the same splats in the same order; spherical-harmonic coefficients that
            the file does not hold count as 0.

    Returns:
        ``position`` in scene units, ``rotation`` in degrees, ``log-scale``, ``opacity`` in [0, 1], and the coefficients
        ``sh0`` and ``shN``; 0 where there is nothing to compare.
    """
    units, others = unit(read.quats), unit(written.quats)
    nearer = np.minimum(np.linalg.norm(units - others, axis=1), np.linalg.norm(units + others, axis=1))
    kept = read.shN.shape[1]
    return {
        "position": _root_mean_square(read.means - written.means.astype(np.float64)),
        "rotation": _root_mean_square(np.degrees(4 * np.arcsin(np.minimum(nearer / 2, 1)))),
        "log-scale": _root_mean_square(read.scales - written.scales.astype(np.float64)),
        "opacity": _root_mean_square(opacity_of(read.opacities) - opacity_of(written.opacities)),
        "sh0": _root_mean_square(read.sh0 - written.sh0.astype(np.float64)),
        "shN": _root_mean_square(
            np.concatenate([read.shN - written.shN[:, :kept], written.shN[:, kept:]], axis=1, dtype=np.float64)
        ),
    }


def _root_mean_square(errors: NDArray[np.floating[Any]]) -> float:
    return float(np.sqrt(np.mean(np.square(errors)))) if errors.size else 0.0
