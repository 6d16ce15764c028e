"""Positions on a grid, against plain arithmetic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from viewer_scenes import plain_scene

from nsvq_lightning.io import CompressedScene, read_scene, save
from nsvq_lightning.io.morton import AXIS_BITS, Grid, morton_keys, spatial_order, unmorton
from nsvq_lightning.io.nsvq.compact import nearest_before


def test_keys_interleave_the_bits() -> None:
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 1 << AXIS_BITS, (50, 3))
    keys = morton_keys(cells, np.full(50, AXIS_BITS))
    for cell, key in zip(cells, keys, strict=True):
        digits = "".join(f"{int(x):021b}"[bit] for bit in range(21) for x in cell)
        assert int(key) == int(digits, 2)
    np.testing.assert_array_equal(unmorton(keys), cells)


def test_lower_bits_of_a_shallow_cell_are_zero() -> None:
    cells = np.random.default_rng(1).integers(0, 1 << AXIS_BITS, (22, 3))
    depths = np.arange(22)
    back = unmorton(morton_keys(cells, depths))
    np.testing.assert_array_equal(back, cells >> (21 - depths)[:, None] << (21 - depths)[:, None])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_positions_come_back_within_half_a_cell(scale: float) -> None:
    rng = np.random.default_rng(2)
    means = (scale * (rng.standard_normal((4000, 3)) + np.array([5.0, 0.0, -3.0]))).astype(np.float32)
    widest = scale * np.exp(rng.normal(-5, 1.5, 4000))
    grid = Grid.around(means, widest)
    depths = grid.depths(np.log2(widest / grid.step))
    cells, inside = grid.cells(means)
    assert inside.all()
    # The thousandth with the smallest splats shares the cells of the others.
    allowed = np.maximum(widest, grid.step)[:, None] / 2 + 1e-6 * np.abs(means)
    assert (np.abs(grid.centers(cells, depths) - means) <= allowed).all()
    assert (widest < grid.step).mean() <= 0.0011


def test_far_splats_do_not_make_the_grid_coarse() -> None:
    rng = np.random.default_rng(3)
    means = rng.standard_normal((5000, 3)).astype(np.float32)
    near = Grid.around(means, np.full(5000, 1e-3))
    means[7], means[8, 1] = 1e9, -1e7
    grid = Grid.around(means, np.full(5000, 1e-3))
    _, inside = grid.cells(means)
    assert np.flatnonzero(~inside).tolist() == [7, 8]
    assert grid.step == near.step == 2.0**-10


@pytest.mark.parametrize(("share", "most"), [(0.002, 0.002), (0.04, 0.04), (0.4, 0.4)])
def test_many_very_far_splats_do_not_make_the_grid_coarse_either(share: float, most: float) -> None:
    means = np.random.default_rng(4).standard_normal((5000, 3)).astype(np.float32)
    means[: int(share * 5000)] *= 1e7
    means[-1] = 3e38
    widest = np.full(5000, 1e-3)
    grid = Grid.around(means, widest)
    assert grid.step <= 1e-3
    assert 1 - grid.cells(means)[1].mean() <= most + 0.001


def test_fine_splats_decide_also_where_most_are_coarse() -> None:
    rng = np.random.default_rng(5)
    means = rng.standard_normal((5000, 3)).astype(np.float32)
    means[2000:4750] *= 50
    means[4750:] *= 300
    widest = np.where(np.arange(5000) < 2000, 2e-4, 5e-3)
    assert Grid.around(means, widest).step <= 2e-4


def test_splats_in_spatial_order_are_near_the_one_before() -> None:
    """In a scene with two fifths of the splats far around it, and with some that are lost."""
    means = np.random.default_rng(5).standard_normal((4000, 3)).astype(np.float32)
    means[:1600] *= 20 / np.linalg.norm(means[:1600], axis=1, keepdims=True)
    lost = means.copy()
    lost[:3] = 1e6
    for each in (means, lost):
        order = spatial_order(each)
        assert sorted(order) == list(range(4000))
        steps = np.linalg.norm(np.diff(each[order], axis=0), axis=1)
        assert np.quantile(steps, 0.95) < 10  # in random order 39


def test_what_is_near_before_a_far_background_keeps_its_positions(tmp_path: Path) -> None:
    """A thing in front of a landscape that has nine tenths of the splats and is 1000 times as large."""
    scene = plain_scene(4000, 0)
    alone = _errors(scene.in_order(np.arange(400)), tmp_path / "a.compressed.ply")
    scene.means[400:] *= 1000 / np.linalg.norm(scene.means[400:], axis=1, keepdims=True)
    assert _errors(scene, tmp_path / "b.compressed.ply")[:256].max() < 3 * alone.max()


def test_lost_splats_are_the_last(tmp_path: Path) -> None:
    """So they stretch no bounds of others: chunks of 256 in a compressed .ply."""
    scene = plain_scene(4000, 0)
    near = _errors(scene, tmp_path / "a.compressed.ply")
    scene.means[::100] *= 1e5
    far = _errors(scene, tmp_path / "b.compressed.ply")
    assert {*spatial_order(scene.means)[-40:] % 100} == {0}
    assert far[: 4000 // 256 * 256 - 256].max() < 3 * near.max()


def _errors(scene: CompressedScene, path: Path) -> NDArray[np.float32]:
    """How far splats are from where they were, in the order of the file."""
    save(scene, path)
    return np.linalg.norm(read_scene(path).means - scene.in_morton_order().means, axis=1)


@pytest.mark.parametrize("count", [0, 1, 2, 400])
def test_neighbours_are_the_two_nearest_of_the_rows_before(count: int) -> None:
    cells = np.random.default_rng(count).integers(0, 60, (count, 3))
    found = nearest_before(cells)
    for i in range(count):
        rows = range(max(0, i - 16), i)
        expected = sorted(rows, key=lambda j: (int(((cells[i] - cells[j]) ** 2).sum()), j))[:2]
        assert found[i].tolist() == [*expected, -1, -1][:2]


@pytest.mark.parametrize("means", [np.zeros((0, 3)), np.zeros((5, 3)), np.full((1, 3), 1e30)])
def test_degenerate_scenes_have_a_grid(means: np.ndarray) -> None:
    means = means.astype(np.float32)
    grid = Grid.around(means, np.full(len(means), 1e-12))
    cells, inside = grid.cells(means)
    assert inside.all()
    back = grid.centers(cells, np.full(len(means), AXIS_BITS))
    np.testing.assert_allclose(back, means, rtol=1e-5, atol=1e-9)
    assert grid.cells(np.asfortranarray(means))[0].flags.c_contiguous
