"""Front-to-back blending of sorted splats and its backward pass, with one vector per 4x4 block of pixels.

Forward: a tile takes its splats in batches; an exact test finds which of its 16 blocks each splat can reach, then
each block runs through its own splats, four at a time, with transmittance and colour in registers. Nothing branches
on a single pixel: a closed (finished) one keeps losing transmittance, and a splat counts only where the transmittance
after it is still above the threshold. The blocks that a splat was blended into are kept as a 16-bit mask for the
backward pass, which goes through the splats once more from front to back:
with d = g·colour and ``rest`` = what this splat and all after it (and the background) add to g·image, dL/dα =
(T·d - rest)/(1 - α), so neither the last contributor nor any atomic operation is needed.
"""

import numpy as np

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline, parallel
from nsvq_lightning.compute.rows import clear_between, share
from nsvq_lightning.compute.simd import fma, fnma, get, integer, load, prefetch, put, store
from nsvq_lightning.rendering import formulas
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.cpu.records import RECORD, get3, record_of
from nsvq_lightning.rendering.formulas import TILE, TRANSMITTANCE_MIN, TWO_LN2, dot3, exponent, fma3

BATCH = 128
BLOCKS = 16
BLOCK_SIDE = 4

# Planes of the per-thread scratch of the forward pass, with one vector per block: T keeps falling once a pixel is
# closed, T_LEFT is the transmittance that the image keeps.
T, T_LEFT, R_SUM, G_SUM, B_SUM, Z_SUM = (256 * plane for plane in range(6))
# Vectors of one block in the scratch of the backward pass.
BACK_T, BACK_REST, BACK_RED, BACK_GREEN, BACK_BLUE, BACK_DEPTH, BACK_WEIGHT, BACK_X, BACK_Y = range(0, 16 * 9, 16)
BLOCK_STATE = 16 * 9
# Lower bound on the transmittance of closed pixels: far below the threshold, far above denormal numbers.
TINY = F(1e-20)
# How many entries ahead a record is prefetched.
AHEAD = 24


def pixel_grid() -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """Pixel centres in a tile: x of block k at 16·k, y at 256 + 16·k; first x and y of the blocks at 512 and 528."""
    block, lane = np.arange(BLOCKS)[:, None], np.arange(16)[None]
    x = (block % 4) * BLOCK_SIDE + lane % 4 + 0.5
    y = (block // 4) * BLOCK_SIDE + lane // 4 + 0.5
    return np.concatenate([x.ravel(), y.ravel(), x[:, 0], y[:, 0]]).astype(np.float32)


FORWARD_SCRATCH = 6 * 256 + (BATCH + 1) * RECORD
BACKWARD_SCRATCH = BLOCKS * BLOCK_STATE


@inline
def pixels_of(grid, block):
    """Pixel centres of a block, x and y."""
    return load(grid, 16 * block), load(grid, 256 + 16 * block)


@inline
def block_corner(block, corner):
    """Left and top pixel of a block of the tile at ``corner``."""
    return corner[0] + (block & 3) * BLOCK_SIDE, corner[1] + (block >> 2) * BLOCK_SIDE


@inline
def in_tile(records, r, corner):
    """Centre of a splat in a tile, and A, B and C of its record with u0 and v0.

    The factors of its exponent are u = A·x + B·y + u0 and v = C·y + v0.
    """
    a, b, c = get3(records, r + rec.A)
    x, y = get(records, r + rec.X) - F(corner[0]), get(records, r + rec.Y) - F(corner[1])
    return x, y, (a, b, c, -(a * x + b * y), -(c * y))


# How far below the threshold, in log2 α, a block still counts as reached: what rounding can add to the exponent of a
# pixel, so that culling blocks changes no bit. It lets one block in a thousand more through.
REACH_MARGIN = F(2.0**-8)


@inline
def reachable_blocks(batch, o, x, y, grid):
    """Mask of the blocks of a tile in which a splat can reach α = 1/255."""
    left = load(grid, 512) - x
    top = load(grid, 528) - y
    right, bottom = left + F(BLOCK_SIDE - 1), top + F(BLOCK_SIDE - 1)
    # The largest value of -(u² + v²) on a block lies on the edges that face the splat's centre.
    dx = simd.maximum(left, simd.minimum(right, 0))
    dy = simd.maximum(top, simd.minimum(bottom, 0))
    along_y = simd.maximum(top, simd.minimum(bottom, get(batch, o + rec.SLOPE_X) * dx))
    along_x = simd.maximum(left, simd.minimum(right, get(batch, o + rec.SLOPE_Y) * dy))
    a, b, c = get3(batch, o + rec.A)
    first, _, _ = exponent(a, b, c, 0, 0, 0, dx, along_y)
    second, _, _ = exponent(a, b, c, 0, 0, 0, along_x, dy)
    peak = simd.maximum(first, second)
    return simd.mask_bits(peak >= formulas.LOG2_ALPHA_MIN - REACH_MARGIN - get(batch, o + rec.LOG2_OPACITY))


@inline
def alpha_at(batch, r, x, y):
    """α of one splat of a batch on a block of pixels, 0 below 1/255; a batch holds (u0, v0) in place of the centre."""
    a, b, c = get3(batch, r + rec.A)
    u0, v0, peak = get(batch, r + rec.X), get(batch, r + rec.Y), get(batch, r + rec.LOG2_OPACITY)
    power, _, _ = exponent(a, b, c, u0, v0, peak, x, y)
    _, alpha = formulas.alpha_of(power)
    return alpha


@inline
def waiting(touched, first, count, block):
    """Bits of those of the next 64 splats that reach a block; only the first ``count`` belong to the batch."""
    if count <= 0:
        return np.int64(0)
    bits = simd.column_bits(touched, first, block)
    return bits if count >= 64 else bits & ((1 << count) - 1)


@inline
def next_splat(queue):
    """Take the lowest set bit of a queue of 128; the position is 128 if there is none."""
    low, high, base = queue
    if low == 0:
        low, high, base = high, np.int64(0), np.int64(64)
    return base + simd.lowest_bit(low), (low & (low - 1), high, base)


@inline
def blend_one(batch, r, alpha, t, after, kept):
    """Add one splat where it leaves the pixel open; ``kept``: the transmittance left, sums of colour and of depth."""
    left, color, depth = kept
    open_ = after >= TRANSMITTANCE_MIN
    weight = simd.where(open_, alpha * t, 0)
    color = fma3(weight, get3(batch, r + rec.RED), color)
    depth = fma(weight, get(batch, r + rec.DEPTH), depth)
    return simd.where(open_, after, left), color, depth


@inline
def load_color(state, o):
    """Sums of colour of one block in the scratch of the forward pass."""
    return load(state, R_SUM + o), load(state, G_SUM + o), load(state, B_SUM + o)


@inline
def store_color(state, o, color):
    """The inverse of :func:`load_color`."""
    for channel in range(3):
        store(state, R_SUM + 256 * channel + o, color[channel])


@inline
def blend_block(block, count, batch, grid, state, touched, first):
    """Blend a batch into one block; returns the block's bit, or 0 once all its pixels are closed."""
    o = 16 * block
    t = load(state, T + o)
    kept = load(state, T_LEFT + o), load_color(state, o), load(state, Z_SUM + o)
    x, y = pixels_of(grid, block)
    bit = 1 << block
    queue = waiting(touched, first, count, block), waiting(touched, first + 64, count - 64, block), np.int64(0)
    while queue[0] | queue[1] != 0:
        j0, queue = next_splat(queue)
        j1, queue = next_splat(queue)
        j2, queue = next_splat(queue)
        j3, queue = next_splat(queue)
        r0, r1, r2, r3 = RECORD * j0, RECORD * j1, RECORD * j2, RECORD * j3
        a0, a1 = alpha_at(batch, r0, x, y), alpha_at(batch, r1, x, y)
        a2, a3 = alpha_at(batch, r2, x, y), alpha_at(batch, r3, x, y)
        t1 = fnma(a0, t, t)
        t2 = fnma(a1, t1, t1)
        t3 = fnma(a2, t2, t2)
        t4 = fnma(a3, t3, t3)
        kept = blend_one(batch, r0, a0, t, t1, kept)
        kept = blend_one(batch, r1, a1, t1, t2, kept)
        kept = blend_one(batch, r2, a2, t2, t3, kept)
        kept = blend_one(batch, r3, a3, t3, t4, kept)
        if simd.mask_bits(t4 >= TRANSMITTANCE_MIN) == 0:
            for j in range(j3 + 1, count):
                put(touched, first + j, get(touched, first + j) & ~bit)
            bit = 0
            queue = np.int64(0), np.int64(0), np.int64(0)
        # The transmittance of closed pixels keeps falling; keep it clear of denormals.
        t = simd.maximum(t4, TINY)
    store(state, T + o, t)
    left, color, depth = kept
    store(state, T_LEFT + o, left)
    store_color(state, o, color)
    store(state, Z_SUM + o, depth)
    return bit


@inline
def write_block(block, corner, size, background, state, planes):
    """Add the background and write one block, pixel by pixel where it extends beyond the image."""
    width, height = size
    image, transmittance, depth = planes
    o = 16 * block
    x0, y0 = block_corner(block, corner)
    t = load(state, T_LEFT + o)
    color = fma3(t, get3(background, 0), load_color(state, o))
    if x0 + BLOCK_SIDE <= width and y0 + BLOCK_SIDE <= height:
        pixel = y0 * width + x0
        simd.store_block3(image, 3 * pixel, 3 * width, color)
        simd.store_block1(transmittance, pixel, width, (t,))
        simd.store_block1(depth, pixel, width, (load(state, Z_SUM + o),))
        return
    store_color(state, o, color)
    for lane in range(16):
        x, y = x0 + (lane & 3), y0 + (lane >> 2)
        if x < width and y < height:
            pixel = y * width + x
            s = o + lane
            put(transmittance, pixel, get(state, T_LEFT + s))
            put(depth, pixel, get(state, Z_SUM + s))
            for channel in range(3):
                put(image, 3 * pixel + channel, get(state, R_SUM + 256 * channel + s))


@inline
def tile_corner(tile, group_columns):
    """Left and top pixel of a tile."""
    group, inside = tile // rec.GROUP_TILES, tile % rec.GROUP_TILES
    side = 1 << rec.GROUP_SHIFT
    x = (group % group_columns) * side + inside % side
    y = (group // group_columns) * side + inside // side
    return x * TILE, y * TILE


@parallel
def blend(
    tile, tiles, records, entries, offsets, group_columns, size, background, grid, touched, ends, planes, cull_blocks
):  # fmt: skip
    """Blend a tile; a pixel depends only on its own one.

    ``ends`` gets the end of the part of its list that was processed. ``size`` is width and height, ``planes`` are
    image, transmittance and depth. ``cull_blocks`` says whether to skip the blocks that a splat cannot reach.
    """
    begin, end = np.int64(offsets[tile]), np.int64(offsets[tile + 1])
    corner, state = tile_corner(tile, group_columns), simd.scratch(FORWARD_SCRATCH)
    columns, rows = F(size[0] - corner[0]), F(size[1] - corner[1])
    alive = 0
    for block in range(BLOCKS):
        x, y = pixels_of(grid, block)
        inside = (x < columns) & (y < rows)
        full = simd.where(inside, 1, 0)
        store(state, T + 16 * block, full)
        store(state, T_LEFT + 16 * block, full)
        for plane in range(2, 6):
            store(state, 256 * plane + 16 * block, 0)
        if simd.mask_bits(inside) != 0:
            alive |= 1 << block
    batch = state[6 * 256 :]
    # A record without effect, which fills up the last group of four.
    store(batch, BATCH * RECORD, 0)
    put(batch, BATCH * RECORD + rec.LOG2_OPACITY, F(-100))
    for i in range(begin, min(end, begin + AHEAD)):
        prefetch(records, record_of(entries, i))
    i = begin
    while i < end and alive != 0:
        count = min(BATCH, end - i)
        reached = 0
        for j in range(count):
            if i + j + AHEAD < end:
                prefetch(records, record_of(entries, i + j + AHEAD))
            r = record_of(entries, i + j)
            o = RECORD * j
            store(batch, o, load(records, r))
            center_x, center_y, (_, _, _, u0, v0) = in_tile(records, r, corner)
            mask = alive
            if cull_blocks:
                mask &= reachable_blocks(batch, o, center_x, center_y, grid)
            put(batch, o + rec.X, u0)
            put(batch, o + rec.Y, v0)
            put(touched, i + j, mask)
            reached |= mask
        while reached != 0:
            block = simd.lowest_bit(reached)
            reached &= reached - 1
            if blend_block(block, count, batch, grid, state, touched, i) == 0:
                alive &= ~(1 << block)
        i += count
    for block in range(BLOCKS):
        write_block(block, corner, size, background, state, planes)
    ends[tile] = i


@inline
def start_block(block, corner, size, planes, gradients, pixel_weights, wanted, grid, state):
    """Backward state of a block: transmittance 1, and ``rest`` = g · everything that this pixel received.

    Alpha is 1 - T, so its gradient enters as -g_alpha·T at the far end. Gradients that are not needed are not read, nor
    is a map.
    """
    width, height = size
    image, transmittance, depth = planes
    g_image, g_alpha, g_depth = gradients
    with_alpha, with_depth, with_absgrad = wanted
    s = BLOCK_STATE * block
    x0, y0 = block_corner(block, corner)
    x, y = pixels_of(grid, block)
    store(state, s + BACK_X, x)
    store(state, s + BACK_Y, y)
    if x0 + BLOCK_SIDE <= width and y0 + BLOCK_SIDE <= height:
        pixel = y0 * width + x0
        g = simd.load_block3(g_image, 3 * pixel, 3 * width)
        rest = dot3(g, simd.load_block3(image, 3 * pixel, 3 * width))
        if with_alpha:
            kept = simd.load_block1(transmittance, pixel, width)[0]
            rest = fnma(simd.load_block1(g_alpha, pixel, width)[0], kept, rest)
        if with_depth:
            far = simd.load_block1(g_depth, pixel, width)[0]
            store(state, s + BACK_DEPTH, far)
            rest = fma(far, simd.load_block1(depth, pixel, width)[0], rest)
        if with_absgrad:
            store(state, s + BACK_WEIGHT, simd.load_block1(pixel_weights, pixel, width)[0])
        store(state, s + BACK_T, 1)
        store(state, s + BACK_REST, rest)
        for channel in range(3):
            store(state, s + BACK_RED + 16 * channel, g[channel])
        return
    for part in range(0, BACK_X, 16):
        store(state, s + part, 0)
    for lane in range(16):
        column, row = x0 + (lane & 3), y0 + (lane >> 2)
        if column < width and row < height:
            pixel = row * width + column
            o = s + lane
            rest = F(0)
            if with_alpha:
                rest -= get(g_alpha, pixel) * get(transmittance, pixel)
            for channel in range(3):
                gradient = get(g_image, 3 * pixel + channel)
                put(state, o + BACK_RED + 16 * channel, gradient)
                rest += gradient * get(image, 3 * pixel + channel)
            if with_depth:
                put(state, o + BACK_DEPTH, get(g_depth, pixel))
                rest += get(g_depth, pixel) * get(depth, pixel)
            if with_absgrad:
                put(state, o + BACK_WEIGHT, get(pixel_weights, pixel))
            put(state, o + BACK_REST, rest)
            put(state, o + BACK_T, F(1))


@inline
def slot_of(integers, row, group):
    """The slot in which a group sums the gradients of a splat."""
    o = RECORD * row
    origin, extent = integer(integers, o + rec.ORIGIN), integer(integers, o + rec.EXTENT)
    x0, y0 = origin & 0xFFFF, origin >> 16
    first_x, first_y = x0 >> rec.GROUP_SHIFT, y0 >> rec.GROUP_SHIFT
    columns = ((x0 + (extent & 0xFFFF) - 1) >> rec.GROUP_SHIFT) - first_x + 1
    return integer(integers, o + rec.SLOT) + (group[1] - first_y) * columns + group[0] - first_x


@inline
def splat_backward(records, row, blocks, corner, wanted, state):
    """Sums of one splat over the blocks it changed in a tile (the fields of a slot); advances the blocks' state."""
    _, with_depth, with_absgrad = wanted
    zero = simd.broadcast(0)
    r = RECORD * row
    _, _, (a, b, c, u0, v0) = in_tile(records, r, corner)
    peak = get(records, r + rec.LOG2_OPACITY)
    z = get(records, r + rec.DEPTH)
    color = get3(records, r + rec.RED)
    s_color = s_squares = zero, zero, zero
    s_h, s_u, s_v, s_z = zero, zero, zero, zero
    s_ax, s_ay, s_map = zero, zero, zero
    while blocks != 0:
        s = BLOCK_STATE * simd.lowest_bit(blocks)
        blocks &= blocks - 1
        power, u, v = exponent(a, b, c, u0, v0, peak, load(state, s + BACK_X), load(state, s + BACK_Y))
        g = load(state, s + BACK_RED), load(state, s + BACK_GREEN), load(state, s + BACK_BLUE)
        d = dot3(g, color)
        if with_depth:
            d = fma(load(state, s + BACK_DEPTH), z, d)
        t = load(state, s + BACK_T)
        rest = load(state, s + BACK_REST)
        raw, alpha, after, open_, weight = formulas.blend_step(power, t)
        store(state, s + BACK_REST, fnma(weight, d, rest))
        store(state, s + BACK_T, simd.maximum(after, TINY))
        h = simd.where(open_ & (raw <= formulas.ALPHA_MAX), alpha / (1 - alpha) * (t * d - rest), 0)
        s_color = fma3(weight, g, s_color)
        hu, hv = h * u, h * v
        s_h, s_u, s_v = s_h + h, s_u + hu, s_v + hv
        s_uu, s_uv, s_vv = s_squares
        s_squares = fma(hu, u, s_uu), fma(hu, v, s_uv), fma(hv, v, s_vv)
        if with_depth:
            s_z = fma(weight, load(state, s + BACK_DEPTH), s_z)
        if with_absgrad:
            along_y = fma(b, hu, c * hv)
            s_ax = s_ax + simd.abs(hu)
            s_ay = s_ay + simd.abs(along_y)
            s_map = fma(weight, load(state, s + BACK_WEIGHT), s_map)
    return simd.lane_sums((*s_color, s_h, s_u, s_v, *s_squares, s_z, s_ax, s_ay, s_map))


# How many entries ahead a slot is prefetched, whose number is in the record: later than that.
SLOT_AHEAD = 10


@inline
def tile_backward(records, integers, entries, begin, end, corner, group, wanted, touched, sums, state):
    """Add up the gradients of all splats of a tile, front to back."""
    for i in range(begin, end):
        if i + AHEAD < end:
            prefetch(records, record_of(entries, i + AHEAD))
        if i + SLOT_AHEAD < end:
            prefetch(sums, RECORD * slot_of(integers, integer(entries, i + SLOT_AHEAD), group))
        blocks = integer(touched, i)
        if blocks == 0:
            continue
        row = integer(entries, i)
        slot = RECORD * slot_of(integers, row, group)
        store(sums, slot, load(sums, slot) + splat_backward(records, row, blocks, corner, wanted, state))


@parallel
def blend_backward(
    place, groups, order, records, integers, entries, offsets, ends, group_columns, size, grid, touched, planes,
    gradients, pixel_weights, wanted, sums,
):  # fmt: skip
    """Add the sums of every (splat, group) pair of one group to its slot, in one order.

    ``order`` lists the groups, those with most to do first. ``sums`` must be 0. ``size`` and ``planes`` are those of
    :func:`blend`, ``gradients`` those of image, alpha and depth; ``wanted`` says whether alpha and depth have one, and
    whether there is a map.
    """
    group = np.int64(order[place])
    at = group % group_columns, group // group_columns
    state = simd.scratch(BACKWARD_SCRATCH)
    for tile in range(rec.GROUP_TILES * group, rec.GROUP_TILES * (group + 1)):
        begin, end = np.int64(offsets[tile]), np.int64(ends[tile])
        if end <= begin:
            continue
        corner = tile_corner(tile, group_columns)
        for block in range(BLOCKS):
            start_block(block, corner, size, planes, gradients, pixel_weights, wanted, grid, state)
        tile_backward(records, integers, entries, begin, end, corner, at, wanted, touched, sums, state)


@parallel
def total_slots(part, parts, ids, slots, records, integers, sums, g_means2d, with_absgrad, absgrad):
    """Add up the slots of each splat into its first one, and derive the gradient of the projected centre ``[N·2]``.

    It is 0 for splats that are not visible.

    ``with_absgrad`` also writes sums over the pixels ``[N·3]``: Σ |∂L/∂x|, Σ |∂L/∂y| and Σ weight · pixel weight.
    """
    count = ids.shape[0]
    for i in range(*share(count, part, parts)):
        row = integer(ids, i)
        clear_between(ids, i, 2, g_means2d)
        if with_absgrad:
            clear_between(ids, i, 3, absgrad)
        r = RECORD * row
        slot = integer(integers, r + rec.SLOT)
        end = np.int64(slots)
        if i + 1 < count:
            end = integer(integers, record_of(ids, i + 1) + rec.SLOT)
        o = RECORD * slot
        if end > slot + 1:
            total = load(sums, o)
            for other in range(slot + 1, end):
                total = total + load(sums, RECORD * other)
            store(sums, o, total)
        u, v = get(sums, o + rec.SUM_U), get(sums, o + rec.SUM_V)
        a, b, c = get3(records, r + rec.A)
        put(g_means2d, 2 * row, TWO_LN2 * a * u)
        put(g_means2d, 2 * row + 1, TWO_LN2 * (b * u + c * v))
        if with_absgrad:
            put(absgrad, 3 * row, abs(TWO_LN2 * a) * get(sums, o + rec.ABS_X))
            put(absgrad, 3 * row + 1, TWO_LN2 * get(sums, o + rec.ABS_Y))
            put(absgrad, 3 * row + 2, get(sums, o + rec.SUM_WEIGHT))
    if part == parts - 1:
        clear_between(ids, count, 2, g_means2d)
        clear_between(ids, count, 3, absgrad)
