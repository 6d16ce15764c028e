from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from nsvq_lightning.io.palette import find_palette, in_order_of_use, nearest_level, scalar_kmeans
from nsvq_lightning.quantize.kmeans import kmeans
from nsvq_lightning.quantize.nearest import nearest_reference


def clouds(n: int, centers: int, dim: int, spread: float) -> NDArray[np.float32]:
    rng = np.random.default_rng([n, centers, dim])
    middles = rng.normal(size=(centers, dim))
    return (middles[rng.integers(centers, size=n)] + spread * rng.normal(size=(n, dim))).astype(np.float32)


def error(rows: NDArray[np.float32], palette: NDArray[np.float32], labels: NDArray[np.int64]) -> float:
    return float(np.square(rows.astype(np.float64) - palette[labels]).sum(1).mean())


@pytest.mark.parametrize("count", [40, 300])
def test_a_palette_is_about_as_good_as_that_of_kmeans(count: int) -> None:
    """Oracle: k-means with the exact nearest row."""
    rows = clouds(2000, 40, 6, 0.2)
    palette, labels = find_palette(rows, np.ones(2000), count)
    assert palette.shape == (count, 6)
    centroids = kmeans(torch.from_numpy(rows), count, torch.Generator().manual_seed(0))
    codes = nearest_reference(torch.from_numpy(rows), centroids)
    assert error(rows, palette, labels) < 1.15 * error(rows, centroids.numpy(), codes.numpy())


def test_rows_of_a_palette_are_weighted_means() -> None:
    """Oracle: the mean by its definition; and what weighs more is met more closely."""
    rows, rng = clouds(500, 5, 3, 0.5), np.random.default_rng(1)
    weight = np.where(rng.random(500) < 0.2, 50.0, 1.0)
    palette, labels = find_palette(rows, weight, 20)
    for number, row in enumerate(palette):
        mine = labels == number
        np.testing.assert_allclose(row, np.average(rows[mine].astype(np.float64), axis=0, weights=weight[mine]), 1e-5)
    plain, others = find_palette(rows, np.ones(500), 20)
    heavy = weight > 1
    assert error(rows[heavy], palette, labels[heavy]) < 0.8 * error(rows[heavy], plain, others[heavy])


@pytest.mark.parametrize("count", [7, 8, 4000])
def test_few_distinct_rows_are_kept_bit_for_bit(count: int) -> None:
    rng = np.random.default_rng(2)
    distinct = rng.normal(size=(7, 45)).astype(np.float32)
    rows = distinct[rng.integers(7, size=900)]
    palette, labels = find_palette(rows, rng.random(900) + 0.01, count)
    assert len(palette) == 7
    np.testing.assert_array_equal(palette[labels], rows)


def test_one_row_and_one_cell() -> None:
    rows = np.array([[1, 2], [3, 5]], np.float32)
    np.testing.assert_array_equal(find_palette(rows[:1], np.ones(1), 9)[0], rows[:1])
    palette, labels = find_palette(rows, np.array([3, 1]), 1)
    np.testing.assert_array_equal(palette, [[1.5, 2.75]])
    assert labels.tolist() == [0, 0]


def test_the_order_of_use_does_not_depend_on_the_codebook() -> None:
    rows = np.array([[5, 0], [1, 1], [5, 0], [2, 2]], np.float32)
    palette, labels = in_order_of_use(rows, np.array([3, 0, 2, 3, 0]))
    np.testing.assert_array_equal(palette, [[2, 2], [5, 0]])
    assert labels.tolist() == [0, 1, 1, 0, 1]
    again, same = in_order_of_use(rows[[3, 1, 0]], np.array([0, 2, 2, 0, 2]))
    np.testing.assert_array_equal(again, palette)
    np.testing.assert_array_equal(same, labels)


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
