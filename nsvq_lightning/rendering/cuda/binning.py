"""Which splats touch which tile, front to back: a stable sort of (splat, tile) pairs by tile.

The splats come sorted by depth, so the order inside a tile needs no key of its own: the sort handles 16 bits per
pair instead of 64.
"""

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.compute.rows import sorted_by_key
from nsvq_lightning.rendering.cuda.harmonics import load_if, places


class Tiles(NamedTuple):
    """The lists of all tiles.

    Attributes:
        offsets: Where the list of each tile begins in ``ranks`` ``[tiles + 1]`` int32.
        order: The tiles, those with the longest lists first ``[tiles]`` int32: what starts last should not take long.
        ranks: The splats of the tiles, front to back, as places in the list of splats in view ``[P]`` int32.
        slots: The slot of each of these pairs ``[P]`` int32.
        ends: End (exclusive) of each splat's slots ``[V]`` int32; the slots of a splat are consecutive.
    """

    offsets: Tensor
    order: Tensor
    ranks: Tensor
    slots: Tensor
    ends: Tensor


@triton.jit(do_not_specialize=["total", "count", "halvings"])
def expand_kernel(boxes, ends, keys, owners, total, count, halvings, columns, BLOCK: tl.constexpr):
    """The tile and the splat of every pair; a splat's pairs end at ``ends``."""
    pair = places(BLOCK)
    inside = pair < total
    low, high = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32) + count
    for _ in range(halvings):
        middle = (low + high) // 2
        later = load_if(ends + middle, inside & (low < high)) <= pair
        low, high = tl.where(later & (low < high), middle + 1, low), tl.where(later, high, middle)
    begin = load_if(ends + low - 1, inside & (low > 0))
    box = boxes + 4 * low.to(tl.int64)
    x0, y0 = load_if(box, inside), load_if(box + 1, inside)
    width = tl.load(box + 2, mask=inside, other=1)
    place = (pair - begin).to(tl.int32)
    tile = (y0 + place // width) * columns + x0 + place % width
    tl.store(keys + pair, tile, mask=inside)
    tl.store(owners + pair, low, mask=inside)


def list_tiles(boxes: Tensor, columns: int, rows: int) -> Tiles:
    """List the splats of every tile.

    Args:
        boxes: First column and row, number of columns and rows of the tiles that each splat touches, front to back
            ``[V, 4]`` int32, contiguous.
        columns: Columns of tiles in the image.
        rows: Rows of tiles in the image.

    Raises:
        RuntimeError: There are more pairs than can be numbered.
    """
    ends = (boxes[:, 2].long() * boxes[:, 3]).cumsum(0)
    total = int(ends[-1]) if len(boxes) else 0
    if total >= 2**31:
        raise RuntimeError(
            f"{len(boxes)} splats cover {total} tiles of the {columns}x{rows} in the image, more than can be listed; "
            "the scales have probably diverged (lower their learning rate or prune large splats)"
        )
    return tiles_of(boxes, ends.int(), total, columns, rows)


def tiles_of(boxes: Tensor, ends: Tensor, total: int, columns: int, rows: int) -> Tiles:
    """:func:`list_tiles` where the ends of the splats' slots, and so the number of pairs, are known.

    Raises:
        ValueError: Boxes and ends do not fit together, or are not contiguous.
        TypeError: They are not int32.
    """
    check_fit("boxes [V, 4] int32, ends [V] int32", boxes, ends)
    keys, owners = (boxes.new_empty(total) for _ in range(2))
    if total:
        block = 512  # pairs per program
        expand_kernel[(triton.cdiv(total, block),)](
            boxes, ends, keys, owners, total, len(boxes), len(boxes).bit_length(), columns, BLOCK=block, **COMPILE
        )
    slots, offsets = sorted_by_key(keys, columns * rows)
    order = offsets.diff().argsort(descending=True, stable=True)
    return Tiles(offsets, order.int(), owners[slots], slots.int(), ends)
