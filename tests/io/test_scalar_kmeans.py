from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nsvq_lightning.io.scalar_kmeans import nearest_level, scalar_kmeans


def mean_square(values: NDArray[np.float32], levels: NDArray[np.float32]) -> float:
    """Oracle: all distances."""
    return float(np.mean(np.abs(values.astype(np.float64)[:, None] - levels[None]).min(1) ** 2))


def least_mean_square(values: NDArray[np.float32], count: int) -> float:
    """Oracle: the optimum, by dynamic programming over every partition of the sorted values into runs."""
    x = np.sort(values.astype(np.float64))
    sums, squares = (np.concatenate([[0.0], np.cumsum(x**power)]) for power in (1, 2))
    i, j = np.meshgrid(np.arange(len(x) + 1), np.arange(len(x) + 1), indexing="ij")
    cost = squares[j] - squares[i] - (sums[j] - sums[i]) ** 2 / np.maximum(j - i, 1)
    cost[j < i] = np.inf
    best = cost[0]
    for _ in range(count - 1):
        best = (best[:, None] + cost).min(0)
    return float(best[-1] / len(x))


@pytest.mark.parametrize("kind", ["normal", "laplace", "uniform", "lognormal"])
def test_levels_are_nearly_the_best_and_better_than_equal_steps(kind: str) -> None:
    values = getattr(np.random.default_rng(1), kind)(size=300).astype(np.float32)
    found = mean_square(values, scalar_kmeans(values, count=32))
    assert found < 1.15 * least_mean_square(values, 32)
    assert found < mean_square(values, np.linspace(values.min(), values.max(), 32, dtype=np.float32))


def test_few_values_are_exact_and_the_last_level_is_repeated() -> None:
    values = np.array([[3, -1], [3, 0.5], [np.pi, -1]], np.float32)
    levels = scalar_kmeans(values, count=8)
    np.testing.assert_array_equal(levels, np.array([-1, 0.5, 3, *[np.pi] * 5], np.float32))
    np.testing.assert_array_equal(levels[nearest_level(values, levels)], values)


def test_a_weight_counts_like_repeated_values() -> None:
    rng = np.random.default_rng(2)
    values, weight = rng.normal(size=(500, 3)).astype(np.float32), rng.integers(0, 5, (500, 1))
    weighted = scalar_kmeans(values, weight, 64)
    repeated = scalar_kmeans(np.repeat(values, weight[:, 0], axis=0), count=64)
    np.testing.assert_allclose(weighted, repeated, rtol=1e-5, atol=1e-6)


def test_numbers_of_levels_are_those_of_the_nearest() -> None:
    rng = np.random.default_rng(3)
    values, levels = rng.normal(size=400).astype(np.float32), np.sort(rng.normal(size=256)).astype(np.float32)
    distances = np.abs(values[:, None] - levels[None])
    found = nearest_level(values, levels)
    np.testing.assert_array_equal(distances[np.arange(400), found], distances.min(1))
