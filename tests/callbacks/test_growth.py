"""Budgeted growth on a host of a few splats: statistics, budget, edits, resets."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nsvq_lightning.callbacks import BudgetedGrowth, GrowthRules
from nsvq_lightning.data.scene import View
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.schedule import Phase, Schedule

WIDTH, HEIGHT = 40, 20
RULES = GrowthRules(
    start=0, full=100, every=10, first_prune=5, reset_every=40, reset_last=80, recovery=7, recoveries=1, min_splats=2
)
SCHEDULE = Schedule(
    total=200,
    reference_total=200,
    warmup_end=120,
    prune_end=150,
    quantize_end=180,
    min_density_interval=1,
    min_reset_interval=1,
)


def make_splats(opacities: list[float]) -> Splats:
    n = len(opacities)
    return Splats.from_tensors(
        means=torch.arange(3.0 * n).view(n, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        scales=torch.tensor([0.0, -1.0, -2.0]).repeat(n, 1),
        opacities=torch.tensor(opacities).logit(),
        sh0=torch.zeros(n, 1, 3),
        shN=torch.zeros(n, 0, 3),
    )


def view(gradients: list[float], edges: list[float], seen: list[bool]) -> Render:
    """A render whose absolute screen gradients (in device coordinates, along x) and edge weights are given."""
    observed = torch.zeros(len(gradients), 3, requires_grad=True)
    columns = zip(gradients, edges, strict=True)
    observed.grad = torch.tensor([[gradient / (0.5 * WIDTH), 0.0, edge] for gradient, edge in columns])
    image = torch.zeros(HEIGHT, WIDTH, 3)
    means2d = torch.zeros(len(gradients), 2)
    return Render(image, image[..., 0], torch.tensor(seen).int(), means2d, image[..., 0], observed)


class Stage:
    """Host and trainer in a run of 200 iterations."""

    def __init__(self, opacities: list[float], growth: BudgetedGrowth, micro: int = 1) -> None:
        self.growth = growth
        splats = make_splats(opacities)
        self.host: Any = SimpleNamespace(
            splats=splats,
            quantizers={},
            schedule=SCHEDULE,
            phase=Phase.WARMUP,
            seed=0,
            pixel_map=torch.zeros(HEIGHT, WIDTH),
            splat_budget=None,
        )
        self.trainer: Any = SimpleNamespace(
            optimizers=[build_adam(param_groups(splats, {}, LearningRates(), 1.0))],
            global_step=0,
            world_size=1,
            accumulate_grad_batches=micro,
        )

    def end_batch(self, iteration: int, render: Render | None = None) -> None:
        self.trainer.global_step = iteration
        for parameter in self.host.splats.parameters():
            parameter.grad = torch.zeros_like(parameter)
        self.growth.on_train_batch_end(self.trainer, self.host, {"render": render} if render else {}, None, 0)

    @property
    def count(self) -> int:
        return len(self.host.splats)

    @property
    def opacities(self) -> list[float]:
        return self.host.splats.opacities.sigmoid().tolist()  # type: ignore[no-any-return]


def test_views_add_gradients_counts_and_edges_of_mean_one() -> None:
    stage = Stage([0.5] * 3, BudgetedGrowth(RULES, budget=100))
    stage.end_batch(1, view([4e-4, 1e-4, 0.0], [1.0, 3.0, 0.0], [True, True, False]))
    stage.end_batch(2, view([2e-4, 0.0, 0.0], [5.0, 0.0, 0.0], [True, False, False]))
    tables = stage.host.splats.tables()
    assert tables["gradient_sum"].tolist() == pytest.approx([6e-4, 1e-4, 0.0])
    assert tables["view_count"].tolist() == [2.0, 1.0, 0.0]
    assert tables["edge_sum"].tolist() == pytest.approx([0.5 + 1.0, 1.5, 0.0])


def test_accumulated_views_count_like_single_ones() -> None:
    stage = Stage([0.5] * 2, BudgetedGrowth(RULES, budget=100), micro=4)
    stage.end_batch(1, view([1e-4, 2e-4], [1.0, 1.0], [True, True]))  # a quarter of the gradient of a single view
    assert stage.host.splats.tables()["gradient_sum"].tolist() == pytest.approx([4e-4, 8e-4])


def test_only_splats_over_the_threshold_with_edges_are_split() -> None:
    stage = Stage([0.5] * 4, BudgetedGrowth(RULES, budget=1000))
    stage.end_batch(10, view([1e-3, 2.9e-4, 1e-3, 1e-3], [1.0, 9.0, 2.0, 0.0], [True] * 4))
    # The first and the third became two each, at the end; the others stay in front.
    assert stage.count == 6
    assert stage.host.splats.means[:2].tolist() == [[3.0, 4.0, 5.0], [9.0, 10.0, 11.0]]
    centres = stage.host.splats.means[2:].view(2, 2, 3).mean(0)
    torch.testing.assert_close(centres.detach(), torch.tensor([[0.0, 1.0, 2.0], [6.0, 7.0, 8.0]]))
    assert not any(bool(table.any()) for table in stage.host.splats.tables().values())


def test_growth_follows_the_curve_and_the_overshoot() -> None:
    stage = Stage([0.5] * 10, BudgetedGrowth(RULES, budget=20, overshoot=2.0))
    counts = []
    for iteration in range(10, 101, 10):
        n = stage.count
        stage.end_batch(iteration, view([1e-3] * n, [1.0] * n, [True] * n))
        counts.append(stage.count)
    # 40 · √progress, but no more than twice as many at a time.
    assert counts == [int(40 * (k / 10) ** 0.5) if k > 1 else 12 for k in range(1, 11)]


def test_late_growth_follows_the_gradient_with_its_own_threshold() -> None:
    stage = Stage([0.5] * 3, BudgetedGrowth(RULES, budget=1000))
    stage.end_batch(110, view([2.5e-4, 1.9e-4, 2.5e-4], [0.0, 9.0, 0.0], [True] * 3))
    assert stage.count == 5


def test_the_first_prune_and_the_transparent_ones() -> None:
    stage = Stage([0.5, 0.019, 0.004, 0.021], BudgetedGrowth(RULES, budget=1000))
    stage.end_batch(5)
    assert stage.opacities == pytest.approx([0.5, 0.021])
    stage = Stage([0.5, 0.019, 0.004, 0.021], BudgetedGrowth(RULES, budget=1000))
    stage.end_batch(10)
    assert stage.opacities == pytest.approx([0.5, 0.019, 0.021])
    stage = Stage([0.5, 0.019, 0.004, 0.021], BudgetedGrowth(RULES, budget=1000))
    stage.end_batch(120)  # the last growth prunes none
    assert stage.count == 4


def test_opacities_are_reset_and_the_faintest_go_when_the_others_have_recovered() -> None:
    opacities = [0.9, 0.04, 0.6, 0.03, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
    stage = Stage(opacities, BudgetedGrowth(RULES, budget=1000))
    stage.end_batch(40)
    assert stage.opacities == pytest.approx([min(value, 0.05) for value in opacities])
    stage.end_batch(47)
    assert stage.opacities == pytest.approx([0.05] * 8)  # a fifth of them went
    stage.end_batch(80)
    stage.end_batch(87)  # only after the first reset
    assert stage.count == 8


def test_pruning_that_leaves_too_few_is_skipped_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    stage = Stage([0.001, 0.001, 0.9], BudgetedGrowth(RULES, budget=1000))
    with caplog.at_level(logging.WARNING):
        stage.end_batch(10)
    assert stage.count == 3
    assert "pruning 2 of 3 splats would leave fewer than min_splats=2" in caplog.text


def test_nothing_happens_after_warm_up() -> None:
    stage = Stage([0.001] * 5, BudgetedGrowth(RULES, budget=1000))
    stage.end_batch(130, view([1.0] * 5, [1.0] * 5, [True] * 5))
    assert stage.count == 5


def test_it_asks_for_edges_during_warm_up_only() -> None:
    stage = Stage([0.5] * 3, BudgetedGrowth(RULES, budget=1000))
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    image[:, WIDTH // 2 :] = 200
    batch = View("a", 0, Camera(torch.eye(3), torch.eye(4), WIDTH, HEIGHT), image)
    stage.trainer.global_step = 119
    stage.growth.on_train_batch_start(stage.trainer, stage.host, batch, 0)
    strength = stage.host.pixel_map
    assert strength.shape == (HEIGHT, WIDTH)
    assert strength[:, WIDTH // 2].min() == 1.0
    assert strength.sum() == HEIGHT  # the bright side of the edge alone
    stage.trainer.global_step = 120
    stage.growth.on_train_batch_start(stage.trainer, stage.host, batch, 0)
    assert stage.host.pixel_map is None


def test_a_budget_is_needed_and_the_modules_is_taken() -> None:
    stage = Stage([0.5] * 3, BudgetedGrowth(RULES))
    with pytest.raises(ValueError, match="growth needs a budget: list SplatBudget before it"):
        stage.growth.limit(stage.host)
    stage.host.splat_budget = 50
    assert stage.growth.limit(stage.host) == 100


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget": 1}, "budget must be at least min_splats=10, got 1"),
        ({"overshoot": 0.9}, "overshoot must be at least 1, got 0.9"),
        ({"finite_every": 0}, "finite_every must be at least 1, got 0"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BudgetedGrowth(**settings)
