"""Which splats touch which tile, front to back: a stable sort of (splat, tile) pairs by tile.

The splats come sorted by depth, so the order inside a tile needs no key of its own: the sort handles 16 bits per
pair instead of 64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Tiles", "list_tiles"]

MAX_PAIRS = 2**31 - 1


class Tiles(NamedTuple):
    """The lists of all tiles.

    Attributes:
        offsets: Where the list of each tile begins in ``ranks`` ``[tiles + 1]`` int32.
        ranks: The splats of the tiles, front to back, as places in the list of splats in view ``[P]`` int32.
        slots: The slot of each of these pairs ``[P]`` int32.
        ends: End (exclusive) of each splat's slots ``[V]`` int32; the slots of a splat are consecutive.
    """

    offsets: Tensor
    ranks: Tensor
    slots: Tensor
    ends: Tensor


def list_tiles(boxes: Tensor, columns: int, rows: int) -> Tiles:
    """List the splats of every tile.

    Args:
        boxes: First column and row, number of columns and rows of the tiles that each splat touches, front to back
            ``[V, 4]``.
        columns: Columns of tiles in the image.
        rows: Rows of tiles in the image.

    Raises:
        RuntimeError: There are more pairs than can be numbered.
    """
    device, tiles = boxes.device, columns * rows
    x0, y0, nx, ny = boxes.unbind(1)
    ends = (nx.long() * ny).cumsum(0)
    total = int(ends[-1]) if len(boxes) else 0
    if total > MAX_PAIRS:
        raise RuntimeError(
            f"{len(boxes)} splats cover {total} tiles of the {columns}x{rows} in the image, more than can be listed; "
            "the scales have probably diverged (lower their learning rate or prune large splats)"
        )
    ends = ends.int()
    counts = nx * ny
    owners = torch.repeat_interleave(counts, output_size=total)
    place = torch.arange(total, dtype=torch.int32, device=device) - (ends - counts)[owners]
    width = nx[owners]
    tile = (y0[owners] + place // width) * columns + x0[owners] + place % width
    # 16-bit keys take a quarter of the sorting passes of 64-bit ones.
    key = torch.int16 if tiles < 2**15 else torch.int32
    keys, slots = tile.to(key).sort(stable=True)
    offsets = torch.searchsorted(keys, torch.arange(tiles + 1, dtype=key, device=device), out_int32=True)
    return Tiles(offsets, owners[slots].int(), slots.int(), ends)
