"""A palette for many rows: cells of similar rows, found by always splitting the cell where that gains most."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.compute.jit import kernel
from nsvq_lightning.compute.memory import check_array, check_table
from nsvq_lightning.io.scalar_kmeans import split
from nsvq_lightning.splats.conventions import Float32s, Float64s, Int64s


def find_palette(rows: Float32s, weight: NDArray[np.number[Any]], count: int) -> tuple[Float32s, Int64s]:
    """Few rows that represent many with a small weighted squared distance; the rows themselves if they are few enough.

    All rows start as one cell, which is cut across the direction in which they differ most, where that reduces the sum
    of squares most; then always the cell that gains most, until there are enough. A cell of equal rows is never cut.
    The time hardly depends on the number of cells, while that of k-means grows with it: 65 536 cells of 100 000 rows
    take seconds, not minutes.

    Args:
        rows: ``[N, D]``, finite.
        weight: How much each row matters ``[N]``, positive.
        count: Largest number of cells.

    Returns:
        The mean of each cell ``[K, D]`` with K at most ``count``, and the cell of each row ``[N]``.

    Raises:
        TypeError: ``rows`` are not float32.
        ValueError: They have another shape, are not contiguous, or the number of weights differs.
    """
    check_table("rows", rows)
    wide = weight.astype(np.float64)
    check_array("weight", wide, rows.shape[:1], wide.dtype)
    cells, labels = _Cells(rows, wide), np.empty(len(rows), np.int64)
    for number, (start, end) in enumerate(split(cells.best_cut, len(rows), count)):
        labels[cells.order[start:end]] = number
    mass = np.bincount(labels, wide)
    sums = (np.bincount(labels, wide * column) for column in rows.T)
    return np.stack([total / mass for total in sums], axis=1).astype(np.float32), labels


def in_order_of_use(rows: Float32s, labels: NDArray[np.integer]) -> tuple[Float32s, Int64s]:
    """The distinct rows in use, in order of first use by the splats, and the row of each splat.

    Neighbours then have similar labels. If each splat has its own row, labels count up and cost next to nothing.

    Args:
        rows: ``[K, D]``.
        labels: Row of each splat ``[N]``.
    """
    used, labels = np.unique(labels, return_inverse=True)
    distinct, same = np.unique(rows[used], axis=0, return_inverse=True)
    labels = same.reshape(-1)[labels]  # its shape differs between releases of NumPy
    _, first = np.unique(labels, return_index=True)
    order = first.argsort()
    return distinct[order], order.argsort()[labels]


class _Cells:
    """Runs of ``order [N]``, the indices of the rows; each run is a cell."""

    def __init__(self, rows: Float32s, weight: Float64s) -> None:
        self._rows, self._weight = rows, weight
        self.order = np.arange(len(rows))

    def best_cut(self, start: int, end: int) -> tuple[float, int]:
        """Sort a cell along its direction; returns how much the sum of squares falls if it is cut in two, and where."""
        if end - start < 2:
            return -1.0, start
        numbers = self.order[start:end]
        along = np.empty(end - start)
        _place_along(self._rows, self._weight, numbers, along)
        ranks = along.argsort(kind="stable")
        numbers[:] = numbers[ranks]
        mass = self._weight[numbers].cumsum()
        total = (self._weight[numbers] * along[ranks]).cumsum()
        left, right = mass[:-1], mass[-1] - mass[:-1]
        gains = np.square(total[:-1] / left - (total[-1] - total[:-1]) / right) * (left * right / mass[-1])
        best = int(gains.argmax())
        return float(gains[best]) or -1.0, start + 1 + best  # equal rows gain nothing


@kernel
def _place_along(rows, weight, numbers, along):  # type: ignore[no-untyped-def]
    """Positions of some rows along the direction in which they differ most; 0 if they are equal."""
    dim = rows.shape[1]
    along[:] = 0
    mean, product, direction = np.zeros(dim), np.zeros(dim), np.zeros(dim)
    equal, mass = True, 0.0
    for i in numbers:
        mass += weight[i]
        for j in range(dim):
            mean[j] += weight[i] * rows[i, j]
            equal &= rows[i, j] == rows[numbers[0], j]
    if equal:
        return
    # The search for the direction starts from the column that varies most.
    widest = 0
    for j in range(dim):
        mean[j] /= mass
        for i in numbers:
            product[j] += weight[i] * (rows[i, j] - mean[j]) ** 2
        if product[j] > product[widest]:
            widest = j
    direction[widest] = 1
    for _ in range(4):  # steps of power iteration: the direction of a cut need not be exact
        length = 0.0
        product[:] = 0
        for n, i in enumerate(numbers):
            along[n] = 0
            for j in range(dim):
                along[n] += (rows[i, j] - mean[j]) * direction[j]
            for j in range(dim):
                product[j] += weight[i] * along[n] * (rows[i, j] - mean[j])
        for j in range(dim):
            length += product[j] ** 2
        length = np.sqrt(length)
        if not length > 0:
            return
        for j in range(dim):
            direction[j] = product[j] / length
