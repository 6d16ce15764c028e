"""What the bytes of a file can hold: a count in its head is a claim, and no reader allocates memory on its word alone.

Streams and pictures of equal numbers shrink to nothing: a few kilobytes would otherwise ask for all memory there is. In
scenes, the position alone takes 16 bits or more of a splat, and a whole splat 5 bytes or more in every format.
"""

from __future__ import annotations

from nsvq_lightning.io.errors import FormatError

__all__ = ["FEW_ROWS", "FEW_SPLATS", "check_room"]

FEW_SPLATS = 1 << 20
"""Splats that any file may hold, however short, such as one of equal splats; beyond, each takes a byte or more. So many
are read in less than 1 GB."""
FEW_ROWS = 1 << 16
"""The same for the rows of a codebook in level ``compact`` of ``.nsvq``, and the bytes of its stream."""


def check_room(what: str, count: int, size: int, few: int = FEW_SPLATS) -> None:
    """Refuse more splats, texels or rows than a file or stream of ``size`` bytes can hold.

    Raises:
        FormatError: There are more than ``few``, and more than bytes.
    """
    if count > max(few, size):
        raise FormatError(
            f"truncated or damaged: {count} {what} cannot be in {size} bytes; above {few}, each takes one or more"
        )
