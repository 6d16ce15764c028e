"""Few rows, or numbers, that represent many: of cells of similar ones, always the one is cut where that gains most."""

from heapq import heappop, heappush

import numpy as np

from nsvq_lightning.compute.jit import inline, kernel
from nsvq_lightning.splats.conventions import Arrays, Float32s, Float64s, Int64s, Integers, Uint8s


def find_palette(rows: Float32s, weight: Arrays, count: int) -> tuple[Float32s, Int64s]:
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
    """
    wide = np.broadcast_to(weight, len(rows)).astype(np.float64)
    order = np.arange(len(rows))
    # Of each cell: how much less the sum of squares is if it is cut, negative; start, cut, end.
    heap: list[tuple[float, int, int, int]] = []

    def add(start: int, end: int) -> None:
        """Find how much the sum of squares of a cell falls at most if it is cut in two, and where."""
        gain, cut = -1.0, start
        if end - start > 1:
            numbers = order[start:end]
            along = np.empty(end - start)
            _place_along(rows, wide, numbers, along)
            ranks = along.argsort(kind="stable")
            numbers[:] = numbers[ranks]
            masses = wide[numbers].cumsum()
            sums = (wide[numbers] * along[ranks]).cumsum()
            left, right = masses[:-1], masses[-1] - masses[:-1]
            gains = np.square(sums[:-1] / left - (sums[-1] - sums[:-1]) / right) * (left * right / masses[-1])
            best = int(gains.argmax())
            gain, cut = float(gains[best]) or -1.0, start + 1 + best  # equal numbers gain nothing
        heappush(heap, (-gain, start, cut, end))

    add(0, len(rows))
    while len(heap) < count and heap[0][0] <= 0:
        _, start, cut, end = heappop(heap)
        add(start, cut)
        add(cut, end)
    labels = np.empty(len(rows), np.int64)
    for number, (_, start, _, end) in enumerate(heap):
        labels[order[start:end]] = number
    mass = np.bincount(labels, wide)
    means = [np.bincount(labels, wide * column) / mass for column in rows.T]
    return np.stack(means, axis=1).astype(np.float32), labels


@kernel
def _place_along(rows, weight, numbers, along):  # type: ignore[no-untyped-def]
    """Positions of some rows along the direction in which they differ most; 0 if they are equal."""
    dim = rows.shape[1]
    along[:] = 0
    equal = True
    for i in numbers:
        for j in range(dim):
            equal &= rows[i, j] == rows[numbers[0], j]
    if equal:
        return
    mean, direction = mean_and_direction(rows, weight, numbers, 3)
    for n, i in enumerate(numbers):
        for j in range(dim):
            along[n] += (rows[i, j] - mean[j]) * direction[j]


@inline
def mean_and_direction(rows, weight, numbers, steps):  # type: ignore[no-untyped-def]
    """The mean of some rows, and the direction in which they differ most, by so many steps of power iteration.

    It need not be exact for a cut. Without weights (None), each row counts the same.
    """
    # Plain loops: every expression of whole arrays would be a kernel of its own, compiled for a second.
    dim = rows.shape[1]
    mean, product, direction = np.zeros(dim), np.zeros(dim), np.zeros(dim)
    mass = 0.0
    for i in numbers:
        each = 1.0 if weight is None else weight[i]
        mass += each
        for j in range(dim):
            mean[j] += each * rows[i, j]
    for j in range(dim):
        mean[j] /= mass
    # The search starts from the column that varies most.
    for i in numbers:
        each = 1.0 if weight is None else weight[i]
        for j in range(dim):
            product[j] += each * (rows[i, j] - mean[j]) ** 2
    direction[np.argmax(product)] = 1
    for _ in range(steps):
        product[:] = 0
        for i in numbers:
            along = 0.0
            for j in range(dim):
                along += (rows[i, j] - mean[j]) * direction[j]
            if weight is not None:
                along *= weight[i]
            for j in range(dim):
                product[j] += along * (rows[i, j] - mean[j])
        squared = 0.0
        for j in range(dim):
            squared += product[j] ** 2
        length = np.sqrt(squared)
        if not length > 0:
            break
        for j in range(dim):
            direction[j] = product[j] / length
    return mean, direction


def in_order_of_use(rows: Float32s, labels: Integers) -> tuple[Float32s, Int64s]:
    """The distinct rows in use, in order of first use by the splats, and the row of each splat.

    Neighbours then have similar labels. If each splat has its own row, labels count up and cost next to nothing.

    Args:
        rows: ``[K, D]``.
        labels: Row of each splat ``[N]``.
    """
    used, labels = np.unique_inverse(labels)
    distinct, same = np.unique(rows[used], axis=0, return_inverse=True)
    labels = same.ravel()[labels]  # its shape differs between releases of NumPy
    _, first = np.unique(labels, return_index=True)
    order = first.argsort()
    return distinct[order], order.argsort()[labels]


def scalar_kmeans(values: Float32s, weight: Arrays | int = 1, count: int = 256) -> Float32s:
    """Levels ``[count]``, ascending, that nearly minimize the mean squared distance of values to their nearest level.

    If there are no more distinct values than levels, the levels are those values. Otherwise they start as the means of
    the cells of :func:`find_palette`; the steps of Lloyd (1982) then move each to the mean of its values until none
    moves. On random numbers this ends within a tenth of the
    optimum.

    Args:
        values: Any shape, at least one, finite.
        weight: How often each value counts, broadcasts with ``values``.
        count: Number of levels; the last one is repeated if fewer are enough.
    """
    distinct, inverse = np.unique_inverse(values)
    mass = np.bincount(inverse.ravel(), np.broadcast_to(weight, values.shape).ravel())
    numbers = distinct[mass > 0].astype(np.float64)
    mass = mass[mass > 0]
    if len(numbers) <= count:
        return np.pad(numbers, (0, count - len(numbers)), "edge").astype(np.float32)
    levels = np.sort(find_palette(numbers.astype(np.float32)[:, None], mass, count)[0][:, 0]).astype(np.float64)
    middle = float(np.average(numbers, weights=mass))  # sums of differences from it lose no digits
    sums = np.r_[0.0, (mass * (numbers - middle)).cumsum()]
    mass = np.r_[0.0, mass.cumsum()]
    for _ in range(500):  # each costs one search of 256 borders, whatever the number of values
        ends = [0, *np.searchsorted(numbers, _borders(levels)), len(numbers)]
        inside = np.diff(mass[ends])
        means = np.diff(sums[ends]) / np.where(inside > 0, inside, 1) + middle
        moved = np.where(inside > 0, means, levels)
        if np.array_equal(moved, levels):
            break
        levels = moved
    return levels.astype(np.float32)


def nearest_level(values: Float32s, levels: Float32s) -> Uint8s:
    """Index of the level nearest to each value; ``levels`` ascending, at most 256."""
    return np.searchsorted(_borders(levels.astype(np.float64)), values).astype(np.uint8)


def _borders(levels: Float64s) -> Float64s:
    return (levels[1:] + levels[:-1]) / 2
