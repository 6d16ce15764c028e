"""L1 and D-SSIM with their gradient in one sweep down an image.

Each row is met once: vertical blur of the five moment planes, horizontal blur, SSIM and its three derivative planes,
horizontal blur of those into a ring of eleven rows, and, five rows later, their vertical blur, which is the gradient
(the blur is its own adjoint). Nothing but a few rows is ever in memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from nsvq_lightning.losses import SSIM_C1, SSIM_C2, SSIM_RADIUS, ssim_window
from nsvq_lightning.rendering.cpu.jit import inline, kernel, thread_count
from nsvq_lightning.rendering.cpu.lanes import fma, fnma, lane_sum, load, select, splat, store, vfabs
from nsvq_lightning.rendering.cpu.records import F
from nsvq_lightning.rendering.cpu.workspace import Workspace

__all__ = ["l1_dssim"]

G0, G1, G2, G3, G4, G5 = (F(tap) for tap in ssim_window()[SSIM_RADIUS:].tolist())
C1, C2 = F(SSIM_C1), F(SSIM_C2)
PAD = 16
"""Zeros beside every row, at least 3·radius floats, so that the horizontal blur needs no border case."""
RING = 2 * SSIM_RADIUS + 1
MOMENTS = 5
DERIVATIVES = 3
LANE_NUMBERS = np.arange(16, dtype=np.float32)


@inline
def blur_along(row, o):
    """Eleven taps along a padded row of interleaved RGB (neighbouring pixels are 3 floats apart)."""
    total = splat(G0) * load(row, o)
    total = fma(splat(G1), load(row, o - 3) + load(row, o + 3), total)
    total = fma(splat(G2), load(row, o - 6) + load(row, o + 6), total)
    total = fma(splat(G3), load(row, o - 9) + load(row, o + 9), total)
    total = fma(splat(G4), load(row, o - 12) + load(row, o + 12), total)
    return fma(splat(G5), load(row, o - 15) + load(row, o + 15), total)


@inline
def add_row(image, target, o, weight, sums):
    """Add one row's moments (p, q, p², q², pq) times a tap."""
    p, q = load(image, o), load(target, o)
    wp, wq = weight * p, weight * q
    return sums[0] + wp, sums[1] + wq, fma(wp, p, sums[2]), fma(wq, q, sums[3]), fma(wp, q, sums[4])


@inline
def add_pair(image, target, above, below, weight, sums):
    """Add the moments of two rows that share a tap."""
    p, q, r, s = load(image, above), load(target, above), load(image, below), load(target, below)
    return (
        fma(weight, p + r, sums[0]),
        fma(weight, q + s, sums[1]),
        fma(weight, fma(p, p, r * r), sums[2]),
        fma(weight, fma(q, q, s * s), sums[3]),
        fma(weight, fma(p, q, r * s), sums[4]),
    )


@inline
def moments_of_row(image, target, y, height, length, pitch, moments):
    """Vertical blur of the five moment planes at row y; rows outside the image count as zeros."""
    zero = splat(F(0))
    inner = y >= SSIM_RADIUS and y < height - SSIM_RADIUS
    for x_ in range(0, length, 16):
        # The last vector of a row overlaps the one before instead of running over.
        x = min(x_, length - 16)
        sums = (zero, zero, zero, zero, zero)
        if inner:
            o = y * length + x
            sums = add_row(image, target, o, splat(G0), sums)
            sums = add_pair(image, target, o - length, o + length, splat(G1), sums)
            sums = add_pair(image, target, o - 2 * length, o + 2 * length, splat(G2), sums)
            sums = add_pair(image, target, o - 3 * length, o + 3 * length, splat(G3), sums)
            sums = add_pair(image, target, o - 4 * length, o + 4 * length, splat(G4), sums)
            sums = add_pair(image, target, o - 5 * length, o + 5 * length, splat(G5), sums)
        else:
            taps = (G0, G1, G2, G3, G4, G5)
            for k in range(max(-SSIM_RADIUS, -y), min(SSIM_RADIUS + 1, height - y)):
                sums = add_row(image, target, (y + k) * length + x, splat(taps[abs(k)]), sums)
        o = PAD + x
        store(moments, o, sums[0])
        store(moments, pitch + o, sums[1])
        store(moments, 2 * pitch + o, sums[2])
        store(moments, 3 * pitch + o, sums[3])
        store(moments, 4 * pitch + o, sums[4])


@inline
def similarity_of_row(moments, derivatives, length, pitch, lanes):
    """Sum of SSIM over a row; its derivatives by blurred p, p² and pq into three padded rows."""
    one, two, c1, c2 = splat(F(1)), splat(F(2)), splat(C1), splat(C2)
    total = splat(F(0))
    lane = load(lanes, 0)
    for x_ in range(0, length, 16):
        x = min(x_, length - 16)
        o = PAD + x
        m1, m2 = blur_along(moments, o), blur_along(moments, pitch + o)
        m11, m22, m12 = m1 * m1, m2 * m2, m1 * m2
        v1 = blur_along(moments, 2 * pitch + o) - m11
        v2 = blur_along(moments, 3 * pitch + o) - m22
        v12 = blur_along(moments, 4 * pitch + o) - m12
        a, d = fma(two, m12, c1), fma(two, v12, c2)
        e, f = one / (m11 + m22 + c1), one / (v1 + v2 + c2)
        ef = e * f
        similarity = a * d * ef
        by_product = two * a * ef
        by_square = -(similarity * f)
        by_mean = two * (m2 * d * ef - m1 * similarity * e - m1 * by_square) - m2 * by_product
        store(derivatives, o, by_mean)
        store(derivatives, pitch + o, by_square)
        store(derivatives, 2 * pitch + o, by_product)
        total = total + select(lane >= splat(F(x_ - x)), similarity, splat(F(0)))
    return lane_sum(total)


@inline
def blur_across(ring, y, plane, o, pitch):
    """Eleven taps down the ring, centred on row y, of one derivative plane."""
    p = plane * pitch + o
    s = DERIVATIVES * pitch
    total = splat(G0) * load(ring, (y + RING) % RING * s + p)
    total = fma(splat(G1), load(ring, (y + RING - 1) % RING * s + p) + load(ring, (y + 1) % RING * s + p), total)
    total = fma(splat(G2), load(ring, (y + RING - 2) % RING * s + p) + load(ring, (y + 2) % RING * s + p), total)
    total = fma(splat(G3), load(ring, (y + RING - 3) % RING * s + p) + load(ring, (y + 3) % RING * s + p), total)
    total = fma(splat(G4), load(ring, (y + RING - 4) % RING * s + p) + load(ring, (y + 4) % RING * s + p), total)
    return fma(splat(G5), load(ring, (y + RING - 5) % RING * s + p) + load(ring, (y + 5) % RING * s + p), total)


@inline
def gradient_of_row(image, target, gradient, ring, y, length, pitch, l1_step, ssim_step, lanes):
    """Gradient of the loss at row y; returns the row's sum of absolute differences."""
    zero, two = splat(F(0)), splat(F(2))
    step, scale = splat(l1_step), splat(ssim_step)
    total = zero
    lane = load(lanes, 0)
    for x_ in range(0, length, 16):
        x = min(x_, length - 16)
        o = y * length + x
        p, q = load(image, o), load(target, o)
        g = blur_across(ring, y, 0, PAD + x, pitch)
        g = fma(two * p, blur_across(ring, y, 1, PAD + x, pitch), g)
        g = fma(q, blur_across(ring, y, 2, PAD + x, pitch), g)
        sign = select(p > q, step, select(p < q, -step, zero))
        store(gradient, o, fnma(scale, g, sign))
        total = total + select(lane >= splat(F(x_ - x)), vfabs(p - q), zero)
    return lane_sum(total)


@inline
def sweep(
    image,
    target,
    gradient,
    first,
    last,
    height,
    length,
    pitch,
    l1_step,
    ssim_step,
    moments,
    derivatives,
    ring,
    lanes,
    sums,
):
    """Do some rows; their sums of SSIM and of absolute differences go to ``sums[2·y]`` and ``sums[2·y + 1]``."""
    zero = splat(F(0))
    for y in range(first - SSIM_RADIUS, last + SSIM_RADIUS):
        slot = (y + RING) % RING * DERIVATIVES * pitch
        if y < 0 or y >= height:
            for x in range(0, DERIVATIVES * pitch, 16):
                store(ring, slot + x, zero)
        else:
            moments_of_row(image, target, y, height, length, pitch, moments)
            similarity = similarity_of_row(moments, derivatives, length, pitch, lanes)
            if y >= first and y < last:
                sums[2 * y] = similarity
            for plane in range(DERIVATIVES):
                for x_ in range(0, length, 16):
                    x = plane * pitch + PAD + min(x_, length - 16)
                    store(ring, slot + x, blur_along(derivatives, x))
        done = y - SSIM_RADIUS
        if done >= first:
            sums[2 * done + 1] = gradient_of_row(
                image, target, gradient, ring, done, length, pitch, l1_step, ssim_step, lanes
            )


@kernel
def sweep_image(
    threads, image, target, gradient, height, length, pitch, l1_step, ssim_step, moments, derivatives, ring, lanes, sums
):
    """Every thread sweeps a band of rows; a row's result does not depend on the band it is in."""
    for thread in prange(threads):
        sweep(
            image, target, gradient, height * thread // threads, height * (thread + 1) // threads, height, length,
            pitch, l1_step, ssim_step, moments[thread], derivatives[thread], ring[thread], lanes, sums,
        )  # fmt: skip


def l1_dssim(image: Tensor, target: Tensor, dssim_weight: float) -> tuple[float, Tensor]:
    """Loss and its gradient by ``image``; both images contiguous float32 ``[H, W, 3]`` on the CPU, W at least 6."""
    height, width = image.shape[:2]
    length = 3 * width
    pitch = (length + 2 * PAD + 15) // 16 * 16
    threads = max(1, min(thread_count(), height // RING))
    gradient = torch.empty_like(image)
    work = Workspace.borrow()
    rows: dict[str, Any] = {
        name: work.rows(name, threads, planes * pitch)
        for name, planes in (("moments", MOMENTS), ("derivatives", DERIVATIVES), ("ring", RING * DERIVATIVES))
    }
    for padded in (rows["moments"], rows["derivatives"]):
        padded.fill(0)
    sums = work.array("row_sums", 2 * height, np.float64)
    count = length * height
    sweep_image(
        threads, image.numpy().reshape(-1), target.numpy().reshape(-1), gradient.numpy().reshape(-1), height, length,
        pitch, F((1 - dssim_weight) / count), F(dssim_weight / count), rows["moments"], rows["derivatives"],
        rows["ring"], LANE_NUMBERS, sums,
    )  # fmt: skip
    similarity, difference = sums[0::2].sum() / count, sums[1::2].sum() / count
    work.give_back()
    return float((1 - dssim_weight) * difference + dssim_weight * (1 - similarity)), gradient
