"""What follows the iteration alone also does so in a run whose warm-up has ended early."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from nsvq_lightning.callbacks import LearningRateDecay, PhaseSchedule
from nsvq_lightning.top_level import folder_of
from nsvq_lightning.training.schedule import Phase, Schedule

RECIPE = PhaseSchedule().schedule(2500)


def factor(decay: LearningRateDecay, schedule: Schedule, iteration: int) -> float:
    """By what the rate of the scales is multiplied in an iteration."""
    scaled: dict[str, float] = {}
    module: Any = SimpleNamespace(schedule=schedule, scale_rate=scaled.__setitem__)
    groups = [{"name": "means"}, {"name": "scales"}]
    trainer: Any = SimpleNamespace(global_step=iteration - 1, optimizers=[SimpleNamespace(param_groups=groups)])
    decay.on_train_batch_start(trainer, module, None, 0)  # type: ignore[arg-type]
    assert "means" not in scaled
    return scaled.get("scales", 1.0)


@pytest.mark.parametrize("saved", [0, 300, 600])
@pytest.mark.parametrize("start", [10_600, None])
def test_rates_fall_as_far_whatever_the_warm_up_has_saved(saved: int, start: int | None) -> None:
    decay, shorter = LearningRateDecay(final=0.1, start=start), replace(RECIPE, saved=saved)
    for phase in (Phase.PRUNE, Phase.QUANTIZE, Phase.FINETUNE):
        for before in (0, 40):
            expected = factor(decay, RECIPE, RECIPE.ends[phase] - before)
            assert factor(decay, shorter, shorter.ends[phase] - before) == pytest.approx(expected)
    assert factor(decay, shorter, shorter.ends[-1]) == pytest.approx(0.1)
    assert factor(decay, shorter, shorter.ends[Phase.PRUNE]) == 1.0


@pytest.mark.parametrize("saved", [0, 300])
def test_iterations_of_the_reference_run_are_found_again(saved: int) -> None:
    schedule = replace(RECIPE, saved=saved)
    for reference in (600, 7000, 10_600, 12_000, 15_000):
        if reference == 7000 and saved:
            continue  # left out
        assert schedule.reference(schedule.iteration(reference)) == pytest.approx(reference, abs=3)
    assert schedule.share(schedule.reference(schedule.ends[-1])) == pytest.approx(1.0)
    assert schedule.part(20) == 125
    assert Schedule(total=4).part(20) == 1


def test_only_the_schedule_scales() -> None:
    """Whoever divides by the length of a run forgets what its warm-up may have saved."""
    for path in folder_of("callbacks").glob("*.py"):
        source = path.read_text(encoding="utf-8")
        assert not [word for word in ("schedule.total /", "schedule.scale", ".reference_total\n") if word in source], (
            path
        )


def test_a_limit_for_each_photo_leaves_shorter_runs_alone() -> None:
    phases = PhaseSchedule(iterations_per_photo=20, least_iterations=2500)
    assert [phases.limited(4500, photos) for photos in (10, 200, 1000)] == [2500, 4000, 4500]
    assert [phases.limited(-1, 10), phases.limited(300, 10), PhaseSchedule().limited(300, 10)] == [2500, 300, 300]


def test_a_trainer_that_fits_again_asks_for_what_it_was_given() -> None:
    phases = PhaseSchedule(iterations_per_photo=10)
    loop = SimpleNamespace(max_steps=1000)
    trainer = Several(loop)
    module: Any = SimpleNamespace()
    for photos, steps in ((20, 200), (70, 700), (300, 1000), (5, 50)):
        trainer.datamodule = SimpleNamespace(scene=SimpleNamespace(train=range(photos)))
        phases.before_fit(trainer, module)  # type: ignore[arg-type]
        assert (trainer.max_steps, module.schedule.total) == (steps, steps)
    loop.max_steps = 30  # somebody asks for something else
    phases.before_fit(trainer, module)  # type: ignore[arg-type]
    assert module.schedule.total == 30


@pytest.mark.parametrize(("checkpoint", "total"), [(None, 900), ("last.ckpt", 30)])
def test_minutes_scale_the_phases_of_an_earlier_run(
    monkeypatch: pytest.MonkeyPatch, checkpoint: str | None, total: int
) -> None:
    monkeypatch.setattr("nsvq_lightning.callbacks.schedule.iterations_within", lambda *_: 900)
    trainer: Any = Several(SimpleNamespace(max_steps=30))
    trainer.ckpt_path = checkpoint
    module: Any = SimpleNamespace()
    PhaseSchedule(total=30, minutes=5).before_fit(trainer, module)
    assert (trainer.max_steps, module.schedule.total) == (900, total)


def test_a_last_phase_that_goes_on_is_told(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        for steps in (1000, 1250, 1300):
            said = len(caplog.records)
            PhaseSchedule(total=1000).before_fit(Several(SimpleNamespace(max_steps=steps)), SimpleNamespace())  # type: ignore[arg-type]
            assert ("the phases are those of 1000 iterations" in caplog.text) == (steps == 1300)
    assert len(caplog.records) == said + 1


class Several:
    """A trainer of several scenes."""

    def __init__(self, loop: SimpleNamespace) -> None:
        self.fit_loop = SimpleNamespace(epoch_loop=loop)
        self.datamodule = SimpleNamespace()

    @property
    def max_steps(self) -> int:
        return int(self.fit_loop.epoch_loop.max_steps)


@pytest.mark.parametrize(("milliseconds", "after"), [(10, 0), (9, 222), (5, 500), (10.5, -95), (30, -127)])
def test_fine_tuning_ends_with_the_minutes(milliseconds: float, after: int) -> None:
    """2000 iterations were to take 10 ms each; how many more or fewer there are if they take something else.

    Half of fine-tuning stays, and a quarter of the run is the most.
    """
    phases = PhaseSchedule(minutes=20 / 60)
    schedule = phases.schedule(2000)
    phases._steps = 2000
    watch = SimpleNamespace(seconds=0.0, lap=lambda: None)
    module: Any = SimpleNamespace(schedule=schedule, stopwatch=watch)
    trainer: Any = SimpleNamespace(strategy=SimpleNamespace(broadcast=lambda value: value))
    for iteration in range(1, 2001):
        phases.before_step(trainer, module, iteration)
        watch.seconds += milliseconds / 1000
    assert phases._steps == pytest.approx(2000 + after, abs=2)
