"""Projection of splats onto the image plane, 16 at a time."""

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, parallel
from nsvq_lightning.compute.rows import clear, load_numbers, load_quats, load_vectors, vector_share
from nsvq_lightning.compute.simd import get, integer, load, put, store
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.formulas import footprint, view_point

# Floats between a lane of vectors and the records that they become.
PROJECTION_SCRATCH = 128 + 16 * rec.RECORD


@parallel
def project_splats(
    part, parts, camera, sampling, means, quats, scales, logits, records, integers, found, counts, slots
):
    """Write the records of the visible splats of a range.

    ``found`` gets a run of rows for each range, ``counts`` how many there are, ``slots`` how many slots they need.
    ``sampling`` are nearest and farthest distances, and the size, or None.
    """
    first, last = vector_share(logits.shape[0], part, parts)
    scratch = simd.scratch(PROJECTION_SCRATCH)
    zero = simd.broadcast(0)
    visible = 0
    needed = 0
    for start in range(first, last, 16):
        count = min(16, last - start)
        mean = load_vectors(means, start, count)
        lanes = (1 << count) - 1
        view = rec.load_view(camera)
        point = view_point(view, mean)
        if simd.mask_bits(point[2] > get(camera, rec.NEAR)) & lanes == 0:
            continue
        quat, scale = load_quats(quats, start, count), load_vectors(scales, start, count)
        logit = load_numbers(logits, start, count)
        trained_at = None
        if sampling is not None:
            nearest, farthest = load_numbers(sampling[0], start, count), load_numbers(sampling[1], start, count)
            trained_at = nearest, farthest, sampling[2]
        screen = get(camera, rec.CX), get(camera, rec.CY), *rec.get3(camera, rec.WIDTH)
        seen, record, corner, end, radius = footprint(view, screen, point, quat, scale, logit, trained_at)
        bits = simd.mask_bits(seen) & lanes
        if bits == 0:
            continue
        color = later = zero, zero, zero
        rows = simd.transpose((*record[: rec.RED], *color, *record[rec.RED :], zero, *later))
        for lane in range(16):
            store(scratch, 128 + 16 * lane, rows[lane])
        for k in range(2):
            store(scratch, 16 * k, corner[k])
            store(scratch, 32 + 16 * k, end[k])
        store(scratch, 64, radius)
        while bits != 0:
            lane = simd.lowest_bit(bits)
            bits &= bits - 1
            row = start + lane
            o = rec.RECORD * row
            store(records, o, load(scratch, 128 + 16 * lane))
            x0, y0 = integer(scratch, lane), integer(scratch, 16 + lane)
            x1, y1 = integer(scratch, 32 + lane), integer(scratch, 48 + lane)
            put(integers, o + rec.SLOT, needed)
            put(integers, o + rec.ORIGIN, x0 | (y0 << 16))
            put(integers, o + rec.EXTENT, (x1 - x0 + 1) | ((y1 - y0 + 1) << 16))
            put(integers, o + rec.RADIUS, np.int64(min(get(scratch, 64 + lane), F(1e9))))
            columns = (x1 >> rec.GROUP_SHIFT) - (x0 >> rec.GROUP_SHIFT) + 1
            needed += columns * ((y1 >> rec.GROUP_SHIFT) - (y0 >> rec.GROUP_SHIFT) + 1)
            put(found, first + visible, row)
            visible += 1
    counts[part], slots[part] = visible, needed


@parallel
def join_runs(part, parts, runs, records, integers, listed, means2d, radii):
    """Join the runs of all ranges into ``ids`` (ascending rows, padded by 16), and number the slots.

    ``runs`` are what :func:`project_splats` found, ``listed`` ids, keys, order and boxes.

    Also writes, by place in ``ids``, the depths as ``keys``, the places themselves as ``order`` and the tiles that a
    splat touches as ``boxes`` (first column and row, number of columns and rows, 16 bits each), and the projected
    centres ``means2d [N·2]`` and ``radii [N]``, 0 for splats that are not visible.
    """
    found, counts, slots = runs
    ids, keys, order, boxes = listed
    total = counts.sum()
    first, last = vector_share(radii.shape[0], part, parts)
    unseen = first
    start, slot = counts[:part].sum(), slots[:part].sum()
    for k in range(counts[part]):
        row = integer(found, first + k)
        clear(means2d, 2 * unseen, 2 * row)
        clear(radii, unseen, row)
        unseen = row + 1
        o = rec.RECORD * row
        put(ids, start + k, row)
        put(integers, o + rec.SLOT, integer(integers, o + rec.SLOT) + slot)
        # Depths are positive, so their bits sort as integers.
        put(keys, start + k, get(integers, o + rec.DEPTH))
        put(order, start + k, start + k)
        extent = integer(integers, o + rec.EXTENT)
        put(boxes, start + k, integer(integers, o + rec.ORIGIN) | (extent << 32))
        put(means2d, 2 * row, get(records, o + rec.X))
        put(means2d, 2 * row + 1, get(records, o + rec.Y))
        put(radii, row, get(integers, o + rec.RADIUS))
    clear(means2d, 2 * unseen, 2 * last)
    clear(radii, unseen, last)
    if start + counts[part] == total and counts[part] > 0:
        for k in range(16):
            put(ids, total + k, get(ids, total - 1))
