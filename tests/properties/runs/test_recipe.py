"""The recipe in 60 iterations: growth, selection, budgets, codes by rate and distortion, falling rates."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from checkpoints import assert_same_end
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import BUDGET, ENDS, RECIPE_MODULE, Recipe, RunFactory, Whole, paper_replacement, recipe_options
from torch import Tensor

from nsvq_lightning.callbacks import (
    BudgetedGrowth,
    CanonicalCovariance,
    CodebookInit,
    LearningRateDecay,
    PhaseSchedule,
    RateDistortion,
    RunCheckpoint,
    SplatBudget,
    SplatSelection,
    forecast,
)
from nsvq_lightning.commands.main import main
from nsvq_lightning.data.datamodule import DEMO
from nsvq_lightning.io.formats import load
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.quantize.codebook import CodebookQuantizer
from nsvq_lightning.quantize.nearest import code_rates
from nsvq_lightning.rendering.reference import rotation_matrices
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Phase


def scene_bytes(trainer: Trainer) -> bytes:
    return (run_folder(trainer) / "scene.nsvq").read_bytes()


def test_splats_grow_and_are_selected_down_to_the_budget(fast: Whole) -> None:
    assert BUDGET < max(fast.witness.splats) <= 2 * BUDGET
    assert fast.witness.splats[ENDS["warmup_end"] + 1] == BUDGET
    assert len(load(fast.folder / "scene.nsvq")) == BUDGET
    assert all(len(quantizer.held) == 0 for quantizer in fast.module.codebooks.values())  # type: ignore[arg-type]


@pytest.mark.parametrize("iteration", [16, 32, 44, 48])
def test_a_resumed_run_is_the_run_not_interrupted(fast: Whole, run: RunFactory, recipe: Recipe, iteration: int) -> None:
    callbacks = recipe(**recipe_options(checkpoint=RunCheckpoint(every=0))).values()
    resumed, _ = run(callbacks, fast.checkpoint(iteration), RECIPE_MODULE)
    assert_same_end(run_folder(resumed), fast.folder)


def test_rates_fall_at_the_end(fast: Whole) -> None:
    rates = [rate["opacities"] / 0.025 for rate in fast.witness.rates]
    assert rates[:50] == pytest.approx([1.0] * 50)
    assert rates[50:] == pytest.approx([0.1 ** (k / 10) for k in range(1, 11)])
    colours = [rate["codebook_sh0"] for rate in fast.witness.rates]
    assert colours[59] == pytest.approx(0.1 * colours[0])


def test_the_order_of_callbacks_matters_only_where_it_is_said_to(fast: Whole, run: RunFactory, recipe: Recipe) -> None:
    callbacks = recipe(**recipe_options())
    # Each needs the one before, or acts at the same time.
    first = ["budget", "density", "canonical", "codebook_init", "codebook_replacement"]
    names = [*first, *(name for name in reversed(callbacks) if name not in first)]
    assert scene_bytes(run([callbacks[name] for name in names], module=RECIPE_MODULE)[0]) == fast.scene


def test_neutral_options_are_the_run_without_them(paper: Whole, run: RunFactory, recipe: Recipe) -> None:
    neutral = {"selection": SplatSelection(), "rate_decay": LearningRateDecay(final=1.0)}
    assert scene_bytes(run(recipe(**neutral).values())[0]) == paper.scene


def test_a_finished_scene_is_selected_down(
    run: RunFactory, recipe: Recipe, fast: Whole, caplog: pytest.LogCaptureFixture
) -> None:
    callbacks = recipe(
        phases=PhaseSchedule(reference_total=60, warmup_end=0, prune_end=40, quantize_end=60),
        density=None,
        selection=SplatSelection(budget=300),
    )
    with caplog.at_level(logging.INFO):
        trainer, module = run(callbacks.values(), module={"init_from": str(fast.folder / "scene.ply")})
    assert module.phase is Phase.QUANTIZE
    assert len(load(run_folder(trainer) / "scene.nsvq")) == 300
    assert "the selection leaves 300 of 500 splats" in caplog.text


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


def test_a_dense_start_adds_points_to_those_of_sfm(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    def splats(share: float) -> int:
        chosen = recipe(budget=SplatBudget(splats=10_000, start=share), density=None)
        return len(run(chosen.values(), max_steps=1, scene=DEMO)[1].splats)

    with caplog.at_level(logging.INFO):
        known, more = splats(0.0), splats(0.8)
    (line,) = [message for message in caplog.messages if "points beside" in message]
    dense, sfm = map(int, re.findall(r"dense start: (\d+) points beside (\d+) of SfM, ", line)[0])
    assert dense + sfm == 8000
    # Those far away come on top.
    assert (known, more) == (sfm + round(0.02 * sfm), 8160)


def test_where_flow_finds_nothing_the_run_starts_from_sfm(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = torch.empty(0, 3)
    monkeypatch.setattr("nsvq_lightning.training.run_scene.dense_points", lambda *_: (nothing, nothing))
    _, module = run(recipe(budget=SplatBudget(splats=2000), density=None).values(), max_steps=1)
    assert len(module.splats) > 0
    assert "training starts from SfM's points" in caplog.text


def test_a_resumed_run_looks_for_no_points(
    run: RunFactory, recipe: Recipe, fast: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the checkpoint has its splats")

    monkeypatch.setattr("nsvq_lightning.training.run_scene.dense_points", refuse)
    checkpoint = sorted((fast.folder / "checkpoints").glob("*.ckpt"))[0]
    run(recipe(**recipe_options()).values(), ckpt_path=checkpoint, module=RECIPE_MODULE)


def test_few_photos_shorten_the_run(run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture) -> None:
    phases = PhaseSchedule(reference_total=60, iterations_per_photo=2, **ENDS)
    with caplog.at_level(logging.INFO):
        trainer, module = run(recipe(phases=phases).values())
    assert "iterations: 14 for 7 photos; --callbacks.phases.iterations_per_photo" in caplog.text
    assert trainer.global_step == module.schedule.total == trainer.max_steps == 14
    assert module.phase is Phase.FINETUNE  # which ends with it
    assert run(recipe(phases=phases).values(), max_steps=3)[0].global_step == 3
    phases.least_iterations = 17
    assert run(recipe(phases=phases).values())[0].global_step == 17


def test_the_length_of_the_schedule_is_that_of_a_run_without_any(run: RunFactory, recipe: Recipe) -> None:
    phases = PhaseSchedule(reference_total=60, total=9, **ENDS)
    assert run(recipe(phases=phases).values(), max_steps=-1)[0].global_step == 9


def test_growth_that_has_nothing_to_split_ends_the_warm_up_and_shortens_the_run(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    def chosen(every: int) -> dict[str, Callback]:
        growth = BudgetedGrowth(
            start=0, full=20, every=4, grad_threshold=1e3, late_threshold=1e3, first_prune=0, patience=2
        )
        return recipe(**recipe_options(density=growth, checkpoint=RunCheckpoint(every=every, keep=True)))

    with caplog.at_level(logging.INFO):
        trainer, module = run(chosen(every=10).values(), module=RECIPE_MODULE)
    assert "iteration 12: growth ends with 510 splats" in caplog.text  # of 500 points
    assert module.schedule.saved == 12
    assert module.schedule.ends == (12, 28, 38, 48)
    assert trainer.global_step == trainer.max_steps == 48
    for interrupted_at in (10, 30):
        path = run_folder(trainer) / "checkpoints" / f"step-{interrupted_at}.ckpt"
        resumed, _ = run(chosen(every=0).values(), path, RECIPE_MODULE)
        assert resumed.global_step == 48
        assert scene_bytes(resumed) == scene_bytes(trainer)


def test_few_splats_get_few_codes(run: RunFactory, recipe: Recipe) -> None:
    """Oracle: K·D is at most so many values a splat, K at least 1, and what was asked for where that is less."""
    asked = {"scales": 24, "quats": 24, "sh0": 16, "shN": 16}
    for share in (0.0005, 0.004):
        _, module = run(recipe(codebook_init=CodebookInit(values_per_splat=share)).values(), max_steps=12)
        for name, quantizer in module.quantizers.items():
            most = max(1, int(share * len(module.splats) / quantizer.codebook.shape[1]))
            assert len(quantizer.codebook) == min(most, asked[name])
            assert int(quantizer.codes.max()) < len(quantizer.codebook)
        assert len(module.quantizers["shN"].codebook) < asked["shN"]


class Look(Callback):
    """Keeps scales and quaternions before and after the last iteration before the quantize phase."""

    def __init__(self, iteration: int) -> None:
        self.iteration = iteration
        self.seen: list[tuple[Tensor, Tensor]] = []

    def _look(self, trainer: Trainer, module: LightningModule, *_: Any) -> None:
        assert isinstance(module, SplatModule)
        if trainer.global_step == self.iteration:
            self.seen.append((module.splats.scales.detach().clone(), module.splats.quats.detach().clone()))

    on_train_batch_end = on_before_zero_grad = _look


def test_rows_are_canonical_when_codebooks_are_placed(run: RunFactory, recipe: Recipe) -> None:
    look = Look(9)  # first in the list, so that it sees them before and after
    _, module = run([look, *recipe(canonical=CanonicalCovariance()).values()], max_steps=20)
    assert module.schedule.first_of(Phase.QUANTIZE) == 10
    before, after = look.seen
    axes = [rotation_matrices(quats.double()) * scales.double().exp()[:, None] for scales, quats in look.seen]
    first, second = (a @ a.mT for a in axes)
    assert ((second - first).norm(dim=(1, 2)) / first.norm(dim=(1, 2))).max() < 1e-5
    assert (before[0].diff(dim=1) > 0).any()
    assert (after[0].diff(dim=1) <= 0).all()
    torch.testing.assert_close(after[1].norm(dim=1), torch.ones(len(after[1])))


def test_a_run_that_starts_with_codebooks_starts_canonical(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    phases = PhaseSchedule(warmup_end=0, prune_end=0)
    with caplog.at_level("INFO"):
        run(recipe(phases=phases, canonical=CanonicalCovariance()).values(), max_steps=4)
    assert caplog.text.count("iteration 0: each covariance") == 1


class Recording(NSVQ):
    """Keeps the weights it was fitted with."""

    weight: Tensor | None = None

    def fit(self, x: Tensor, weight: Tensor | None = None, generator: torch.Generator | None = None) -> None:
        self.weight = weight
        super().fit(x, weight, generator)


def test_kmeans_gets_contributions_as_weights(run: RunFactory, recipe: Recipe) -> None:
    for weighted in (False, True):
        callbacks = recipe(codebook_init=CodebookInit(weighted=weighted)).values()
        _, module = run(callbacks, module={"quantizer": Recording}, max_steps=12)
        found = {name: quantizer.weight for name, quantizer in module.quantizers.items()}  # type: ignore[attr-defined]
        names = {name for name, weight in found.items() if weight is not None}
        assert names == ({"quats", "sh0", "shN"} if weighted else set())
    assert found["quats"].shape == (len(module.splats),)
    assert found["quats"].min() > 0
    assert found["quats"].max() > 2 * found["quats"].mean()


@pytest.mark.parametrize("reset", [False, True])
def test_moments_of_replaced_codes_are_reset(
    reset: bool, run: RunFactory, recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = CodebookQuantizer.replace_unused

    def replace_a_third(quantizer: CodebookQuantizer, *args: Any, **kwargs: Any) -> torch.Tensor:
        """Codes out of use for a window of 5 views are rare here: call every third one unused."""
        quantizer.usage.fill_(quantizer.window)
        quantizer.usage[::3] = 0
        return replace(quantizer, *args, **kwargs)

    monkeypatch.setattr(CodebookQuantizer, "replace_unused", replace_a_third)
    zero_rows: list[int] = []

    class Moments(Callback):
        def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
            groups = trainer.optimizers[0].param_groups
            (book,) = next(group["params"] for group in groups if group["name"] == "codebook_scales")
            if state := trainer.optimizers[0].state.get(book):
                zero_rows.append(int((~state["exp_avg_sq"].any(1)).sum()))

    replacement = paper_replacement(jitter=0.5 if reset else None)
    run([*recipe(codebook_replacement=replacement).values(), Moments()], max_steps=20)
    assert max(zero_rows[1:]) == (8 if reset else 0)


def bits(module: SplatModule) -> float:
    """Bits of all codes of a splat at their entropy."""
    rates = ((q.codes, code_rates(q.codes, len(q.codebook))) for q in module.quantizers.values())
    return sum(float(rate[codes].mean()) for codes, rate in rates)


def test_codes_take_fewer_bits_the_stronger_rate_and_distortion_is(run: RunFactory, recipe: Recipe) -> None:
    few, fewer = (
        bits(run(recipe(rate_distortion=RateDistortion(strength)).values(), module=RECIPE_MODULE)[1])
        for strength in (0.01, 0.1)
    )
    assert few > fewer + 0.3


def test_splats_that_are_dropped_have_codes_chosen_anew(run: RunFactory, recipe: Recipe) -> None:
    class Spoil(Callback):
        def on_train_batch_end(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
            if trainer.global_step == 44:
                pl_module.splats.means.data[:7] = torch.nan

    density = BudgetedGrowth(start=0, full=20, every=4, grad_threshold=1e-6, finite_every=1)
    _, module = run([Spoil(), *recipe(**recipe_options(density=density)).values()], module=RECIPE_MODULE)
    assert len(module.splats) == BUDGET - 7
    assert all(len(quantizer.codes) == BUDGET - 7 for quantizer in module.quantizers.values())


def test_a_shorthand_replaces_the_configs_budget(tmp_path: Path, demo_scene: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text("callbacks: {budget: {bytes: 100000}}\n")
    quiet = ("--trainer.enable_progress_bar=false", "--trainer.max_steps=2", "--callbacks.predictions=null")
    arguments = [f"--config={config}", f"--data.root={demo_scene}", "--data.factor=2", "--model.codebooks=null"]
    assert main(["fit", *arguments, *quiet, "--splats", "60", f"--trainer.run_folder={tmp_path / 'run'}"]) == 0
    written = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["callbacks"]["budget"]["init_args"]
    assert (written["splats"], written["bytes"]) == (60, None)


@pytest.mark.parametrize("name", ["best", "small"])
def test_the_shipped_configs_run(
    name: str, demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [f"--data.root={demo_scene}", "--data.factor=4", f"--trainer.default_root_dir={tmp_path}"]
    quiet = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu", "--callbacks.report.every=0"]
    assert main(["fit", f"--config={name}", *arguments, *quiet, "--trainer.max_steps=8", "--model.sh_degree=1"]) == 0
    assert "rendered from the decoded file" in capsys.readouterr().out
    config = yaml.safe_load(next(tmp_path.rglob("config.yaml")).read_text())
    assert config["model"]["quantizer"]["class_path"].endswith(".TrainedStraightThrough")
    assert (config["callbacks"]["rate_distortion"] is None) == (name != "small")


def test_minutes_choose_the_iterations(
    run: RunFactory, recipe: Recipe, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(forecast, "step_seconds", lambda scene, count, device: count / 1000)
    phases = PhaseSchedule(reference_total=60, minutes=0.5, **ENDS)
    options = recipe_options(phases=phases, density=BudgetedGrowth(overshoot=2.0, full=ENDS["warmup_end"]))
    with caplog.at_level(logging.INFO):
        trainer, module = run(recipe(**options).values(), module=RECIPE_MODULE)
    points = BudgetedGrowth(full=ENDS["warmup_end"]).stretches(module.schedule, 100, BUDGET)[0][1]
    assert 100 < points < 2 * BUDGET
    total = module.schedule.total
    assert 1 < total <= trainer.global_step == trainer.max_steps <= total + total // 4  # it is faster than that
    assert f"iterations: {total}, about 0.5 min of training" in caplog.text


def test_a_run_of_some_minutes_can_be_repeated(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast, "step_seconds", lambda scene, count, device: 1.0)
    folder = tmp_path / "run"
    options = ["--splats=300", "--model.codebooks=null", f"--trainer.run_folder={folder}", "--callbacks.report=null"]
    assert main(["fit", f"--data.root={demo_scene}", "--minutes=0.1", *options]) == 0
    settings = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    phases = settings["callbacks"]["phases"]["init_args"]
    assert phases["total"] == round(6 / forecast.LOOP) <= settings["trainer"]["max_steps"]
    assert phases["minutes"] is phases["iterations_per_photo"] is None


def test_a_run_of_some_minutes_that_is_interrupted_goes_on_to_the_end_it_has_chosen(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast, "step_seconds", lambda scene, count, device: 1.0)
    before_step = PhaseSchedule.before_step

    def stop(phases: PhaseSchedule, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        before_step(phases, trainer, module, iteration)
        phases._steps = trainer.max_steps + 1
        if iteration == 3:
            raise RuntimeError("interrupted")

    monkeypatch.setattr(PhaseSchedule, "before_step", stop)
    folder = tmp_path / "run"
    options = ["--splats=300", "--model.codebooks=null", f"--trainer.run_folder={folder}", "--callbacks.report=null"]
    with pytest.raises(RuntimeError, match="interrupted"):
        main(["fit", f"--data.root={demo_scene}", "--minutes=0.1", *options])
    settings = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    total = round(6 / forecast.LOOP)
    assert settings["callbacks"]["phases"]["init_args"]["total"] == total
    assert settings["trainer"]["max_steps"] > total
