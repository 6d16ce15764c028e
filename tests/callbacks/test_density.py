"""Density control: decisions against the rules written out; statistics, edits, guard, cap, resets on five splats."""

from __future__ import annotations

import logging
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from density_stage import EXTENT, Stage, make_splats
from scipy.spatial.transform import Rotation

from nsvq_lightning.callbacks import DensityControl, PhaseSchedule
from nsvq_lightning.callbacks.density import add_view, split
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.row_ops import append_rows, keep_rows
from nsvq_lightning.training.schedule import Phase, Schedule


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_only_splats_that_were_seen_enter_the_statistic_in_device_coordinates(dtype: torch.dtype) -> None:
    draw = torch.Generator().manual_seed(0)
    grad, start = torch.randn(57, 2, generator=draw).to(dtype), torch.rand(57, generator=draw).to(dtype)
    radii = torch.randint(0, 3, (57,), generator=draw, dtype=torch.int32)
    sums, views = start.clone(), torch.full((57,), 2.0, dtype=dtype)
    add_view((sums, views), grad, radii, width=80, height=60)
    seen = radii > 0
    # A shift of one pixel is a shift of 2 / width; the gradient by it is width / 2 times larger.
    torch.testing.assert_close(sums, torch.where(seen, start + torch.hypot(grad[:, 0] * 40, grad[:, 1] * 30), start))
    assert torch.equal(views, torch.where(seen, 3.0, 2.0).to(dtype))


def test_children_follow_the_parents_own_gaussian() -> None:
    count = 4000
    quat = torch.tensor([0.9, 0.1, -0.3, 0.2])
    scales = torch.tensor([0.0, -1.0, -2.0])
    parents = RawSplats(
        means=torch.tensor([1.0, -2.0, 3.0]).repeat(count, 1),
        quats=2.5 * quat.repeat(count, 1),  # any norm
        scales=scales.repeat(count, 1),
        opacities=torch.linspace(-1, 1, count),
        sh0=torch.rand(count, 1, 3),
        shN=torch.rand(count, 15, 3),
    )
    children = split(parents, 1.6, generator(0, 0, "split"))
    assert children.means.shape == (2 * count, 3)
    rotation = Rotation.from_quat(quat[[1, 2, 3, 0]].numpy()).as_matrix()
    covariance = rotation @ np.diag(np.exp(2 * scales.numpy())) @ rotation.T
    offsets = (children.means - parents.means[0]).numpy()
    np.testing.assert_allclose(np.cov(offsets.T), covariance, atol=0.06)
    np.testing.assert_allclose(offsets.mean(0), 0.0, atol=0.05)
    torch.testing.assert_close(children.scales.exp(), parents.scales.exp().repeat(2, 1) / 1.6)
    assert torch.equal(children.opacities, parents.opacities.repeat(2))
    assert torch.equal(children.shN, parents.shN.repeat(2, 1, 1))


SMALL, LARGE = 0.01, 0.05  # below and above 0.01 · extent


def view(gradients: list[float], seen: list[bool], width: int = 40, height: int = 20) -> Render:
    """A render whose screen-space gradients (in normalised coordinates, along x) are given."""
    n = len(gradients)
    means2d = torch.zeros(n, 2, requires_grad=True)
    means2d.grad = torch.tensor([[g / (0.5 * width), 0.0] for g in gradients])
    image = torch.zeros(height, width, 3)
    return Render(image, image[..., 0], torch.tensor(seen).int(), means2d, image[..., 0])


def stage_of(
    sizes: list[float], opacities: list[float], control: DensityControl, background: str = "black", micro: int = 1
) -> Stage:
    """A run of the paper's length."""
    scales = torch.tensor(sizes).log()[:, None].repeat(1, 3)
    return Stage(make_splats(opacities, scales), control, Schedule(), micro, background)


def swap_first(stage: Stage) -> None:
    """Remove the first splat and add one at the end."""
    splats, optimizer = stage.module.splats, stage.trainer.optimizers[0]
    keep_rows(splats, optimizer, torch.arange(len(splats)) > 0)
    append_rows(splats, optimizer, RawSplats(*(value.detach()[:1] for value in splats.raw())))


@pytest.mark.parametrize("edit", ["removed", "added", "swapped"])
def test_a_view_of_splats_that_changed_since_is_left_out_with_one_warning(
    edit: str, caplog: pytest.LogCaptureFixture
) -> None:
    stage = stage_of([SMALL] * 3, [0.5] * 3, DensityControl())
    stage.step(1, view([4e-4, 1e-4, 2e-4], [True] * 3), edits=0)
    rendered = {"removed": 4, "added": 2, "swapped": 3}[edit]
    if edit == "swapped":
        swap_first(stage)
    with caplog.at_level(logging.WARNING):
        for iteration in (2, 3):
            stage.step(iteration, view([9e-4] * rendered, [True] * rendered), edits=0)
    tables = stage.module.splats.tables()
    sums = [1e-4, 2e-4, 0.0] if edit == "swapped" else [4e-4, 1e-4, 2e-4]  # rows take theirs along
    assert tables["gradient_sum"].tolist() == pytest.approx(sums)
    assert tables["view_count"].tolist() == [float(value > 0) for value in sums]
    assert [record.message.partition(":")[0] for record in caplog.records] == ["iteration 2"]
    assert f"({rendered} were rendered, now 3)" in caplog.text
    assert "List that callback after DensityControl" in caplog.text
    stage.step(4, view([1e-4] * 3, [True] * 3), edits=stage.module.splats.edits)
    assert tables["gradient_sum"].tolist() == pytest.approx([value + 1e-4 for value in sums])


def test_clone_split_and_prune_at_the_scheduled_iteration() -> None:
    stage = stage_of([SMALL, LARGE, SMALL, SMALL], [0.5, 0.5, 0.004, 0.5], DensityControl(min_splats=1))
    stage.step(599, view([3e-4, 3e-4, 0.0, 1e-4], [True] * 4))
    assert stage.count == 4
    stage.step(600, view([3e-4, 3e-4, 0.0, 1e-4], [True] * 4))
    # 0 is there twice, 1 became two children, 2 was transparent, 3 stays.
    means = stage.module.splats.means.detach()
    assert stage.count == 5
    assert means[:3].tolist() == [[0, 1, 2], [9, 10, 11], [0, 1, 2]]
    assert stage.module.splats.scales.exp()[3:].tolist() == [[pytest.approx(LARGE / 1.6)] * 3] * 2
    assert (means[3:] - torch.tensor([3.0, 4.0, 5.0])).abs().max() < 6 * LARGE
    assert not any(table.any() for table in stage.module.splats.tables().values())  # the statistics start anew


def test_gradient_accumulation_neither_repeats_an_edit_nor_weakens_the_statistic() -> None:
    stage = stage_of([SMALL] * 2, [0.5] * 2, DensityControl(min_splats=1), micro=2)
    # Each micro-batch sees half of the gradient, as Lightning divides the loss.
    stage.step(600, view([1.1e-4, 0.0], [True, True]))
    assert stage.count == 3
    stage.step(600, view([1.1e-4, 0.0, 1.1e-4], [True] * 3))
    assert stage.count == 3


@pytest.mark.parametrize("total", [900, 4500])
def test_a_run_of_another_length_prunes_in_its_prune_phase_too(total: int) -> None:
    module: Any = SimpleNamespace(schedule=PhaseSchedule().schedule(total))
    start, end = (module.schedule.ends[phase] for phase in (Phase.WARMUP, Phase.PRUNE))
    due = [iteration for iteration in range(start + 1, total + 1) if DensityControl().is_due(module, iteration)]
    assert len(due) == 2
    assert max(due) < end


def test_huge_splats_go_only_after_iteration_3000() -> None:
    for iteration, left in ((2900, 2), (3000, 2), (3100, 1)):
        stage = stage_of([0.1 * EXTENT + 0.01, SMALL], [0.5, 0.5], DensityControl(min_splats=1))
        stage.step(iteration, view([0.0, 0.0], [True, True]))
        assert stage.count == left


def test_opacities_are_reset_with_their_moments() -> None:
    stage = stage_of([SMALL] * 3, [0.9, 0.5, 0.008], DensityControl(min_splats=1))
    optimizer = stage.trainer.optimizers[0]
    stage.module.splats.opacities.sum().backward()
    optimizer.step()
    stage.step(3000, view([0.0] * 3, [True] * 3))
    opacities = stage.module.splats.opacities
    assert opacities.sigmoid().tolist() == pytest.approx([0.01, 0.01, 0.008], rel=0.1)
    assert not optimizer.state[opacities]["exp_avg"].any()
    assert float(optimizer.state[opacities]["step"]) == 1.0


def test_a_white_background_is_reset_once_more() -> None:
    for background, opacity in (("white", 0.01), ("black", 0.9)):
        stage = stage_of([SMALL] * 12, [0.9] * 12, DensityControl(), background)
        stage.step(500, view([0.0] * 12, [True] * 12))
        assert float(stage.module.splats.opacities[0].detach().sigmoid()) == pytest.approx(opacity, rel=1e-4)


def test_pruning_everything_is_skipped_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    stage = stage_of([SMALL] * 12, [0.001] * 12, DensityControl())
    with caplog.at_level(logging.WARNING):
        stage.step(16_000, view([0.0] * 12, [True] * 12))
    assert stage.count == 12
    assert "pruning 12 of 12 splats would leave fewer than min_splats=10" in caplog.text


def test_growth_stops_at_the_cap() -> None:
    control = DensityControl(min_splats=1, max_splats=5)
    stage = stage_of([SMALL, SMALL, LARGE, LARGE], [0.5] * 4, control)
    stage.step(600, view([3e-4, 4e-4, 5e-4, 9e-4], [True] * 4))
    assert stage.count == 5
    # The one with the largest statistic, the last, was split.
    assert stage.module.splats.means.detach()[:3].tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


def test_growth_stops_at_the_budget_that_was_asked_for() -> None:
    stage = stage_of([SMALL, SMALL, LARGE, LARGE], [0.5] * 4, DensityControl(min_splats=1))
    stage.module.splat_budget = 5
    stage.step(600, view([3e-4, 4e-4, 5e-4, 9e-4], [True] * 4))
    assert stage.count == 5


@pytest.mark.parametrize("cap", [4, 5, 6, 7, 9])
def test_growth_fills_the_cap_with_clones_and_splits(cap: int) -> None:
    stage = stage_of([SMALL, LARGE, LARGE, SMALL], [0.5] * 4, DensityControl(min_splats=1, max_splats=cap))
    stage.step(600, view([3e-4, 4e-4, 5e-4, 9e-4], [True] * 4))
    assert stage.count == min(cap, 8)


def test_a_non_finite_splat_is_dropped_as_soon_as_the_loss_shows_it(caplog: pytest.LogCaptureFixture) -> None:
    stage = stage_of([SMALL] * 3, [0.5] * 3, DensityControl())
    with torch.no_grad():
        stage.module.splats.quats[1] = math.nan
    stage.step(7, None)  # the step was skipped: no outputs
    assert stage.count == 2
    assert "step 7: dropped 1 of 3 splats with non-finite values: quats in 1 rows" in caplog.text


def test_frozen_codes_go_with_the_splats_that_are_dropped_in_fine_tuning() -> None:
    stage = stage_of([SMALL] * 4, [0.5] * 4, DensityControl())
    frozen, free = NSVQ(3, 3), NSVQ(3, 3)
    frozen.freeze(torch.tensor([2, 0, 1, 2]))
    stage.module.quantizers = {"scales": frozen, "sh0": free}
    with torch.no_grad():
        stage.module.splats.sh0[1] = math.inf
    stage.step(44_000, view([0.0] * 4, [True] * 4))
    assert stage.module.splats.means.detach().tolist() == [[0, 1, 2], [6, 7, 8], [9, 10, 11]]
    assert frozen.codes.tolist() == [2, 1, 2]
    assert not free.frozen
