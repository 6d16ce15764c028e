"""Screen-space statistics of density control in one pass over the splats."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from nsvq_lightning.compute.jit import F, parallel, parts_of
from nsvq_lightning.compute.memory import INT32, flat_checked
from nsvq_lightning.compute.rows import share
from nsvq_lightning.compute.simd import get, put


@parallel
def _add(part, parts, gradients, columns, radii, x_factor, y_factor, factor, sums, views, weights):
    first, end = share(radii.shape[0], part, parts)
    for i in range(first, end):
        if get(radii, i) > 0:
            x = x_factor * get(gradients, columns * i)
            y = y_factor * get(gradients, columns * i + 1)
            put(sums, i, get(sums, i) + np.sqrt(x * x + y * y))
            put(views, i, get(views, i) + F(1))
            if columns == 3 and get(gradients, 3 * i + 2) > 0:
                put(weights, i, get(weights, i) + factor * get(gradients, 3 * i + 2))


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
    x_factor, y_factor, factor = F(factors[0]), F(factors[1]), F(0)
    if columns == 3:  # one thread adds up, and so to the same bits for any number of them
        positive = np.fmax(given[2::3], 0)
        total = positive.sum(dtype=np.float64)
        factor = F(np.count_nonzero(positive) / total) if total > 0 else F(0)
    # The first table stands in for that of the weights, which is then not touched.
    changed = [flat_checked("a table", table, rows) for table in (tables if columns == 3 else [*tables, tables[0]])]
    _add(parts_of(len(seen), 8192), given, columns, seen, x_factor, y_factor, factor, *changed)
