"""The order of a codebook's rows."""

from __future__ import annotations

import numpy as np
import pytest

from nsvq_lightning.io.nsvq.rounding import leaf_paths, sibling_distance, tree_order


@pytest.mark.parametrize("count", [1, 2, 3, 7, 64, 1000])
def test_paths_are_those_of_halving(count: int) -> None:
    bits = (count - 1).bit_length()

    def leaves(low: int, high: int, path: int, left: int) -> list[int]:
        if high - low == 1:
            return [path << left]
        cut = low + (high - low + 1) // 2
        return leaves(low, cut, 2 * path, left - 1) + leaves(cut, high, 2 * path + 1, left - 1)

    assert leaf_paths(count).tolist() == leaves(0, count, 0, bits)


@pytest.mark.parametrize(("count", "dim"), [(1, 3), (2, 1), (257, 3), (300, 45), (4096, 4)])
def test_order_is_a_permutation_that_brings_like_rows_together(count: int, dim: int) -> None:
    codebook = np.random.default_rng(dim).standard_normal((count, dim), np.float32)
    order = tree_order(codebook)
    np.testing.assert_array_equal(np.sort(order), np.arange(count))
    if count > 256:
        assert sibling_distance(codebook[order]) < 0.9 * sibling_distance(codebook)


def test_the_first_cut_is_across_the_longest_axis() -> None:
    rng = np.random.default_rng(0)
    direction = np.array([3.0, -4.0, 12.0]) / 13
    along = rng.standard_normal(500)
    rows = (np.outer(10 * along, direction) + rng.standard_normal((500, 3))).astype(np.float32)
    side = np.zeros(500)
    side[tree_order(rows)[250:]] = 1
    agreement = np.mean(side == (along > np.median(along)))
    assert max(agreement, 1 - agreement) > 0.93


def test_equal_rows_are_no_trouble() -> None:
    rows = np.ones((50, 4), np.float32)
    np.testing.assert_array_equal(np.sort(tree_order(rows)), np.arange(50))
    assert sibling_distance(rows) == sibling_distance(rows[:1]) == 0.0
