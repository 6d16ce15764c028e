"""The photometric loss with its gradient in one sweep down an image.

Each row is read once: it is clamped and brought to [0, 1] as it enters a ring buffer of eleven rows. Five rows later
come the vertical blur of the four moment planes, their horizontal blur, SSIM, its three derivative planes, and the
horizontal blur of those into a second ring buffer; another five rows later their vertical blur, which is the gradient
(the blur is its own adjoint). Only these rows are ever in memory. The gradient of PSNR depends on the error of the
whole picture, which a first, short sweep adds up.
"""

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline, parallel, thread_count
from nsvq_lightning.compute.memory import Workspace, check_fit, flat, recycled
from nsvq_lightning.compute.rows import clear, share
from nsvq_lightning.compute.simd import fma, get, load, put, store
from nsvq_lightning.quality import formulas
from nsvq_lightning.quality.formulas import DERIVATIVES, MOMENTS, SSIM_RADIUS, ssim_window

# The taps of the window, from the middle outwards.
TAPS = tuple(F(tap) for tap in ssim_window()[SSIM_RADIUS:].tolist())
# Zeros beside every row, at least 3·radius floats, so that the horizontal blur needs no special case at the border.
PAD = 16
RING = 2 * SSIM_RADIUS + 1
IMAGES = 2


@inline
def row_of(y, planes, pitch):
    """Offset of row y in a ring buffer of rows with several planes each."""
    return (y + RING) % RING * planes * pitch


@inline
def take_row(image, target, white, images, y, height, length, pitch):
    """Load row y of both images into their ring buffer: the image clamped, the target divided by ``white``."""
    o = row_of(y, IMAGES, pitch)
    if y < 0 or y >= height:
        clear(images, o, o + IMAGES * pitch)
    else:
        for x_ in range(0, length, 16):
            # The last vector of a row overlaps the one before it instead of running past the end.
            x = min(x_, length - 16)
            store(images, o + x, formulas.clamped(load(image, y * length + x)))
        for x in range(length):
            put(images, o + pitch + x, F(get(target, y * length + x)) / white)


@inline
def blur_along(row, o):
    """Eleven taps along a padded row of interleaved RGB (neighbouring pixels are 3 floats apart)."""
    total = TAPS[0] * load(row, o)
    for k in range(1, SSIM_RADIUS + 1):
        total = fma(TAPS[k], load(row, o - 3 * k) + load(row, o + 3 * k), total)
    return total


@inline
def moments_of_row(images, y, length, pitch, moments):
    """Vertical blur of the four moment planes at row y."""
    for x_ in range(0, length, 16):
        x = min(x_, length - 16)
        o = row_of(y, IMAGES, pitch) + x
        sums = formulas.moments(TAPS[0], load(images, o), load(images, o + pitch))
        for distance in range(1, SSIM_RADIUS + 1):
            # The rows above and below share a tap.
            above = row_of(y - distance, IMAGES, pitch) + x
            below = row_of(y + distance, IMAGES, pitch) + x
            p, q = load(images, above), load(images, above + pitch)
            r, s = load(images, below), load(images, below + pitch)
            sums = formulas.add_moments(sums, TAPS[distance], p, q, r, s)
        for plane in range(MOMENTS):
            store(moments, plane * pitch + PAD + x, sums[plane])


@inline
def similarity_of_row(moments, derivatives, length, pitch, lanes):
    """Sum of SSIM over a row; its derivatives with respect to blurred p, p² and pq go into three padded rows."""
    total = simd.broadcast(0)
    lane = load(lanes, 0)
    for x_ in range(0, length, 16):
        x = min(x_, length - 16)
        o = PAD + x
        m1, m2 = blur_along(moments, o), blur_along(moments, pitch + o)
        squares, product = blur_along(moments, 2 * pitch + o), blur_along(moments, 3 * pitch + o)
        similarity, slopes = formulas.similarity(m1, m2, squares, product)
        for plane in range(DERIVATIVES):
            store(derivatives, plane * pitch + o, slopes[plane])
        total = total + simd.where(lane >= F(x_ - x), similarity, 0)
    return simd.lane_sum(total)


@inline
def blur_across(ring, y, plane, x, pitch):
    """Eleven taps down the ring buffer, centred on row y, of one derivative plane."""
    o = plane * pitch + x
    total = TAPS[0] * load(ring, row_of(y, DERIVATIVES, pitch) + o)
    for distance in range(1, SSIM_RADIUS + 1):
        above, below = row_of(y - distance, DERIVATIVES, pitch), row_of(y + distance, DERIVATIVES, pitch)
        total = fma(TAPS[distance], load(ring, above + o) + load(ring, below + o), total)
    return total


@inline
def gradient_of_row(image, gradient, images, ring, y, length, pitch, steps, lanes):
    """Gradient of the loss at row y, 0 where the image was clamped; returns the row's sum of absolute differences."""
    total = simd.broadcast(0)
    lane = load(lanes, 0)
    for x_ in range(0, length, 16):
        x = min(x_, length - 16)
        o = row_of(y, IMAGES, pitch) + x
        p, q = load(images, o), load(images, o + pitch)
        raw = load(image, y * length + x)
        o = PAD + x
        slopes = blur_across(ring, y, 0, o, pitch), blur_across(ring, y, 1, o, pitch), blur_across(ring, y, 2, o, pitch)
        store(gradient, y * length + x, formulas.pixel_gradient(raw, p, q, slopes, steps))
        total = total + simd.where(lane >= F(x_ - x), simd.abs(p - q), 0)
    return simd.lane_sum(total)


@parallel
def square_errors(thread, threads, image, target, white, height, length, pitch, images, lanes, sums):
    """Every thread adds up the squared differences of each row of a band, into ``sums[2·y]``."""
    own_images, lane = images[thread], load(lanes, 0)
    for y in range(*share(height, thread, threads)):
        take_row(image, target, white, own_images, y, height, length, pitch)
        total = simd.broadcast(0)
        for x_ in range(0, length, 16):
            x = min(x_, length - 16)
            o = row_of(y, IMAGES, pitch) + x
            difference = load(own_images, o) - load(own_images, o + pitch)
            total = fma(difference, simd.where(lane >= F(x_ - x), difference, 0), total)
        sums[2 * y] = simd.lane_sum(total)


@parallel
def sweep_image(
    thread, threads, image, target, white, gradient, height, length, pitch, steps, images, moments, derivatives, ring,
    lanes, sums,
):  # fmt: skip
    """Every thread sweeps a band of rows; a row's result does not depend on the band it is in.

    The sums of SSIM and absolute differences go to ``sums[2·y]`` and ``sums[2·y + 1]``.
    """
    own_images, own_ring = images[thread], ring[thread]
    own_moments, own_derivatives = moments[thread], derivatives[thread]
    first, last = share(height, thread, threads)
    for y in range(first - 2 * SSIM_RADIUS, first):
        take_row(image, target, white, own_images, y, height, length, pitch)
    for y in range(first - SSIM_RADIUS, last + SSIM_RADIUS):
        take_row(image, target, white, own_images, y + SSIM_RADIUS, height, length, pitch)
        slot = row_of(y, DERIVATIVES, pitch)
        if y < 0 or y >= height:
            clear(own_ring, slot, slot + DERIVATIVES * pitch)
        else:
            moments_of_row(own_images, y, length, pitch, own_moments)
            similarity = similarity_of_row(own_moments, own_derivatives, length, pitch, lanes)
            if y >= first and y < last:
                sums[2 * y] = similarity
            for plane in range(DERIVATIVES):
                for x_ in range(0, length, 16):
                    x = plane * pitch + PAD + min(x_, length - 16)
                    store(own_ring, slot + x, blur_along(own_derivatives, x))
        done = y - SSIM_RADIUS
        if done >= first:
            sums[2 * done + 1] = gradient_of_row(
                image, gradient, own_images, own_ring, done, length, pitch, steps, lanes
            )


def fused_loss(
    image: Tensor, target: Tensor, dssim_weight: float, *, psnr: bool = False, derived: bool = True
) -> tuple[Tensor, Tensor]:
    """Loss, a float64 scalar, and its gradient by ``image``, which is clamped to [0, 1] first; W must be at least 6.

    Args:
        image: Contiguous float32 ``[H, W, 3]`` on the CPU.
        target: Contiguous ``[H, W, 3]``, float32 in [0, 1] or uint8.
        dssim_weight: Share of 1 - SSIM.
        psnr: Whether the rest is for PSNR instead of L1.
        derived: As for :mod:`nsvq_lightning.quality.ssim_cuda`; here the gradient comes along in any case.

    Raises:
        ValueError: The shapes differ or are not ``[H, W, 3]``, W is below 6, or a picture is not contiguous.
        TypeError: A dtype is wrong.
    """
    of_bytes = target.dtype == torch.uint8
    check_fit(f"image [H, W, 3], target [H, W, 3] {'uint8' if of_bytes else 'float32'}", image, target)
    height, width, _ = image.shape
    length = 3 * width
    if length < simd.WIDTH:
        raise ValueError(f"a row of the image must fill a vector, so its width must be at least 6, got {width}")
    pixels, wanted = flat(image), flat(target)
    pitch = (length + 2 * PAD + 15) // 16 * 16
    threads = max(1, min(thread_count(), height // RING))
    gradient = recycled(image.shape)
    work = Workspace.borrow()
    images = work.rows("images", threads, RING * IMAGES * pitch)
    moments = work.rows("moments", threads, MOMENTS * pitch)
    derivatives = work.rows("derivatives", threads, DERIVATIVES * pitch)
    ring = work.rows("ring", threads, RING * DERIVATIVES * pitch)
    moments.fill(0)
    derivatives.fill(0)
    sums = work.array("row_sums", 2 * height, np.float64)
    count = length * height
    white, lanes = F(255 if of_bytes else 1), np.arange(16, dtype=np.float32)
    error_weight = 1 - dssim_weight
    l1_step, l2_step = error_weight / count, 0.0
    if psnr:
        square_errors(threads, pixels, wanted, white, height, length, pitch, images, lanes, sums)
        squares = sums[0::2].sum() / count + formulas.MIN_ERROR
        l1_step, l2_step = 0.0, 2 * error_weight * formulas.LOG_WEIGHT / (count * squares)
    sweep_image(
        threads, pixels, wanted, white, flat(gradient), height, length, pitch,
        (F(l1_step), F(l2_step), F(dssim_weight / count)), images, moments, derivatives, ring, lanes, sums,
    )  # fmt: skip
    similarity = sums[0::2].sum() / count
    error = formulas.LOG_WEIGHT * np.log(squares) if psnr else sums[1::2].sum() / count
    work.give_back()
    return torch.tensor(error_weight * error + dssim_weight * (1 - similarity), dtype=torch.float64), gradient


def fused_loss_backward(image: Tensor, target: Tensor, gradient: Tensor, scale: Tensor) -> Tensor:
    """Gradient ``[H, W, 3]`` of ``scale`` times the loss by ``image``, from that which :func:`fused_loss` returned."""
    # With one view per step the scale is 1, and skipping a pass over the image pays.
    return gradient if scale == 1 else gradient * scale
