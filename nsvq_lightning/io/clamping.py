"""Rounding to the numbers that a format can hold, and a count of the splats that it cannot."""

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Clamped"]

logger = logging.getLogger(__name__)

_ROUNDING = 1e-3
"""Part of an integer that float32 may add to a distance of half a step."""


class Clamped:
    """Rounds values to multiples of a step between two ends; counts the splats that lie beyond, by attribute."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def nearest(
        self,
        name: str,
        values: NDArray[np.floating[Any]],
        ends: tuple[int, int],
        step: int | NDArray[np.int64] = 1,
        codes: NDArray[np.integer] | None = None,
    ) -> NDArray[np.int64]:
        """The nearest integers that the format has.

        Args:
            name: Attribute, for the message.
            values: Numbers ``[K, ...]`` in units of the format, finite.
            ends: Smallest and largest integer of the format.
            step: Only multiples of it are used, and the ends; broadcasts with ``values``.
            codes: Row of ``values`` of each splat ``[N]``; None if row i is that of splat i.

        Returns:
            Integers ``[N, ...]``.
        """
        rounded = np.clip(np.rint(values / step) * step, *ends)
        missed = np.abs(rounded - values) - np.multiply(step, 0.5)
        splats = (missed.reshape(len(values), -1) > _ROUNDING).any(1)
        integers = rounded.astype(np.int64)
        if codes is not None:
            splats, integers = splats[codes], integers[codes]
        self._counts[name] = self._counts.get(name, 0) + int(splats.sum())
        return integers

    def warn(self, path: str | os.PathLike[str], count: int) -> None:
        """Say how many of ``count`` splats were changed because the format does not reach so far."""
        changed = ", ".join(f"{name} {splats}" for name, splats in self._counts.items() if splats)
        if changed:
            logger.warning(
                "%s: out of the range of %s files, moved to its end: %s (of %d splats)",
                os.fspath(path),
                os.path.splitext(path)[1].lower(),
                changed,
                count,
            )
