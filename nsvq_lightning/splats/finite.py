"""Which splats are finite: those without NaN or infinite numbers in any attribute."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

__all__ = ["dropped", "finite_rows", "listed"]

_Array = TypeVar("_Array")
"""NumPy arrays, or torch tensors on any device; torch is not imported for the former."""


def finite_rows(attributes: Mapping[str, _Array]) -> tuple[_Array, dict[str, int]]:
    """Which rows are finite in all attributes.

    Args:
        attributes: Arrays or tensors ``[N, ...]`` by name, at least one.

    Returns:
        A boolean mask ``[N]`` and, for each attribute with non-finite rows, how many it has.
    """
    mask: Any = None
    culprits: dict[str, int] = {}
    for name, values in attributes.items():
        array: Any = values
        flags = np.isfinite(array) if isinstance(array, np.ndarray) else array.isfinite()
        good = flags.reshape(len(array), math.prod(array.shape[1:])).all(1)
        mask = good if mask is None else mask & good
        if bad := len(array) - int(good.sum()):
            culprits[name] = bad
    return mask, culprits


def listed(culprits: Mapping[str, int]) -> str:
    """The attributes with non-finite rows, for a message."""
    return ", ".join(f"{name} in {count} rows" for name, count in culprits.items())


def dropped(mask: Any, culprits: Mapping[str, int]) -> str:
    """The warning about rows that are left out, from both results of :func:`finite_rows`."""
    return f"dropped {int((~mask).sum())} of {len(mask)} splats with non-finite values: {listed(culprits)}"
