"""Rounding to the values that a format can hold, and a count of the splats out of its range."""

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Clamped"]

logger = logging.getLogger(__name__)

_ROUNDING = 1e-3
"""What float32 rounding may add to a distance of one half."""


class Clamped:
    """Rounds and clamps values to a range; counts the splats outside it, by attribute."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def nearest(
        self,
        name: str,
        values: NDArray[np.floating[Any]],
        ends: tuple[int, int],
        uses: NDArray[np.integer] | None = None,
    ) -> NDArray[np.int32]:
        """The nearest integers that the format has.

        Args:
            name: Attribute, for the message.
            values: Values ``[K, ...]`` in units of the format.
            ends: Smallest and largest integer of the format.
            uses: How many splats have each row ``[K]``; one each if None. Rows that no splat uses are not counted.

        Returns:
            Integers ``[K, ...]``.
        """
        rounded = np.clip(np.rint(values), *ends)
        self._count(name, np.abs(rounded - values) > 0.5 + _ROUNDING, uses)
        integers: NDArray[np.int32] = np.nan_to_num(rounded).astype(np.int32)
        return integers

    def within(
        self, name: str, values: NDArray[np.float32], low: float, high: float, uses: NDArray[np.integer] | None = None
    ) -> NDArray[np.float32]:
        """Values ``[K, ...]`` clamped to [``low``, ``high``]; the other arguments are those of :meth:`nearest`."""
        self._count(name, (values < low) | (values > high), uses)
        return np.clip(values, low, high)

    def _count(self, name: str, beyond: NDArray[np.bool_], uses: NDArray[np.integer] | None) -> None:
        rows = np.asarray(beyond).any(tuple(range(1, np.ndim(beyond))))
        self._counts[name] = self._counts.get(name, 0) + int(rows.sum() if uses is None else uses[rows].sum())

    def warn(self, path: str | os.PathLike[str], count: int) -> None:
        """Warn how many of ``count`` splats were clamped to the format's range."""
        changed = ", ".join(f"{name} {splats}" for name, splats in self._counts.items() if splats)
        if changed:
            logger.warning(
                "%s: out of the range of %s files and clamped to it: %s (of %d splats)",
                os.fspath(path),
                os.path.splitext(path)[1].lower(),
                changed,
                count,
            )
