"""Sizes of the synthetic scenes, apart from what builds them: the command line needs the names, not torch."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["SIZES", "Size"]


class Size(NamedTuple):
    """Splats, pixels across and down, and the median length of a splat's axes in scene units."""

    splats: int
    width: int
    height: int
    scale: float


SIZES = {
    "A20k": Size(20_000, 400, 300, 0.0175),
    "B100k": Size(100_000, 800, 533, 0.0100),
    "C500k": Size(500_000, 800, 533, 0.0056),
}
"""The synthetic scenes by name: smaller splats where there are more, as training leaves them."""
