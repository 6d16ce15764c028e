"""How much of a splat's light the blur leaves, 16 splats at a time, and its gradient.

The equation is that of :func:`nsvq_lightning.rendering.reference.light_kept`.
"""

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.jit import F, inline, kernel, thread_count
from nsvq_lightning.compute.memory import Array, flat, flat_checked, outside
from nsvq_lightning.rendering import constants
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.cpu import records as rec
from nsvq_lightning.rendering.cpu.projection import BLUR, BLUR_SQUARED, HUGE_FOOTPRINT, affine, axes_of, image_axes
from nsvq_lightning.rendering.cpu.projection_backward import axes_backward
from nsvq_lightning.splats.splats import SplatTensors

LEAST = F(constants.FAINTEST**2)


@inline
def light(u, v):
    """Square of the factor, area² = det Σ, sum of the variances, what the blur adds to det Σ, and u × v."""
    n = rec.cross(u, v)
    area, size = rec.dot3(n, n), rec.dot3(u, u) + rec.dot3(v, v)
    added = BLUR * size + BLUR_SQUARED
    squared = simd.select(size < HUGE_FOOTPRINT, area / (area + added), 1)
    return simd.vmax(squared, LEAST), area, size, added, n


@kernel
def keep_light(threads, camera, means, quats, scales, ids, count, factors):
    """Factors ``[count]`` of the splats ``ids``; both arrays have room for a last, incomplete vector."""
    for thread in prange(threads):
        first, last = rec.vector_range(count, thread, threads)
        for start in range(first, last, 16):
            _, _, _, t0, t1 = affine(camera, simd.gather_rows3(means, ids, start))
            _, _, _, m = axes_of(simd.gather_rows4(quats, ids, start), simd.gather_rows3(scales, ids, start))
            squared, _, _, _, _ = light(image_axes(t0, m), image_axes(t1, m))
            simd.store(factors, start, simd.vsqrt(squared))


@kernel
def keep_light_backward(threads, camera, means, quats, scales, ids, count, gradient, g_means, g_quats, g_scales):
    """Gradients of the rows ``ids`` of all means, quaternions and log-scales from that of their factors ``[count]``.

    With A = det Σ, S the sum of the variances and D = A + b·S + b², the factor is ρ = √(A/D), and
    dρ = ½·ρ·((b·S + b²)/(A·D)·dA − b/D·dS), where dA = 2·((v × n)·du + (n × u)·dv) with n = u × v.
    """
    for thread in prange(threads):
        first, last = rec.vector_range(count, thread, threads)
        for start in range(first, last, 16):
            view = affine(camera, simd.gather_rows3(means, ids, start))
            axes = axes_of(simd.gather_rows4(quats, ids, start), simd.gather_rows3(scales, ids, start))
            _, _, _, t0, t1 = view
            _, _, _, m = axes
            u, v = image_axes(t0, m), image_axes(t1, m)
            squared, area, size, added, n = light(u, v)
            # At the floor, and where the blur does not count, the factor is constant.
            free = (size < HUGE_FOOTPRINT) & (squared > LEAST)
            # A huge splat's v × n would overflow, and 0 · ∞ is not 0.
            u = simd.select(free, u[0], 0), simd.select(free, u[1], 0), simd.select(free, u[2], 0)
            v = simd.select(free, v[0], 0), simd.select(free, v[1], 0), simd.select(free, v[2], 0)
            whole = area + added
            g = simd.select(free, simd.load(gradient, start) * simd.vsqrt(squared) / whole, 0)
            by_area = simd.select(free, g * added / area, 0)
            by_size = g * BLUR
            vn, nu = rec.cross(v, n), rec.cross(n, u)
            gu = by_area * vn[0] - by_size * u[0], by_area * vn[1] - by_size * u[1], by_area * vn[2] - by_size * u[2]
            gv = by_area * nu[0] - by_size * v[0], by_area * nu[1] - by_size * v[1], by_area * nu[2] - by_size * v[2]
            g_mean, g_quat = axes_backward(camera, view, axes, gu, gv, 0, 0, 0)
            simd.scatter_rows3(g_means, ids, start, g_mean)
            simd.scatter_rows4(g_quats, ids, start, g_quat)
            simd.scatter_rows3(
                g_scales,
                ids,
                start,
                (gu[0] * u[0] + gv[0] * v[0], gu[1] * u[1] + gv[1] * v[1], gu[2] * u[2] + gv[2] * v[2]),
            )


class _LightKept(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: Array, ids: Array, count: int, *attributes: Tensor) -> Tensor:
        factors = torch.empty(len(ids))
        keep_light(thread_count(), camera, *_flat(attributes), ids, count, flat(factors))
        ctx.camera, ctx.ids, ctx.count = camera, ids, count
        ctx.save_for_backward(*attributes)
        return factors[:count]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        attributes = ctx.saved_tensors
        gradients = [torch.zeros(tensor.shape) for tensor in attributes]
        given = torch.zeros(len(ctx.ids))
        given[: ctx.count], given[ctx.count :] = grad, grad[-1]
        keep_light_backward(
            thread_count(), ctx.camera, *_flat(attributes), ctx.ids, ctx.count, flat(given), *map(flat, gradients)
        )
        return None, None, None, *gradients


def _flat(attributes: tuple[Tensor, ...]) -> list[Array]:
    count = len(attributes[0])
    named = zip(("means", "quats", "scales"), attributes, (3, 4, 3), strict=True)
    return [flat_checked(name, tensor.contiguous(), (count, width)) for name, tensor, width in named]


def light_kept(splats: SplatTensors, camera: Camera, rows: Tensor) -> Tensor:
    """Factors ``[V]`` of the splats ``rows [V]`` int64, differentiable in means, quaternions and log-scales.

    Raises:
        ValueError: The attributes do not fit together, or a row is outside them.
        TypeError: An attribute is not float32.
    """
    count = len(rows)
    if count == 0:
        return splats.means.new_zeros(0)
    numbers = rows.detach().numpy()
    if int(numbers.min()) < 0 or int(numbers.max()) >= len(splats.means):
        raise outside("rows", numbers, len(splats.means))
    # A last, incomplete vector repeats the last splat; each of its lanes computes and writes the same.
    ids = np.full(16 * ((count + 15) // 16), numbers[-1], np.int32)
    ids[:count] = numbers
    factors: Tensor = _LightKept.apply(rec.pack_camera(camera), ids, count, splats.means, splats.quats, splats.scales)
    return factors
