"""Splats in the order that compresses well where a format does not care about it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["spatial_order"]


def spatial_order(means: NDArray[np.float32]) -> NDArray[np.intp]:
    """Numbers ``[N]`` of splats in Morton order of their positions ``[N, 3]``; equal ones stay as they are."""
    from nsvq_lightning.io.morton import AXIS_BITS, Grid, morton_keys  # brings Numba, which readers do without

    cells, _ = Grid.around(means, np.zeros(len(means))).cells(means)
    return morton_keys(cells, np.full(len(means), AXIS_BITS)).argsort(kind="stable")
