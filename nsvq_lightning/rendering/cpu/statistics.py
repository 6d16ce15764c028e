"""Screen-space statistics of density control in one pass over the splats."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from nsvq_lightning.compute.jit import F, parallel, thread_count
from nsvq_lightning.compute.memory import INT32, flat_checked
from nsvq_lightning.compute.simd import get, put


@parallel
def _add(thread, threads, gradients, columns, radii, x_factor, y_factor, sums, views):
    count = radii.shape[0]
    for i in range(count * thread // threads, count * (thread + 1) // threads):
        if get(radii, i) > 0:
            x, y = x_factor * get(gradients, columns * i), y_factor * get(gradients, columns * i + 1)
            put(sums, i, get(sums, i) + np.sqrt(x * x + y * y))
            put(views, i, get(views, i) + F(1))


# Parts of the splats whose weights are summed one by one: as many for any number of threads, so with the same bits.
CHUNKS = 64


@parallel
def _sum_weights(chunk, chunks, gradients, partial):
    count = gradients.shape[0] // 3
    total, positive = 0.0, 0.0
    for i in range(count * chunk // chunks, count * (chunk + 1) // chunks):
        weight = get(gradients, 3 * i + 2)
        if weight > 0:
            total += weight
            positive += 1.0
    put(partial, 2 * chunk, total)
    put(partial, 2 * chunk + 1, positive)


@parallel
def _add_weights(thread, threads, gradients, radii, partial, weights):
    count = radii.shape[0]
    total, positive = 0.0, 0.0
    for chunk in range(CHUNKS):
        total += get(partial, 2 * chunk)
        positive += get(partial, 2 * chunk + 1)
    scale = F(positive / total) if total > 0 else F(0)
    for i in range(count * thread // threads, count * (thread + 1) // threads):
        weight = get(gradients, 3 * i + 2)
        if get(radii, i) > 0 and weight > 0:
            put(weights, i, get(weights, i) + scale * weight)


def add_view(tables: Sequence[Tensor], gradients: Tensor, radii: Tensor, factors: tuple[float, float]) -> None:
    """Add the norms of one view's screen-space gradients, count it, and add its weights, where a splat was seen.

    Args:
        tables: Changed in place, ``[N]`` float32 each: sum of the norms; number of views; and, if there is a third one,
            sum of the weights, those of a view divided by the mean of its positive ones.
        gradients: Per pixel, x and y of each splat ``[N, 2]`` float32; with a table of weights x, y and the weight.
        radii: Radius on the screen ``[N]`` int32, 0 for splats that were not seen.
        factors: Factors of x and y.

    Raises:
        ValueError: The tensors differ in length, or one that is read or written in place is not contiguous.
        TypeError: A dtype is wrong.
    """
    rows, columns = tuple(radii.shape[:1]), len(tables)
    given = flat_checked("gradients", gradients.contiguous(), (*rows, columns))
    seen = flat_checked("radii", radii, rows, INT32)
    sums, views, *weights = (flat_checked("a table", table, rows) for table in tables)
    _add(thread_count(), given, columns, seen, F(factors[0]), F(factors[1]), sums, views)
    for total in weights:
        partial = np.empty(2 * CHUNKS)
        _sum_weights(CHUNKS, given, partial)
        _add_weights(thread_count(), given, seen, partial, total)
