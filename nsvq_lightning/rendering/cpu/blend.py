"""Front-to-back blending of sorted splats and its backward pass, with one vector per 4x4 block of pixels.

Forward: a tile takes its splats in batches; an exact test finds which of its 16 blocks each splat can reach, then
each block runs through its own splats, four at a time, with transmittance and colour in registers. Nothing branches
on a single pixel: a closed (finished) one keeps losing transmittance, and a splat counts only where the transmittance
after it is still above the threshold. The blocks that a splat was blended into are kept as a 16-bit mask for the
backward pass, which goes through the splats once more from front to back:
with d = g·colour and ``rest`` = what this splat and all after it (and the background) add to g·image, dL/dα =
(T·d - rest)/(1 - α), so neither the last contributor nor any atomic operation is needed.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from nsvq_lightning.compute.jit import F, inline, kernel
from nsvq_lightning.compute.simd import (
    any_lane,
    broadcast,
    column_bits,
    exp2,
    fetch_add,
    fma,
    fnma,
    get,
    lane_sums,
    load,
    load_block,
    load_rgb_block,
    lowest_bit,
    mask_bits,
    prefetch,
    put,
    select,
    store,
    store_block,
    store_rgb_block,
    vmax,
    vmin,
)
from nsvq_lightning.rendering import constants
from nsvq_lightning.rendering.cpu.records import (
    BLUE,
    DEPTH,
    EXTENT,
    GREEN,
    GROUP_SHIFT,
    GROUP_TILES,
    LOG2_ALPHA_MIN,
    LOG2_OPACITY,
    ORIGIN,
    RECORD,
    RED,
    SLOPE_X,
    SLOPE_Y,
    SLOT,
    SUM_ABS_X,
    SUM_ABS_Y,
    SUM_MAP,
    SUM_U,
    SUM_V,
    TILE,
    A,
    B,
    C,
    X,
    Y,
)

ALPHA_MAX = F(constants.ALPHA_MAX)
TRANSMITTANCE_MIN = F(constants.TRANSMITTANCE_MIN)
BATCH = 128
TINY = F(1e-20)
"""Lower bound on the transmittance of closed pixels: far below the threshold, far above denormal numbers."""
REACH_MARGIN = F(2.0**-8)
"""How far below the threshold, in log2 α, a block still counts as reached: what rounding can add to the exponent of a
pixel, so that culling blocks changes no bit. It lets one block in a thousand more through."""
AHEAD = 24
"""How many entries ahead a record is prefetched; its slot, whose number is in the record, a little later."""
SLOT_AHEAD = 10
BLOCKS = 16
BLOCK_SIDE = 4

# Planes of the per-thread scratch of the forward pass, with one vector per block: T keeps falling once a pixel is
# closed, T_LEFT is the transmittance that the image keeps.
T, T_LEFT, R_SUM, G_SUM, B_SUM, Z_SUM = (256 * plane for plane in range(6))
FORWARD_SCRATCH = 6 * 256 + (BATCH + 1) * RECORD
# Vectors of one block in the scratch of the backward pass.
BACK_T, BACK_REST, BACK_RED, BACK_GREEN, BACK_BLUE, BACK_DEPTH, BACK_MAP, BACK_X, BACK_Y = (
    16 * part for part in range(9)
)
BLOCK_STATE = 16 * 9
BACKWARD_SCRATCH = BLOCKS * BLOCK_STATE
TWO_LN2 = F(2 * np.log(2.0))


def pixel_grid() -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """Pixel centres in a tile: x of block k at 16·k, y at 256 + 16·k; first x and y of the blocks at 512 and 528."""
    block, lane = np.arange(BLOCKS)[:, None], np.arange(16)[None]
    x = (block % 4) * BLOCK_SIDE + lane % 4 + 0.5
    y = (block // 4) * BLOCK_SIDE + lane // 4 + 0.5
    return np.concatenate([x.ravel(), y.ravel(), x[:, 0], y[:, 0]]).astype(np.float32)


@inline
def offsets_at(a, b, c, x, y):
    """Constant terms of the factors u = A·x + B·y + u0 and v = C·y + v0 of the exponent of a splat at (x, y)."""
    return -(a * x + b * y), -(c * y)


@inline
def exponent(a, b, c, u0, v0, peak, x, y):
    """log2 α and the two factors of the exponent."""
    u = fma(a, x, fma(b, y, u0))
    v = fma(c, y, v0)
    return fnma(u, u, fnma(v, v, peak)), u, v


@inline
def highest_exponent(a, b, c, slope_x, slope_y, left, right, top, bottom):
    """Largest value of -(u² + v²) on rectangles relative to the splat's centre: it lies on the edges facing it."""
    zero = broadcast(F(0))
    dx, dy = vmax(left, vmin(right, zero)), vmax(top, vmin(bottom, zero))
    along_y = vmax(top, vmin(bottom, slope_x * dx))
    along_x = vmax(left, vmin(right, slope_y * dy))
    first, _, _ = exponent(a, b, c, zero, zero, zero, dx, along_y)
    second, _, _ = exponent(a, b, c, zero, zero, zero, along_x, dy)
    return vmax(first, second)


@inline
def reachable_blocks(batch, o, x, y, grid):
    """Mask of the blocks of a tile in which a splat can reach α = 1/255."""
    left, top = load(grid, 512) - broadcast(x), load(grid, 528) - broadcast(y)
    side = broadcast(F(BLOCK_SIDE - 1))
    peak = highest_exponent(
        broadcast(get(batch, o + A)),
        broadcast(get(batch, o + B)),
        broadcast(get(batch, o + C)),
        broadcast(get(batch, o + SLOPE_X)),
        broadcast(get(batch, o + SLOPE_Y)),
        left,
        left + side,
        top,
        top + side,
    )
    return mask_bits(peak >= broadcast(LOG2_ALPHA_MIN - REACH_MARGIN - get(batch, o + LOG2_OPACITY)))


@inline
def alpha_at(batch, r, x, y):
    """α of one splat of a batch on a block of pixels, 0 below 1/255; a batch holds (u0, v0) in place of the centre."""
    power, _, _ = exponent(
        broadcast(get(batch, r + A)),
        broadcast(get(batch, r + B)),
        broadcast(get(batch, r + C)),
        broadcast(get(batch, r + X)),
        broadcast(get(batch, r + Y)),
        broadcast(get(batch, r + LOG2_OPACITY)),
        x,
        y,
    )
    return select(power >= broadcast(LOG2_ALPHA_MIN), vmin(exp2(power), broadcast(ALPHA_MAX)), broadcast(F(0)))


@inline
def accumulate(batch, r, weight, sums):
    """Add colour and depth of one splat."""
    red, green, blue, depth = sums
    return (
        fma(weight, broadcast(get(batch, r + RED)), red),
        fma(weight, broadcast(get(batch, r + GREEN)), green),
        fma(weight, broadcast(get(batch, r + BLUE)), blue),
        fma(weight, broadcast(get(batch, r + DEPTH)), depth),
    )


@inline
def waiting(touched, first, count, block):
    """Bits of those of the next 64 splats that reach a block; only the first ``count`` belong to the batch."""
    if count <= 0:
        return np.int64(0)
    bits = column_bits(touched, first, block)
    return bits if count >= 64 else bits & ((1 << count) - 1)


@inline
def next_splat(low, high, base):
    """Take the lowest set bit of a queue of 128; the position is 128 if there is none."""
    if low == 0:
        low, high, base = high, np.int64(0), np.int64(64)
    return base + lowest_bit(low), low & (low - 1), high, base


@inline
def blend_one(batch, r, alpha, t, after, left, sums):
    """Add one splat where it leaves the pixel open; returns the transmittance left and the sums."""
    open_ = after >= broadcast(TRANSMITTANCE_MIN)
    weight = select(open_, alpha * t, broadcast(F(0)))
    return select(open_, after, left), accumulate(batch, r, weight, sums)


@inline
def blend_block(block, count, batch, grid, state, touched, first, drop_closed):
    """Blend a batch into one block; returns the block's bit, or 0 once all its pixels are closed."""
    o = 16 * block
    t, left = load(state, T + o), load(state, T_LEFT + o)
    sums = load(state, R_SUM + o), load(state, G_SUM + o), load(state, B_SUM + o), load(state, Z_SUM + o)
    x, y = load(grid, o), load(grid, 256 + o)
    bit = 1 << block
    low = waiting(touched, first, count, block)
    high = waiting(touched, first + 64, count - 64, block)
    base = np.int64(0)
    while low | high != 0:
        j0, low, high, base = next_splat(low, high, base)
        j1, low, high, base = next_splat(low, high, base)
        j2, low, high, base = next_splat(low, high, base)
        j3, low, high, base = next_splat(low, high, base)
        r0, r1, r2, r3 = RECORD * j0, RECORD * j1, RECORD * j2, RECORD * j3
        a0, a1 = alpha_at(batch, r0, x, y), alpha_at(batch, r1, x, y)
        a2, a3 = alpha_at(batch, r2, x, y), alpha_at(batch, r3, x, y)
        t1 = fnma(a0, t, t)
        t2 = fnma(a1, t1, t1)
        t3 = fnma(a2, t2, t2)
        t4 = fnma(a3, t3, t3)
        left, sums = blend_one(batch, r0, a0, t, t1, left, sums)
        left, sums = blend_one(batch, r1, a1, t1, t2, left, sums)
        left, sums = blend_one(batch, r2, a2, t2, t3, left, sums)
        left, sums = blend_one(batch, r3, a3, t3, t4, left, sums)
        if drop_closed and not any_lane(t4 >= broadcast(TRANSMITTANCE_MIN)):
            for j in range(j3 + 1, count):
                put(touched, first + j, get(touched, first + j) & ~bit)
            bit = 0
            low, high = np.int64(0), np.int64(0)
        # The transmittance of closed pixels keeps falling; keep it clear of denormals.
        t = vmax(t4, broadcast(TINY))
    store(state, T + o, t)
    store(state, T_LEFT + o, left)
    store(state, R_SUM + o, sums[0])
    store(state, G_SUM + o, sums[1])
    store(state, B_SUM + o, sums[2])
    store(state, Z_SUM + o, sums[3])
    return bit


@inline
def write_block(block, left, top, width, height, background, state, image, transmittance, depth):
    """Add the background and write one block, pixel by pixel where it extends beyond the image."""
    o = 16 * block
    x0, y0 = left + (block & 3) * BLOCK_SIDE, top + (block >> 2) * BLOCK_SIDE
    t = load(state, T_LEFT + o)
    red = fma(t, broadcast(get(background, 0)), load(state, R_SUM + o))
    green = fma(t, broadcast(get(background, 1)), load(state, G_SUM + o))
    blue = fma(t, broadcast(get(background, 2)), load(state, B_SUM + o))
    if x0 + BLOCK_SIDE <= width and y0 + BLOCK_SIDE <= height:
        pixel = y0 * width + x0
        store_rgb_block(image, 3 * pixel, 3 * width, red, green, blue)
        store_block(transmittance, pixel, width, t)
        store_block(depth, pixel, width, load(state, Z_SUM + o))
        return
    store(state, T_LEFT + o, t)
    store(state, R_SUM + o, red)
    store(state, G_SUM + o, green)
    store(state, B_SUM + o, blue)
    for lane in range(16):
        x, y = x0 + (lane & 3), y0 + (lane >> 2)
        if x < width and y < height:
            pixel, s = y * width + x, o + lane
            put(transmittance, pixel, get(state, T_LEFT + s))
            put(depth, pixel, get(state, Z_SUM + s))
            put(image, 3 * pixel, get(state, R_SUM + s))
            put(image, 3 * pixel + 1, get(state, G_SUM + s))
            put(image, 3 * pixel + 2, get(state, B_SUM + s))


@inline
def blend_tile(
    records,
    entries,
    begin,
    end,
    left,
    top,
    width,
    height,
    background,
    grid,
    touched,
    image,
    transmittance,
    depth,
    state,
    cull_blocks,
    drop_closed,
):
    """Blend one tile; returns the end of the part of its list that was processed."""
    zero, one = broadcast(F(0)), broadcast(F(1))
    columns, rows = broadcast(F(width - left)), broadcast(F(height - top))
    alive = 0
    for block in range(BLOCKS):
        inside = (load(grid, 16 * block) < columns) & (load(grid, 256 + 16 * block) < rows)
        store(state, T + 16 * block, select(inside, one, zero))
        store(state, T_LEFT + 16 * block, select(inside, one, zero))
        for plane in range(2, 6):
            store(state, 256 * plane + 16 * block, zero)
        if any_lane(inside):
            alive |= 1 << block
    batch = state[6 * 256 :]
    # A record without effect, which fills up the last group of four.
    store(batch, BATCH * RECORD, zero)
    put(batch, BATCH * RECORD + LOG2_OPACITY, F(-100))
    fx, fy = F(left), F(top)
    for i in range(begin, min(end, begin + AHEAD)):
        prefetch(records, RECORD * np.int64(get(entries, i)))
    i = begin
    while i < end and alive != 0:
        count = min(BATCH, end - i)
        reached = 0
        for j in range(count):
            if i + j + AHEAD < end:
                prefetch(records, RECORD * np.int64(get(entries, i + j + AHEAD)))
            r = RECORD * np.int64(get(entries, i + j))
            o = RECORD * j
            store(batch, o, load(records, r))
            x, y = get(records, r + X) - fx, get(records, r + Y) - fy
            mask = alive
            if cull_blocks:
                mask &= reachable_blocks(batch, o, x, y, grid)
            u0, v0 = offsets_at(get(records, r + A), get(records, r + B), get(records, r + C), x, y)
            put(batch, o + X, u0)
            put(batch, o + Y, v0)
            put(touched, i + j, mask)
            reached |= mask
        while reached != 0:
            block = lowest_bit(reached)
            reached &= reached - 1
            if blend_block(block, count, batch, grid, state, touched, i, drop_closed) == 0:
                alive &= ~(1 << block)
        i += count
    for block in range(BLOCKS):
        write_block(block, left, top, width, height, background, state, image, transmittance, depth)
    return i


@inline
def tile_corner(tile, group_columns):
    """Left and top pixel of a tile."""
    group, inside = tile // GROUP_TILES, tile % GROUP_TILES
    side = 1 << GROUP_SHIFT
    x = (group % group_columns) * side + inside % side
    y = (group // group_columns) * side + inside // side
    return x * TILE, y * TILE


@kernel
def blend(
    threads,
    records,
    entries,
    offsets,
    group_columns,
    width,
    height,
    background,
    grid,
    touched,
    ends,
    image,
    transmittance,
    depth,
    scratch,
    cull_blocks,
    drop_closed,
    counter,
):
    """Blend all tiles, scheduled dynamically; a pixel depends only on its own tile.

    ``cull_blocks`` skips the blocks that a splat cannot reach, ``drop_closed`` those whose pixels are all closed.
    """
    tiles = offsets.shape[0] - 1
    for thread in prange(threads):
        while True:
            tile = fetch_add(counter, 0, 1)
            if tile >= tiles:
                break
            left, top = tile_corner(tile, group_columns)
            if left < width and top < height:
                ends[tile] = blend_tile(
                    records, entries, np.int64(offsets[tile]), np.int64(offsets[tile + 1]), left, top, width, height,
                    background, grid, touched, image, transmittance, depth, scratch[thread], cull_blocks, drop_closed,
                )  # fmt: skip
            else:
                ends[tile] = offsets[tile]


@inline
def start_block(
    block, left, top, width, height, image, depth, transmittance, g_image, g_alpha, g_depth, pixel_map, with_alpha,
    with_depth, with_map, grid, state,
):  # fmt: skip
    """Backward state of a block: transmittance 1, and ``rest`` = g · everything that this pixel received.

    Alpha is 1 - T, so its gradient enters as -g_alpha·T at the far end. Gradients that are not needed are not read, nor
    is a map.
    """
    s = BLOCK_STATE * block
    x0, y0 = left + (block & 3) * BLOCK_SIDE, top + (block >> 2) * BLOCK_SIDE
    store(state, s + BACK_X, load(grid, 16 * block))
    store(state, s + BACK_Y, load(grid, 256 + 16 * block))
    if x0 + BLOCK_SIDE <= width and y0 + BLOCK_SIDE <= height:
        pixel = y0 * width + x0
        red, green, blue = load_rgb_block(g_image, 3 * pixel, 3 * width)
        r, g, b = load_rgb_block(image, 3 * pixel, 3 * width)
        rest = fma(red, r, fma(green, g, blue * b))
        if with_alpha:
            rest = fnma(load_block(g_alpha, pixel, width), load_block(transmittance, pixel, width), rest)
        if with_depth:
            far = load_block(g_depth, pixel, width)
            store(state, s + BACK_DEPTH, far)
            rest = fma(far, load_block(depth, pixel, width), rest)
        if with_map:
            store(state, s + BACK_MAP, load_block(pixel_map, pixel, width))
        store(state, s + BACK_T, broadcast(F(1)))
        store(state, s + BACK_REST, rest)
        store(state, s + BACK_RED, red)
        store(state, s + BACK_GREEN, green)
        store(state, s + BACK_BLUE, blue)
        return
    for part in range(0, BACK_X, 16):
        store(state, s + part, broadcast(F(0)))
    for lane in range(16):
        x, y = x0 + (lane & 3), y0 + (lane >> 2)
        if x < width and y < height:
            pixel, o = y * width + x, s + lane
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
            if with_map:
                put(state, o + BACK_MAP, get(pixel_map, pixel))
            put(state, o + BACK_REST, rest)
            put(state, o + BACK_T, F(1))


@inline
def slot_of(integers, row, group_x, group_y):
    """The slot in which a group sums the gradients of a splat."""
    o = RECORD * row
    origin, extent = np.int64(get(integers, o + ORIGIN)), np.int64(get(integers, o + EXTENT))
    x0, y0 = origin & 0xFFFF, origin >> 16
    first_x, first_y = x0 >> GROUP_SHIFT, y0 >> GROUP_SHIFT
    columns = ((x0 + (extent & 0xFFFF) - 1) >> GROUP_SHIFT) - first_x + 1
    return np.int64(get(integers, o + SLOT)) + (group_y - first_y) * columns + group_x - first_x


@inline
def splat_backward(records, row, blocks, left, top, with_depth, with_map, state):
    """Sums of one splat over the blocks it changed in a tile (the fields of a slot); advances the blocks' state."""
    zero, one = broadcast(F(0)), broadcast(F(1))
    lowest, highest = broadcast(LOG2_ALPHA_MIN), broadcast(ALPHA_MAX)
    r = RECORD * row
    fa, fb, fc = get(records, r + A), get(records, r + B), get(records, r + C)
    u0, v0 = offsets_at(fa, fb, fc, get(records, r + X) - F(left), get(records, r + Y) - F(top))
    a, b, c, u0, v0 = broadcast(fa), broadcast(fb), broadcast(fc), broadcast(u0), broadcast(v0)
    peak = broadcast(get(records, r + LOG2_OPACITY))
    red, green, blue = (
        broadcast(get(records, r + RED)),
        broadcast(get(records, r + GREEN)),
        broadcast(get(records, r + BLUE)),
    )
    z = broadcast(get(records, r + DEPTH))
    s_r, s_g, s_b, s_h, s_u, s_v, s_uu, s_uv, s_vv, s_z = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    s_ax, s_ay, s_map = zero, zero, zero
    while blocks != 0:
        s = BLOCK_STATE * lowest_bit(blocks)
        blocks &= blocks - 1
        power, u, v = exponent(a, b, c, u0, v0, peak, load(state, s + BACK_X), load(state, s + BACK_Y))
        raw = exp2(power)
        alpha = select(power >= lowest, vmin(raw, highest), zero)
        g_r, g_g, g_b = load(state, s + BACK_RED), load(state, s + BACK_GREEN), load(state, s + BACK_BLUE)
        d = fma(g_r, red, fma(g_g, green, g_b * blue))
        if with_depth:
            d = fma(load(state, s + BACK_DEPTH), z, d)
        t, rest = load(state, s + BACK_T), load(state, s + BACK_REST)
        after = fnma(alpha, t, t)
        open_ = after >= broadcast(TRANSMITTANCE_MIN)
        td = t * d
        weight = select(open_, alpha * t, zero)
        store(state, s + BACK_REST, fnma(weight, d, rest))
        store(state, s + BACK_T, vmax(after, broadcast(TINY)))
        h = select(open_ & (raw <= highest), alpha / (one - alpha) * (td - rest), zero)
        s_r, s_g, s_b = fma(weight, g_r, s_r), fma(weight, g_g, s_g), fma(weight, g_b, s_b)
        hu, hv = h * u, h * v
        s_h, s_u, s_v = s_h + h, s_u + hu, s_v + hv
        s_uu, s_uv, s_vv = fma(hu, u, s_uu), fma(hu, v, s_uv), fma(hv, v, s_vv)
        if with_depth:
            s_z = fma(weight, load(state, s + BACK_DEPTH), s_z)
        if with_map:
            along_y = fma(b, hu, c * hv)
            s_ax, s_ay = s_ax + vmax(hu, zero - hu), s_ay + vmax(along_y, zero - along_y)
            s_map = fma(weight, load(state, s + BACK_MAP), s_map)
    return lane_sums((s_r, s_g, s_b, s_h, s_u, s_v, s_uu, s_uv, s_vv, s_z, s_ax, s_ay, s_map))


@inline
def tile_backward(
    records, integers, entries, begin, end, left, top, group_x, group_y, with_depth, with_map, touched, sums, state
):
    """Add up the gradients of all splats of a tile, front to back."""
    for i in range(begin, end):
        if i + AHEAD < end:
            prefetch(records, RECORD * np.int64(get(entries, i + AHEAD)))
        if i + SLOT_AHEAD < end:
            coming = np.int64(get(entries, i + SLOT_AHEAD))
            prefetch(sums, RECORD * slot_of(integers, coming, group_x, group_y))
        blocks = np.int64(get(touched, i))
        if blocks == 0:
            continue
        row = np.int64(get(entries, i))
        slot = RECORD * slot_of(integers, row, group_x, group_y)
        store(
            sums, slot, load(sums, slot) + splat_backward(records, row, blocks, left, top, with_depth, with_map, state)
        )


@kernel
def blend_backward(
    threads,
    records,
    integers,
    entries,
    offsets,
    ends,
    group_columns,
    width,
    height,
    grid,
    touched,
    image,
    transmittance,
    depth,
    g_image,
    g_alpha,
    g_depth,
    pixel_map,
    with_alpha,
    with_depth,
    with_map,
    sums,
    slots,
    scratch,
    counter,
):
    """Write the sums of every (splat, group) pair to its slot; groups are scheduled dynamically, each in one order."""
    tiles = offsets.shape[0] - 1
    groups = tiles // GROUP_TILES
    for thread in prange(threads):
        first, last = slots * thread // threads, slots * (thread + 1) // threads
        for slot in range(first, last):
            store(sums, RECORD * slot, broadcast(F(0)))
    for thread in prange(threads):
        state = scratch[thread]
        while True:
            group = fetch_add(counter, 0, 1)
            if group >= groups:
                break
            for tile in range(GROUP_TILES * group, GROUP_TILES * (group + 1)):
                begin, end = np.int64(offsets[tile]), np.int64(ends[tile])
                if end <= begin:
                    continue
                left, top = tile_corner(tile, group_columns)
                for block in range(BLOCKS):
                    start_block(
                        block, left, top, width, height, image, depth, transmittance, g_image, g_alpha, g_depth,
                        pixel_map, with_alpha, with_depth, with_map, grid, state,
                    )  # fmt: skip
                tile_backward(
                    records, integers, entries, begin, end, left, top, group % group_columns, group // group_columns,
                    with_depth, with_map, touched, sums, state,
                )  # fmt: skip


@kernel
def total_slots(threads, ids, count, slots, records, integers, sums, g_means2d, with_map, observed):
    """Add up the slots of each splat into its first one, and derive the gradient of the projected centre ``[N·2]``.

    ``with_map`` also writes what the pass observed ``[N·3]``: Σ |∂L/∂x|, Σ |∂L/∂y| and Σ weight · map over pixels.
    """
    for thread in prange(threads):
        last = count * (thread + 1) // threads
        for i in range(count * thread // threads, last):
            row = np.int64(get(ids, i))
            r = RECORD * row
            slot = np.int64(get(integers, r + SLOT))
            end = np.int64(get(integers, RECORD * np.int64(get(ids, i + 1)) + SLOT)) if i + 1 < count else slots
            o = RECORD * slot
            if end > slot + 1:
                total = load(sums, o)
                for other in range(slot + 1, end):
                    total = total + load(sums, RECORD * other)
                store(sums, o, total)
            u, v = get(sums, o + SUM_U), get(sums, o + SUM_V)
            put(g_means2d, 2 * row, TWO_LN2 * get(records, r + A) * u)
            put(g_means2d, 2 * row + 1, TWO_LN2 * (get(records, r + B) * u + get(records, r + C) * v))
            if with_map:
                put(observed, 3 * row, abs(TWO_LN2 * get(records, r + A)) * get(sums, o + SUM_ABS_X))
                put(observed, 3 * row + 1, TWO_LN2 * get(sums, o + SUM_ABS_Y))
                put(observed, 3 * row + 2, get(sums, o + SUM_MAP))
