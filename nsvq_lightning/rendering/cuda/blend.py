"""Front-to-back blending of sorted splats and its backward pass, with one program per tile of 16x16 pixels.

Forward: a closed (finished) pixel keeps losing transmittance, and a splat counts only where the transmittance after it
is still above the threshold; so nothing branches on a single pixel. After each batch of splats the program checks
whether a pixel is still open.

Backward: the program goes through the splats once more from front to back. With d = g·colour and ``rest`` = what this
splat and all after it (and the background) add to g·image, α·dL/dα = α/(1 - α)·(T·d - rest). Every pair of splat and
tile writes its own slot and a second kernel adds up the slots of each splat: no atomics, the same bits every time.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.language import constexpr

from nsvq_lightning.compute.devices import COMPILE
from nsvq_lightning.compute.formulas import for_triton
from nsvq_lightning.compute.memory import check_fit
from nsvq_lightning.rendering import formulas as shared
from nsvq_lightning.rendering.cuda import records as rec
from nsvq_lightning.rendering.cuda.binning import Tiles
from nsvq_lightning.rendering.cuda.harmonics import load_if, load_row, places, store_row
from nsvq_lightning.rendering.cuda.projection import Lens

formulas = for_triton(shared)
# What records of splats and their lists by T tiles are, see :func:`check_fit`.
_LISTS = (
    f"records [V, {rec.RECORD.value}], offsets [O] int32, order [T] int32, ranks [P] int32, slots [P] int32, "
    "ends [V] int32"
)

# Splats whose slots a program adds up: most have a few, and a program for each would have little to do.
SPLATS = 16
# Number of slots of one splat that are added up at a time.
SLOTS = 8


@triton.jit
def tile_pixels(tile, columns, width, height):
    """Corner of a tile, its pixel centres, their indices in the image, and which of them lie inside the image."""
    left, top = (tile % columns) * rec.TILE, (tile // columns) * rec.TILE
    lane = tl.arange(0, rec.TILE * rec.TILE)
    x, y = lane % rec.TILE, lane // rec.TILE
    inside = (left + x < width) & (top + y < height)
    return left, top, x + 0.5, y + 0.5, (top + y) * width + left + x, inside


@triton.jit
def fetch(records, ranks, j, end):
    """The record at place ``j`` of the lists, before ``end``, and what α depends on: a, b, c, x, y, log2 opacity."""
    there = j < end
    record = records + load_if(ranks + j, there).to(tl.int64) * rec.RECORD
    a, b, c = load_row(record + rec.A, 3, there)
    px, py = load_row(record + rec.X, 2, there)
    return record, a, b, c, px, py, load_if(record + rec.LOG2_OPACITY, there)


@triton.jit
def blend_step(fetched, left, top, x, y, t):
    """What one splat does to pixels with transmittance ``t``, the same to the bit in the forward and backward pass.

    Returns the two factors of its exponent and what :func:`nsvq_lightning.rendering.formulas.blend_step` does.
    """
    _, a, b, c, px, py, log2_opacity = fetched
    px, py = px - left, py - top
    # Explicit, so that both passes round alike: the compiler may contract sums of products, or not.
    power, u, v = formulas.exponent(a, b, c, -tl.fma(a, px, b * py), -(c * py), log2_opacity, x, y)
    return u, v, formulas.blend_step(power, t)


@triton.jit
def blend_kernel(
    records, ranks, offsets, order, ends, background, image, transmittance, depth, columns, width, height,
    BATCH: constexpr,
):  # fmt: skip
    """Image, transmittance and depth of a tile, and the end of the part of its list that was processed."""
    tile = tl.load(order + tl.program_id(0))
    left, top, x, y, pixel, inside = tile_pixels(tile, columns, width, height)
    t = tl.where(inside, 1.0, 0.0)
    kept = t
    red, green, blue, far = tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t)
    i, end = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    looked = i
    # The next splat is on its way while this one is blended.
    following = fetch(records, ranks, i, end)
    while i < end:
        looked = tl.minimum(i + BATCH, end)
        for j in range(i, looked):
            fetched, following = following, fetch(records, ranks, j + 1, end)
            record = fetched[0]
            _, _, step = blend_step(fetched, left, top, x, y, t)
            _, _, after, is_open, weight = step
            kept = tl.where(is_open, after, kept)
            t = after
            red += weight * tl.load(record + rec.RED)
            green += weight * tl.load(record + rec.GREEN)
            blue += weight * tl.load(record + rec.BLUE)
            far += weight * tl.load(record + rec.DEPTH)
        i = tl.where(tl.max(t, 0) >= formulas.TRANSMITTANCE_MIN, looked, end)
    tl.store(ends + tile, looked)
    red += kept * tl.load(background)
    green += kept * tl.load(background + 1)
    blue += kept * tl.load(background + 2)
    store_row(image + 3 * pixel, (red, green, blue), inside)
    tl.store(transmittance + pixel, kept, mask=inside)
    tl.store(depth + pixel, far, mask=inside)


@triton.jit
def store_sums(field, values):
    """Store sums over the pixels of a tile in consecutive fields of a slot."""
    for k in tl.static_range(len(values)):
        tl.store(field + k, tl.sum(values[k], 0))


@triton.jit
def blend_backward_kernel(
    records, ranks, slots, offsets, order, ends, image, transmittance, depth, g_image, g_alpha, g_depth, pixel_weights,
    sums, columns, width, height, WITH_ALPHA: constexpr, WITH_DEPTH: constexpr, WITH_ABSGRAD: constexpr,
):  # fmt: skip
    """Write the sums of every splat of a tile to its slot."""
    tile = tl.load(order + tl.program_id(0))
    left, top, x, y, pixel, inside = tile_pixels(tile, columns, width, height)
    g_red, g_green, g_blue = load_row(g_image + 3 * pixel, 3, inside)
    red, green, blue = load_row(image + 3 * pixel, 3, inside)
    rest = g_red * red + g_green * green + g_blue * blue
    if WITH_ALPHA:
        # Alpha is 1 - T, so its gradient enters as -g_alpha·T at the far end.
        kept = load_if(transmittance + pixel, inside)
        rest -= load_if(g_alpha + pixel, inside) * kept
    g_far = tl.zeros_like(rest)
    if WITH_DEPTH:
        g_far = load_if(g_depth + pixel, inside)
        rest += g_far * load_if(depth + pixel, inside)
    if WITH_ABSGRAD:
        strength = load_if(pixel_weights + pixel, inside)
    t = tl.where(inside, 1.0, 0.0)
    begin, end = tl.load(offsets + tile), tl.load(ends + tile)
    following = fetch(records, ranks, begin, end)
    for j in range(begin, end):
        fetched, following = following, fetch(records, ranks, j + 1, end)
        record = fetched[0]
        u, v, step = blend_step(fetched, left, top, x, y, t)
        raw, alpha, after, is_open, weight = step
        if tl.max(weight, 0) > 0:
            d = g_red * tl.load(record + rec.RED) + g_green * tl.load(record + rec.GREEN)
            d += g_blue * tl.load(record + rec.BLUE)
            if WITH_DEPTH:
                d += g_far * tl.load(record + rec.DEPTH)
            # The cap of α has no gradient.
            h = tl.where(is_open & (raw <= formulas.ALPHA_MAX), alpha / (1 - alpha) * (t * d - rest), 0.0)
            rest = tl.fma(-weight, d, rest)
            hu, hv = h * u, h * v
            slot = sums + tl.load(slots + j).to(tl.int64) * (rec.ABSGRAD_SLOT if WITH_ABSGRAD else rec.RECORD)
            store_sums(slot + rec.SUM_RED, (weight * g_red, weight * g_green, weight * g_blue))
            store_sums(slot + rec.SUM_H, (h, hu, hv))
            store_sums(slot + rec.SUM_UU, (hu * u, hu * v, hv * v))
            if WITH_DEPTH:
                store_sums(slot + rec.SUM_DEPTH, (weight * g_far,))
            if WITH_ABSGRAD:
                along_y = tl.fma(hu, tl.load(record + rec.B), hv * tl.load(record + rec.C))
                store_sums(slot + rec.ABS_X, (tl.abs(hu), tl.abs(along_y), weight * strength))
        t = after


@triton.jit
def field_of(total, field):
    """One field of the sums ``[SPLATS, LANES]`` of some splats."""
    lane = tl.arange(0, total.shape[1])[None, :]
    return tl.sum(tl.where(lane == field, total, 0.0), 1)


@triton.jit(do_not_specialize=["count"])
def total_kernel(
    sums, slot_ends, ids, records, totals, g_means2d, absgrad, count,
    WITH_ABSGRAD: constexpr, SPLATS: constexpr, SLOTS: constexpr, LANES: constexpr,
):  # fmt: skip
    """Add up the slots of some splats, and derive the gradients of their projected centres.

    ``WITH_ABSGRAD`` also writes the absolute gradients: Σ |∂L/∂x|, Σ |∂L/∂y| and Σ weight · pixel weight over pixels.
    """
    rank = places(SPLATS)
    seen = rank < count
    end = load_if(slot_ends + rank, seen)
    begin = load_if(slot_ends + rank - 1, seen & (rank > 0))
    field = tl.arange(0, LANES)[None, None, :]
    acc = tl.zeros([SPLATS, SLOTS, LANES], tl.float32)
    for start in range(0, tl.max(end - begin, 0), SLOTS):
        slot = begin[:, None, None] + start + tl.arange(0, SLOTS)[None, :, None]
        mask = (slot < end[:, None, None]) & (field < (rec.ABSGRAD_FIELDS if WITH_ABSGRAD else rec.FIELDS))
        place = slot.to(tl.int64) * (rec.ABSGRAD_SLOT if WITH_ABSGRAD else rec.RECORD) + field
        acc += load_if(sums + place, mask)
    total = tl.sum(acc, 1)
    lane = tl.arange(0, LANES)[None, :]
    tl.store(totals + rank[:, None] * rec.RECORD + lane, total, mask=seen[:, None] & (lane < rec.FIELDS))
    u, v = field_of(total, rec.SUM_U), field_of(total, rec.SUM_V)
    record = records + rank * rec.RECORD
    a, b, c = load_row(record + rec.A, 3, seen)
    row = load_if(ids + rank, seen)
    store_row(g_means2d + 2 * row, (a * u * formulas.TWO_LN2, (b * u + c * v) * formulas.TWO_LN2), seen)
    if WITH_ABSGRAD:
        x = tl.abs(a) * field_of(total, rec.ABS_X) * formulas.TWO_LN2
        y = field_of(total, rec.ABS_Y) * formulas.TWO_LN2
        store_row(absgrad + 3 * row, (x, y, field_of(total, rec.SUM_WEIGHT)), seen)


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover an image."""
    return triton.cdiv(width, rec.TILE.value), triton.cdiv(height, rec.TILE.value)


def blend(lens: Lens, records: Tensor, tiles: Tiles, background: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image ``[H, W, 3]``, transmittance ``[H, W]``, depth ``[H, W]``, and how far each list was processed.

    Args:
        lens: Gives the size of the image.
        records: Splats front to back ``[V, RECORD]``.
        tiles: Their lists by tile.
        background: RGB ``[3]``.

    Raises:
        ValueError: The tensors do not fit together.
        TypeError: A dtype is wrong.
    """
    columns, rows = tile_grid(lens.width, lens.height)
    count = columns * rows
    check_fit(f"{_LISTS}, background [3]", records, *tiles, background, T=count, O=count + 1)
    image = records.new_empty(lens.height, lens.width, 3)
    transmittance, depth = (records.new_empty(lens.height, lens.width) for _ in range(2))
    ends = records.new_empty(columns * rows, dtype=torch.int32)
    # With one warp a tile, every reduction stays inside it; after each batch, whether the tile is finished is checked.
    blend_kernel[(columns * rows,)](
        records, tiles.ranks, tiles.offsets, tiles.order, ends, background, image, transmittance, depth,
        columns, lens.width, lens.height, BATCH=32, num_warps=1, **COMPILE,
    )  # fmt: skip
    return image, transmittance, depth, ends


def blend_backward(
    lens: Lens,
    records: Tensor,
    ids: Tensor,
    n: int,
    tiles: Tiles,
    ends: Tensor,
    outputs: tuple[Tensor, Tensor, Tensor],
    gradients: tuple[Tensor | None, Tensor | None, Tensor | None],
    pixel_weights: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Moments ``[V, RECORD]`` of the splats in view; of all splats the gradients of the centres.

    Those are ``[n, 2]``, and with pixel weights Σ |∂L/∂x|, Σ |∂L/∂y| and Σ weight · pixel weight ``[n, 3]``.

    Args:
        lens: As in :func:`blend`.
        records: As in :func:`blend`.
        ids: Rows of the splats in view ``[V]``.
        n: Number of all splats.
        tiles: As in :func:`blend`.
        ends: What :func:`blend` returned, as are ``outputs``: image, transmittance and depth.
        outputs: See ``ends``.
        gradients: Of image, alpha and depth, contiguous; None for those on which nothing depends.
        pixel_weights: Strength of each pixel ``[H, W]``, contiguous; None for no absolute gradients.

    Raises:
        ValueError: The tensors do not fit together.
        TypeError: A dtype is wrong.
    """
    columns, rows = tile_grid(lens.width, lens.height)
    text = (
        f"{_LISTS}, ids [V] int64, ends of tiles [T] int32, image [H, W, 3], alpha [H, W], depth [H, W], "
        "gradient of image [H, W, 3], gradient of alpha [H, W], gradient of depth [H, W], pixel_weights [H, W]"
    )
    given = ids, ends, *outputs, *gradients, pixel_weights
    count = columns * rows
    check_fit(text, records, *tiles, *given, T=count, O=count + 1, H=lens.height, W=lens.width)
    with_absgrad = pixel_weights is not None
    image, transmittance, depth = outputs
    g_image, g_alpha, g_depth = gradients
    totals, g_means2d = torch.zeros_like(records), records.new_zeros(n, 2)
    absgrad = records.new_zeros(n, 3) if with_absgrad else None
    if len(ids):
        sums = records.new_zeros(len(tiles.slots), (rec.ABSGRAD_SLOT if with_absgrad else rec.RECORD).value)
        blend_backward_kernel[(columns * rows,)](
            records, tiles.ranks, tiles.slots, tiles.offsets, tiles.order, ends, image, transmittance, depth,
            torch.zeros_like(image) if g_image is None else g_image,
            # Placeholders that are never read stand in for missing gradients and a missing map.
            *(depth if given is None else given for given in (g_alpha, g_depth, pixel_weights)),
            sums, columns, lens.width, lens.height,
            WITH_ALPHA=g_alpha is not None, WITH_DEPTH=g_depth is not None, WITH_ABSGRAD=with_absgrad,
            num_warps=1, **COMPILE,
        )  # fmt: skip
        total_kernel[(triton.cdiv(len(ids), SPLATS),)](
            sums, tiles.ends, ids, records, totals, g_means2d, g_means2d if absgrad is None else absgrad, len(ids),
            WITH_ABSGRAD=with_absgrad, SPLATS=SPLATS, SLOTS=SLOTS, LANES=16, num_warps=2, **COMPILE,
        )  # fmt: skip
    return totals, g_means2d, absgrad
