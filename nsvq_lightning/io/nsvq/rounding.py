"""A scene as the integers that level ``compact`` rounds it to before anything is coded.

Steps of positions and of codebooks are powers of two. So rounding is idempotent: a scene read from a file is written
again without another error.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from nsvq_lightning.compute.jit import kernel
from nsvq_lightning.io.compressed import CompressedScene, slices
from nsvq_lightning.io.morton import Grid
from nsvq_lightning.io.nsvq.header import AttributeEntry
from nsvq_lightning.io.nsvq.precision import Precision
from nsvq_lightning.io.numbers import coarsest_power, opacity_of, power_above
from nsvq_lightning.io.palette import mean_and_direction
from nsvq_lightning.splats.conventions import Float32s, Float64s, Int64s, Integers, unit

# Coefficients and integers of a basis are below it in size: float32 has them, and 45 products add up to less than 2^52.
SMALL = 1 << 23


class Stored(NamedTuple):
    """One attribute as integers.

    Attributes:
        entry: Its line in the header.
        values: Codes ``[N]`` (row of the codebook, or level), integers ``[N, D]`` or coefficients ``[N, C]``.
        codebook: Integers of the codebook ``[K, D]`` or of the basis ``[C, D]``; None if there is none.
    """

    entry: AttributeEntry
    values: Integers
    codebook: Integers | None = None

    def floats(self) -> Float32s:
        """The codebook ``[K, D]`` or the basis ``[C, D]``, or the rows ``[N, D]`` where there is none."""
        integers = self.values if self.codebook is None else self.codebook
        # In place of a float64 copy, which would take twice the memory of the result.
        return np.multiply(integers, self.entry.step, out=np.empty(integers.shape, np.float32), casting="same_kind")


def rounded(scene: CompressedScene, name: str, precision: Precision) -> Stored:
    """An attribute, but not the positions, as integers.

    Args:
        scene: The scene.
        name: The attribute.
        precision: The largest errors.

    Raises:
        ValueError: A value is too large for its step.
    """
    if name == "opacities":
        count = math.ceil(0.5 / precision.opacity)  # levels, at least 2
        values = np.minimum((opacity_of(scene.opacities) * count).astype(np.int64), count - 1)
        return Stored(AttributeEntry("opacities", 1, "levels", count), values)
    if name in scene.bases:
        basis = scene.bases[name]
        step = min(1.0, _step(basis, float(np.abs(basis).max()) * 2.0**-13 or 1.0))
        entry = AttributeEntry(name, basis.shape[1], "components", len(basis), step)
        return Stored(entry, _integers(name, scene.raw[name], 1.0, SMALL), _integers(name, basis, step, SMALL))
    if name in scene.raw:
        rows = scene.raw[name]
        step = 2 * precision.of(name)
        return Stored(AttributeEntry(name, rows.shape[1], "steps", step=step), _integers(name, rows, step))
    return _coded(name, scene.codes[name], scene.codebooks[name], precision.codebook)


def _coded(name: str, codes: Integers, codebook: Float32s, error: float) -> Stored:
    used = np.bincount(codes, minlength=len(codebook)) > 0
    rows = codebook[used] if len(codes) else np.zeros_like(codebook[:1])
    distinct = np.unique(unit(rows).astype(np.float32) if name == "quats" else rows, axis=0)
    step = _step(rows, 2 * error * sibling_distance(distinct[tree_order(distinct)]) or 2.0**-16)
    integers, merged = np.unique(_integers(name, rows, step), axis=0, return_inverse=True)
    merged_codes = merged.ravel()[np.cumsum(used)[codes] - 1]
    order = tree_order((integers * step).astype(np.float32))
    entry = AttributeEntry(name, rows.shape[1], "codes", len(integers), step)
    return Stored(entry, order.argsort()[merged_codes], integers[order])


def _step(rows: Float32s, wanted: float) -> float:
    """The power of two near ``wanted``, or the lattice which all values lie on already if it is not far finer."""
    power = power_above(wanted / math.sqrt(2.0))  # from √½ to √2 times as much
    lattice = coarsest_power(rows)
    return lattice if 4 * lattice >= power else power


def _integers(name: str, rows: Float32s, step: float, limit: float = 2.0**52) -> Integers:
    """The rows ``[N, D]`` as multiples of a step; quaternions are normalised first, unless they are multiples of it."""
    largest = max(float(rows.max(initial=0)), -float(rows.min(initial=0)))
    if name == "quats" and not np.array_equal(
        (np.rint(rows.astype(np.float64) / step) * step).astype(np.float32), rows
    ):
        rows, largest = unit(rows).astype(np.float32), 1.0
    if not largest / step < limit:
        raise ValueError(f"{name}: {largest:.3g} is too large for steps of {step:.3g}; use level 'paper'")
    # Of attributes without a codebook, there are many.
    integers = np.empty(rows.shape, np.int32 if largest / step < SMALL else np.int64)
    for part in slices(len(rows)):
        integers[part] = np.rint(rows[part].astype(np.float64) / step)
    return integers


# Positions


def position_grid(means: Float32s, stored: Mapping[str, Stored], precision: Precision) -> tuple[Grid, float, Int64s]:
    """The grid of the positions ``[N, 3]``, the doublings of its step for a splat of size 1, and the depths ``[N]``.

    Args:
        means: The positions.
        stored: The log-scales and the opacities of their splats.
        precision: The largest errors.
    """
    widest = np.minimum(doublings_of(stored, math.log2(2 * precision.position)), 500.0)  # float64 holds the multiples
    grid = Grid.around(means, np.exp2(widest))
    for_size_one = math.log2(2 * precision.position / grid.step)
    return grid, for_size_one, grid.depths(doublings_of(stored, for_size_one))


def doublings_of(stored: Mapping[str, Stored], for_size_one: float) -> Float64s:
    """Base-2 logarithm ``[N]`` of the width of each splat's widest cell, in steps of the grid.

    The width is in proportion to the size over the square root of the opacity: what is hardly seen may move further.
    Only sums, products and quotients are used, whose rounding is the same everywhere: key depths depend on it.

    Args:
        stored: The log-scales and the opacities.
        for_size_one: The result for an opaque splat of size 1.
    """
    scales, levels = stored["scales"], stored["opacities"]
    factor = scales.entry.step / 3 / math.log(2.0)
    sums = scales.values.sum(1) if scales.codebook is None else scales.codebook.sum(1)[scales.values]
    doublings: Float64s = sums.astype(np.float64) * factor + for_size_one
    # The logarithm, linear between powers of two.
    mantissas, exponents = np.frexp((np.arange(levels.entry.codes) + 0.5) / levels.entry.codes)
    doublings -= (0.5 * (2 * mantissas - 2 + exponents))[levels.values]
    return doublings


def tree_order(codebook: Float32s) -> Int64s:
    """Indices ``[K]`` of the rows of ``codebook [K, D]`` in the order of the leaves of a tree.

    The rows are cut into two halves across the direction in which they differ most, each half again, and so on; for an
    odd number of rows, the first half gets one more.
    """
    order = np.arange(len(codebook))
    _cut(codebook.astype(np.float64), order)
    return order


def leaf_paths(count: int) -> Int64s:
    """Path ``[count]`` of each leaf, ascending: the halves taken from the root, ⌈log2 count⌉ bits, 0 after the leaf."""
    # How many leaves are below each node of a level, 0 where none is.
    leaves = np.array([count])
    for _ in range((count - 1).bit_length()):
        leaves = np.stack([(leaves + 1) // 2, leaves // 2], axis=1).ravel()
    return leaves.nonzero()[0]


def sibling_distance(ordered: Float32s) -> float:
    """How much two neighbours of an ordered codebook typically differ per column; 0 for a single row.

    It is the median over the pairs of the root mean square over the columns: how far apart codes are where they are
    dense, and so how exactly they must be stored.
    """
    differences = np.diff(ordered.astype(np.float64), axis=0)[::2]
    return float(np.median(np.sqrt((differences**2).mean(1)))) if differences.size else 0.0


# Power-iteration steps for the direction of a cut. It need not be exact: 12 would save another 0.02 % of a file.
_ITERATIONS = 4


@kernel
def _cut(rows, order):  # type: ignore[no-untyped-def]
    count = len(order)
    if count < 2:
        return
    _, direction = mean_and_direction(rows, None, order, _ITERATIONS)
    projections = np.zeros(count)
    for i in range(count):
        for j in range(rows.shape[1]):
            projections[i] += rows[order[i], j] * direction[j]
    order[:] = order[np.argsort(projections, kind="mergesort")]
    middle = (count + 1) // 2
    _cut(rows, order[:middle])
    _cut(rows, order[middle:])
