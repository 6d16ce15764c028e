"""How long a run will take: the scene that is timed looks like the one that will train, and shares of a run add up."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nsvq_lightning.callbacks import BudgetedGrowth, forecast
from nsvq_lightning.callbacks.forecast import (
    LOOP,
    PAPER_SPLATS,
    grown,
    iteration_seconds,
    iterations_within,
    step_seconds,
)
from nsvq_lightning.callbacks.growth import splats_for_photos
from nsvq_lightning.data.scene import Scene, detailed_pixels, load_scene, spread
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.schedule import Schedule

SCHEDULE = Schedule(total=1000)


@pytest.fixture
def scene(demo_scene: Path) -> Scene:
    return load_scene(demo_scene)


@pytest.fixture
def a_splat_takes_a_millisecond(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecast, "step_seconds", lambda scene, count, device: count / 1000)


def trainer_of(scene: Scene | None, views: int = 1) -> Any:
    strategy = SimpleNamespace(root_device=torch.device("cpu"), broadcast=lambda value: value)
    data = None if scene is None else SimpleNamespace(scene=scene)
    return SimpleNamespace(datamodule=data, accumulate_grad_batches=views, strategy=strategy)


def module_with(budget: int | None = None, density: BudgetedGrowth | None = None, first: int | None = None) -> Any:
    module = SimpleNamespace(splat_budget=budget, stretches=None, first_points=first)
    if density is not None:
        density.tell(module)  # type: ignore[arg-type]
    return module


@pytest.mark.parametrize("times", [1, 3.5, 8])
def test_as_many_splats_as_asked_for_are_timed_and_they_cover_as_much(scene: Scene, times: float) -> None:
    start = Splats.from_points(scene.points, scene.colors)
    count = round(times * len(start))
    made = grown(scene, count)
    assert len(made) == count
    areas = [float((2 * splats.scales[:, 0].double()).exp().sum()) for splats in (start, made)]
    # Trained splats overlap: by the factor exp(2 · 0.5), whatever their number; the last copy may be cut off.
    assert areas[1] / areas[0] == pytest.approx(torch.e, rel=0.2)
    assert torch.equal(grown(scene, count).means, made.means)
    assert made.means.detach().unique(dim=0).shape == made.means.shape  # none upon another


def test_points_are_not_thinned_to_time_fewer(scene: Scene) -> None:
    assert len(grown(scene, 3)) == len(Splats.from_points(scene.points, scene.colors))


def test_a_step_is_timed_on_views_of_the_scene(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 10.0 + 0.25 * len(spread(scene.train, forecast.VIEWS))])
    monkeypatch.setattr(forecast.time, "perf_counter", lambda: next(clock))
    assert step_seconds(scene, 600) == pytest.approx(0.25)
    assert next(clock, None) is None  # compiling kernels, in the first view, does not count


def test_a_step_of_few_splats_is_timed_with_few(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more points than a run has splats, it starts with some."""
    timed = []

    def noted(scene: Scene, count: int) -> Splats:
        timed.append(len(splats := grown(scene, count)))
        return splats

    monkeypatch.setattr(forecast, "grown", noted)
    assert len(scene.points) > 100
    step_seconds(scene, 100)
    assert timed == [100]


def test_iterations_are_weighed_by_their_share_of_a_run(scene: Scene, a_splat_takes_a_millisecond: None) -> None:
    parts = [(0.5, 1000), (0.25, 4000), (0.25, 2000), (0.0, 10**9)]
    assert iteration_seconds(scene, parts) == pytest.approx(LOOP * 2.0)


def test_a_run_fits_into_its_minutes(scene: Scene, a_splat_takes_a_millisecond: None) -> None:
    density = BudgetedGrowth(overshoot=2.0)
    module = module_with(500, density, first=400)
    seconds = iteration_seconds(scene, density.stretches(SCHEDULE, len(scene.points), 500))
    found = iterations_within(10, trainer_of(scene), module, SCHEDULE)
    assert found == round(600 / seconds)
    assert iterations_within(10, trainer_of(scene, views=4), module, SCHEDULE) == round(150 / seconds)
    # What the dense start will add is there from the first iteration on.
    module.first_points = 100 * len(scene.points)
    assert iterations_within(10, trainer_of(scene), module, SCHEDULE) < found


def test_without_a_word_on_growth_the_paper_is_assumed(scene: Scene, a_splat_takes_a_millisecond: None) -> None:
    usual = PAPER_SPLATS * splats_for_photos(len(scene.train), detailed_pixels(scene))
    for budget, count in ((None, round(usual)), (700, 700)):
        found = iterations_within(60, trainer_of(scene), module_with(budget), SCHEDULE)
        assert found == round(3600 / (LOOP * count / 1000))


def test_there_is_time_for_an_iteration_at_least(scene: Scene, a_splat_takes_a_millisecond: None) -> None:
    assert iterations_within(1e-9, trainer_of(scene), module_with(500), SCHEDULE) == 1


def test_minutes_need_photos() -> None:
    with pytest.raises(ValueError, match=r"minutes are measured on the photos.*give trainer.max_steps"):
        iterations_within(1, trainer_of(None), module_with(500), SCHEDULE)
