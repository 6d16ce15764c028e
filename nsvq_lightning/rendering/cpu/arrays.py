"""Tensors as the arrays that kernels take."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

__all__ = ["Array", "flat"]

Array = np.ndarray[Any, np.dtype[Any]]


def flat(tensor: Tensor) -> Array:
    """The numbers of a tensor on the CPU, row by row: its own memory, or a copy where that is not contiguous."""
    return tensor.detach().contiguous().numpy().reshape(-1)
