"""Screen-space statistics of density control in one pass over the splats."""

import numpy as np
from numba import prange
from torch import Tensor

from nsvq_lightning.compute.jit import F, kernel, thread_count
from nsvq_lightning.compute.memory import INT32, flat_checked
from nsvq_lightning.compute.simd import get, put


@kernel
def _add(threads, gradients, radii, x_factor, y_factor, sums, views):
    count = radii.shape[0]
    for thread in prange(threads):
        for i in range(count * thread // threads, count * (thread + 1) // threads):
            if get(radii, i) > 0:
                x, y = x_factor * get(gradients, 2 * i), y_factor * get(gradients, 2 * i + 1)
                put(sums, i, get(sums, i) + np.sqrt(x * x + y * y))
                put(views, i, get(views, i) + F(1))


def add_view(sums: Tensor, views: Tensor, gradients: Tensor, radii: Tensor, factors: tuple[float, float]) -> None:
    """Add the norms of one view's screen-space gradients, and count it, where a splat was seen; in place.

    Args:
        sums: Sum of the norms ``[N]`` float32.
        views: Number of views ``[N]`` float32.
        gradients: Gradient with respect to the projected centres ``[N, 2]`` float32, per pixel.
        radii: Radius on the screen ``[N]`` int32, 0 for splats that were not seen.
        factors: Factors of the two components.

    Raises:
        ValueError: The tensors differ in length, or one that is read or written in place is not contiguous.
        TypeError: A dtype is wrong.
    """
    rows = tuple(radii.shape[:1])
    inputs = (flat_checked("gradients", gradients.contiguous(), (*rows, 2)), flat_checked("radii", radii, rows, INT32))
    outputs = flat_checked("sums", sums, rows), flat_checked("views", views, rows)
    _add(thread_count(), *inputs, F(factors[0]), F(factors[1]), *outputs)


# Parts of the splats whose weights are summed one by one: as many for any number of threads, so with the same bits.
CHUNKS = 64


@kernel
def _add_absgrad(threads, absgrad, radii, x_factor, y_factor, partial, gradients, views, weights):
    count = radii.shape[0]
    for chunk in prange(CHUNKS):
        total, positive = 0.0, 0.0
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            weight = get(absgrad, 3 * i + 2)
            if weight > 0:
                total += weight
                positive += 1.0
        put(partial, 2 * chunk, total)
        put(partial, 2 * chunk + 1, positive)
    total, positive = 0.0, 0.0
    for chunk in range(CHUNKS):
        total += get(partial, 2 * chunk)
        positive += get(partial, 2 * chunk + 1)
    scale = F(positive / total) if total > 0 else F(0)
    for thread in prange(threads):
        for i in range(count * thread // threads, count * (thread + 1) // threads):
            if get(radii, i) > 0:
                x, y = x_factor * get(absgrad, 3 * i), y_factor * get(absgrad, 3 * i + 1)
                put(gradients, i, get(gradients, i) + np.sqrt(x * x + y * y))
                put(views, i, get(views, i) + F(1))
                weight = get(absgrad, 3 * i + 2)
                if weight > 0:
                    put(weights, i, get(weights, i) + scale * weight)


def add_absgrad(
    gradients: Tensor, views: Tensor, weights: Tensor, absgrad: Tensor, radii: Tensor, factors: tuple[float, float]
) -> None:
    """Add the absolute gradients and weights of a view, where a splat was seen; in place.

    Args:
        gradients: Sum of the norms of absolute gradients ``[N]`` float32.
        views: Number of views ``[N]`` float32.
        weights: Sum of the weights ``[N]`` float32, those of a view divided by the mean of its positive ones.
        absgrad: Σ |∂L/∂x|, Σ |∂L/∂y| per pixel, and the weight ``[N, 3]`` float32.
        radii: Radius on the screen ``[N]`` int32, 0 for splats that were not seen.
        factors: Factors of the first two columns.

    Raises:
        ValueError: The tensors differ in length, or one that is read or written in place is not contiguous.
        TypeError: A dtype is wrong.
    """
    rows = tuple(radii.shape[:1])
    inputs = (flat_checked("absgrad", absgrad.contiguous(), (*rows, 3)), flat_checked("radii", radii, rows, INT32))
    tables = {"gradients": gradients, "views": views, "weights": weights}
    outputs = (flat_checked(name, table, rows) for name, table in tables.items())
    partial = np.empty(2 * CHUNKS)
    _add_absgrad(thread_count(), *inputs, F(factors[0]), F(factors[1]), partial, *outputs)
