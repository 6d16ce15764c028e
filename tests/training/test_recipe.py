"""Growth, selection, budgets, falling rates: whole runs of 60 iterations."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
from checkpoints import CheckpointAt
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import Recipe, RunFactory

from nsvq_lightning.callbacks import (
    BudgetedGrowth,
    GrowthRules,
    LearningRateDecay,
    OpacitySelection,
    PhaseSchedule,
    RunCheckpoint,
    SplatBudget,
)
from nsvq_lightning.io.formats import load
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Phase

BUDGET = 500
ENDS = {"warmup_end": 24, "prune_end": 40, "quantize_end": 50}
INTERRUPTED = (10, 16, 24, 30, 33, 47, 53)


def options(**replaced: Callback) -> dict[str, Callback]:
    """The new recipe in 60 iterations: growth in 24, selection in 16, codes in 10, 10 for the rest."""
    intervals = {"min_density_interval": 1, "min_reset_interval": 1, "min_replacement_interval": 5, "min_finetune": 1}
    growth = GrowthRules(
        start=0, full=20, every=4, grad_threshold=1e-6, first_prune=3, reset_every=9, reset_last=9, recovery=3
    )
    return {
        "phases": PhaseSchedule(reference_total=60, position_decay=40, **ENDS, **intervals),
        "budget": SplatBudget(splats=BUDGET),
        "density": BudgetedGrowth(growth),
        "selection": OpacitySelection(strength=1e-2),
        "rate_decay": LearningRateDecay(final=0.1),
        **replaced,
    }


def scene_bytes(trainer: Trainer) -> bytes:
    return (run_folder(trainer) / "scene.nsvq").read_bytes()


class Witness(Callback):
    """Notes splats, rates and views of every step."""

    def __init__(self) -> None:
        self.counts: list[int] = []
        self.rates: list[dict[str, float]] = []
        self.views: list[int] = []
        self._seen = 0

    def on_train_batch_start(self, trainer: Trainer, *args: Any) -> None:
        self._seen += 1

    def on_before_zero_grad(self, trainer: Trainer, pl_module: LightningModule, optimizer: Any) -> None:
        assert isinstance(pl_module, SplatModule)
        self.counts.append(len(pl_module.splats))
        self.rates.append({group["name"]: group["lr"] for group in optimizer.param_groups})
        self.views.append(self._seen)
        self._seen = 0


@pytest.fixture(scope="module")
def witness() -> Witness:
    return Witness()


@pytest.fixture(scope="module")
def finished(run: RunFactory, recipe: Recipe, witness: Witness) -> Trainer:
    trainer, _ = run([*recipe(**options(checkpoint=CheckpointAt(*INTERRUPTED))).values(), witness])
    return trainer


def test_splats_grow_and_are_selected_down_to_the_budget(finished: Trainer, witness: Witness) -> None:
    assert BUDGET < max(witness.counts) <= 2 * BUDGET
    assert witness.counts[ENDS["prune_end"] + 1] == BUDGET
    assert len(load(run_folder(finished) / "scene.nsvq")) == BUDGET


@pytest.mark.parametrize("interrupted_at", INTERRUPTED)
def test_a_resumed_run_is_the_run_not_interrupted(
    finished: Trainer, run: RunFactory, recipe: Recipe, interrupted_at: int
) -> None:
    path = run_folder(finished) / "checkpoints" / f"step-{interrupted_at}.ckpt"
    resumed, _ = run(recipe(**options(checkpoint=RunCheckpoint(every=0))).values(), ckpt_path=path)
    assert scene_bytes(resumed) == scene_bytes(finished)


def test_rates_fall_at_the_end_and_rise_for_the_selection(finished: Trainer, witness: Witness) -> None:
    rates = [rate["opacities"] / 0.05 for rate in witness.rates]
    assert rates[:24] == pytest.approx([1.0] * 24)
    assert rates[24] == pytest.approx(4.0)
    assert rates[40:50] == pytest.approx([1.0] * 10)
    assert rates[50:] == pytest.approx([0.1 ** (k / 10) for k in range(1, 11)])
    colours = [rate["codebook_sh0"] for rate in witness.rates]
    assert colours[59] == pytest.approx(0.1 * colours[0])


def test_neutral_options_are_the_run_without_them(run: RunFactory, recipe: Recipe) -> None:
    neutral = {"budget": SplatBudget(), "selection": OpacitySelection(), "rate_decay": LearningRateDecay()}
    without = recipe(**dict.fromkeys(neutral)).values()
    present = recipe(**neutral).values()
    assert scene_bytes(run(present)[0]) == scene_bytes(run(without)[0])


def test_a_finished_scene_is_selected_down(
    run: RunFactory, recipe: Recipe, finished: Trainer, caplog: pytest.LogCaptureFixture
) -> None:
    source = run_folder(finished) / "scene.ply"
    callbacks = recipe(
        phases=PhaseSchedule(reference_total=60, warmup_end=0, prune_end=40, quantize_end=60),
        density=None,
        selection=OpacitySelection(budget=300, strength=1e-2),
    )
    with caplog.at_level(logging.INFO):
        trainer, module = run(callbacks.values(), module={"init_from": str(source)})
    assert module.phase is Phase.QUANTIZE
    assert len(load(run_folder(trainer) / "scene.nsvq")) == 300
    assert "the selection is done, 300 splats are left" in caplog.text


@pytest.mark.parametrize("budget", ["quality", "bytes"])
def test_a_budget_from_photos_or_bytes_is_explained(
    budget: str, run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    chosen = SplatBudget(quality=2.0) if budget == "quality" else SplatBudget(bytes=60_000)
    with caplog.at_level(logging.INFO):
        _, module = run(recipe(budget=chosen).values(), max_steps=2)
    (line,) = [message for message in caplog.messages if message.startswith("budget: ")]
    assert line.startswith(f"budget: {module.splat_budget} splats, ")
    assert ("quality 2 times what 7 photos with" if budget == "quality" else "for a file of 60000 bytes") in line


def test_few_photos_shorten_the_run(run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture) -> None:
    phases = PhaseSchedule(reference_total=60, iterations_per_photo=2, **ENDS)
    with caplog.at_level(logging.INFO):
        trainer, module = run(recipe(phases=phases).values())
    assert "iterations: 14, 2 for each of 7 photos" in caplog.text
    assert trainer.global_step == module.schedule.total == trainer.max_steps == 14
    assert module.phase is Phase.FINETUNE  # which ends with it
    plenty = PhaseSchedule(reference_total=60, iterations_per_photo=2, **ENDS)
    assert run(recipe(phases=plenty).values(), max_steps=3)[0].global_step == 3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SplatBudget(quality=1.0, splats=5), "a budget is one number, got quality and splats"),
        (lambda: SplatBudget(bytes=0), "bytes must be finite and above 0, got 0"),
        (lambda: PhaseSchedule(iterations_per_photo=0), "iterations_per_photo must be at least 1, got 0"),
        (lambda: LearningRateDecay(final=0.0), "final must be above 0 and at most 1, got 0.0"),
    ],
)
def test_settings_out_of_range_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_shorthand_replaces_the_configs_budget(tmp_path: Path, demo_scene: Path) -> None:
    from nsvq_lightning.commands.main import main

    config = tmp_path / "config.yaml"
    config.write_text("callbacks: {budget: {quality: 1.0}}\n")
    quiet = ("--trainer.enable_progress_bar=false", "--trainer.max_steps=2", "--callbacks.predictions=null")
    arguments = [f"--config={config}", f"--data.root={demo_scene}", "--data.factor=2", "--model.codebooks=null"]
    assert main(["fit", *arguments, *quiet, "--splats", "60", f"--trainer.run_folder={tmp_path / 'run'}"]) == 0
    written = (tmp_path / "run" / "config.yaml").read_text()
    assert "splats: 60" in written
    assert "quality: null" in written


def test_growth_that_has_nothing_to_split_ends_the_warm_up_and_shortens_the_run(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    idle = GrowthRules(start=0, full=20, every=4, grad_threshold=1e3, late_threshold=1e3, first_prune=0, patience=2)
    chosen = options(density=BudgetedGrowth(idle), checkpoint=CheckpointAt(10, 13, 30))
    with caplog.at_level(logging.INFO):
        trainer, module = run(recipe(**chosen).values())
    assert "iteration 12: growth ends with 500 splats" in caplog.text
    assert module.schedule.saved == 12
    assert module.schedule.ends == (12, 28, 38, 48)
    assert trainer.global_step == 48
    assert trainer.max_steps == 48
    for interrupted_at in (10, 13, 30):
        path = run_folder(trainer) / "checkpoints" / f"step-{interrupted_at}.ckpt"
        again = options(density=BudgetedGrowth(idle), checkpoint=RunCheckpoint(every=0))
        resumed, _ = run(recipe(**again).values(), ckpt_path=path)
        assert resumed.global_step == 48
        assert scene_bytes(resumed) == scene_bytes(trainer)
