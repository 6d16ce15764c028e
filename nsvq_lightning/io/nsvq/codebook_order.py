"""Order the rows of a codebook so that similar rows have similar indices: the leaves of a tree of halvings."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.compute.jit import kernel
from nsvq_lightning.compute.memory import check_table


def tree_order(codebook: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices ``[K]`` of the rows of ``codebook [K, D]`` in the order of the leaves of a tree.

    The rows are cut into two halves across the direction in which they differ most, each half again, and so on; for an
    odd number of rows, the first half gets one more.

    Raises:
        ValueError: It has another shape, or is not contiguous.
        TypeError: It is not float32.
    """
    check_table("codebook", codebook)
    order = np.arange(len(codebook))
    _cut(codebook.astype(np.float64), order)
    return order


def leaf_paths(count: int) -> NDArray[np.int64]:
    """Path ``[count]`` of each leaf, ascending: the halves taken from the root, ⌈log2 count⌉ bits, 0 after the leaf."""
    low, high = np.zeros(count, np.int64), np.full(count, count, np.int64)
    paths, leaves = np.zeros(count, np.int64), np.arange(count)
    for _ in range((count - 1).bit_length()):
        cut = low + (high - low + 1) // 2
        right = (leaves >= cut) & (high - low > 1)
        low, high = np.where(right, cut, low), np.where(right, high, np.minimum(cut, high))
        paths = 2 * paths + right
    return paths


def sibling_distance(ordered: NDArray[np.float32]) -> float:
    """How much two neighbours of an ordered codebook typically differ per column; 0 for a single row.

    It is the median over the pairs of the root mean square over the columns: how far apart codes are where they are
    dense, and so how exactly they must be stored.
    """
    differences = np.diff(ordered.astype(np.float64), axis=0)[::2]
    return float(np.median(np.sqrt((differences**2).mean(1)))) if differences.size else 0.0


# Power-iteration steps for the direction of a cut. It need not be exact: 12 would save another 0.02 % of a file.
_ITERATIONS = 4


@partial(kernel, parallel=False)
def _cut(rows, order):  # type: ignore[no-untyped-def]
    # Plain loops: every expression of whole arrays would be a kernel of its own, compiled for a second.
    dim = rows.shape[1]
    starts, ends = np.empty(128, np.int64), np.empty(128, np.int64)
    starts[0], ends[0], waiting = 0, len(rows), 1
    center, direction, product = np.empty(dim), np.empty(dim), np.empty(dim)
    while waiting > 0:
        waiting -= 1
        start, end = starts[waiting], ends[waiting]
        if end - start < 2:
            continue
        center[:] = 0
        for i in range(start, end):
            for j in range(dim):
                center[j] += rows[order[i], j]
        for j in range(dim):
            center[j] /= end - start
        # The search for the direction starts from the column that varies most.
        product[:] = 0
        for i in range(start, end):
            for j in range(dim):
                product[j] += (rows[order[i], j] - center[j]) ** 2
        direction[:] = 0
        direction[np.argmax(product)] = 1
        for _ in range(_ITERATIONS):
            product[:] = 0
            for i in range(start, end):
                along = 0.0
                for j in range(dim):
                    along += (rows[order[i], j] - center[j]) * direction[j]
                for j in range(dim):
                    product[j] += (rows[order[i], j] - center[j]) * along
            squared = 0.0
            for j in range(dim):
                squared += product[j] ** 2
            length = np.sqrt(squared)
            if not length > 0:
                break
            for j in range(dim):
                direction[j] = product[j] / length
        projections = np.empty(end - start)
        for i in range(start, end):
            along = 0.0
            for j in range(dim):
                along += rows[order[i], j] * direction[j]
            projections[i - start] = along
        places = np.argsort(projections, kind="mergesort")
        before = order[start:end].copy()
        for i in range(end - start):
            order[start + i] = before[places[i]]
        middle = start + (end - start + 1) // 2
        starts[waiting], ends[waiting] = start, middle
        starts[waiting + 1], ends[waiting + 1] = middle, end
        waiting += 2
