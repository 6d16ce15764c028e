"""Sizes of the synthetic scenes, apart from what builds them: the command line needs the names, not torch."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["LARGE", "SIZES", "STANDARD", "Size"]


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
    "D1M": Size(1_000_000, 1600, 1060, 0.0044),
    "E3M": Size(3_000_000, 1600, 1060, 0.0031),
}
"""The synthetic scenes by name: smaller splats where there are more, as training leaves them."""

STANDARD = ("A20k", "B100k", "C500k")
"""Scenes that are measured unless others are named."""

LARGE = ("D1M", "E3M")
"""Scenes that are measured on a GPU besides."""
