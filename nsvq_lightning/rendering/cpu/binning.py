"""Which splats touch which tile, front to back: one radix sort by depth, then a stable counting sort into tiles."""

import numpy as np

from nsvq_lightning.compute.jit import in_parallel, inline, kernel
from nsvq_lightning.compute.rows import share
from nsvq_lightning.compute.simd import get, integer, prefetch, put
from nsvq_lightning.rendering.cpu.records import GROUP_SHIFT, GROUP_TILES

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS

# How many splats ahead a box is prefetched.
AHEAD = 16


@inline
def _visit_digits(part, parts, count, source, low, shift, histogram, from_ids, target, to_ids):
    """Count the keys of every digit; or move them, and what belongs to them, to where their digits belong."""
    row = histogram[part]
    if target is None:
        row[:] = 0
    for i in range(*share(count, part, parts)):
        key = get(source, i)
        digit = ((np.int64(key) - low) >> shift) & (DIGITS - 1)
        place = row[digit]
        row[digit] = place + 1
        if target is not None:
            put(target, place, key)
            put(to_ids, place, get(from_ids, i))


@inline
def _starts(histogram):
    """Turn counts ``[parts, kinds]`` into where each begins: kind after kind, part after part; returns their sum."""
    total = 0
    for kind in range(histogram.shape[1]):
        for part in range(histogram.shape[0]):
            here = histogram[part, kind]
            histogram[part, kind] = total
            total += here
    return total


@kernel
def sort_by_depth(parts, count, keys, ids, keys2, ids2, histogram):
    """Stable radix sort of ``ids`` by ``keys`` (bits of positive floats); returns whether the result is in ``ids2``.

    Only the digits in which the keys differ are sorted. ``histogram`` is [parts, DIGITS].
    """
    low, high = np.int64(keys[0]), np.int64(keys[0])
    for i in range(count):
        low, high = min(low, np.int64(keys[i])), max(high, np.int64(keys[i]))
    shift = 0
    swapped = False
    while (high - low) >> shift != 0:
        source, target = (keys2, keys) if swapped else (keys, keys2)
        from_ids, to_ids = (ids2, ids) if swapped else (ids, ids2)
        in_parallel(_visit_digits, parts, (count, source, low, shift, histogram, None, None, None))
        _starts(histogram)
        in_parallel(_visit_digits, parts, (count, source, low, shift, histogram, from_ids, target, to_ids))
        swapped = not swapped
        shift += DIGIT_BITS
    return swapped


@inline
def _visit_tiles(part, parts, count, order, boxes, group_columns, histogram, ids, entries):
    """Count the splats of every tile; or write their rows (``ids``, by place) into its list, keeping the order."""
    row, inside = histogram[part], (1 << GROUP_SHIFT) - 1
    if entries is None:
        row[:] = 0
    first, end = share(count, part, parts)
    for i in range(first, end):
        if i + AHEAD < end:
            coming = integer(order, i + AHEAD)
            prefetch(boxes, coming)
            if entries is not None:
                prefetch(ids, coming)
        place = integer(order, i)
        box = integer(boxes, place)
        x0, y0, columns, rows = box & 0xFFFF, (box >> 16) & 0xFFFF, (box >> 32) & 0xFFFF, box >> 48
        splat_row = None if entries is None else get(ids, place)
        for y in range(y0, y0 + rows):
            for x in range(x0, x0 + columns):
                # Tiles of one group are consecutive.
                group = (y >> GROUP_SHIFT) * group_columns + (x >> GROUP_SHIFT)
                tile = group * GROUP_TILES + ((y & inside) << GROUP_SHIFT) + (x & inside)
                entry = get(row, tile)
                put(row, tile, entry + 1)
                if entries is not None:
                    put(entries, entry, splat_row)


@kernel
def count_tiles(parts, count, order, boxes, group_columns, histogram, offsets):
    """Count the splats that touch each tile: the list of tile t begins at ``offsets[t]``; returns the total length.

    ``order`` holds the places of the visible splats, front to back; ``boxes`` their tiles, by place: first column and
    row, number of columns and rows, 16 bits each. ``histogram`` [parts, tiles] becomes the position of each part's
    first entry in every tile.
    """
    in_parallel(_visit_tiles, parts, (count, order, boxes, group_columns, histogram, None, None))
    total = _starts(histogram)
    for tile in range(histogram.shape[1]):
        offsets[tile] = histogram[0, tile]
    offsets[-1] = total
    return total


@kernel
def fill_tiles(parts, *arguments):
    """Write the row of every splat (``ids``, by place) into the lists of its tiles, keeping the order.

    The arguments are those of :func:`count_tiles` without the offsets, then ``ids`` and the lists.
    """
    in_parallel(_visit_tiles, parts, arguments)
