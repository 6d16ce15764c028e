"""A whole run: phases, file, report, repeatability, resume."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any
from unittest.mock import ANY, Mock

import numpy as np
import pytest
import torch
from checkpoints import assert_same_end, read
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import RECIPE_MODULE, Recipe, RunFactory, Whole, Witness, paper_phases, paper_replacement, recipe_options

from nsvq_lightning.callbacks import (
    CanonicalCovariance,
    CodebookInit,
    CodebookRefit,
    FiniteCodes,
    MetricReport,
    RunCheckpoint,
)
from nsvq_lightning.compute.devices import AsyncScalar
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.images import read_image
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import load
from nsvq_lightning.io.nsvq.file import read_nsvq, write_nsvq
from nsvq_lightning.io.nsvq.header import read_header
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.io.placing import placed
from nsvq_lightning.quantize import NSVQ, PostHoc, StraightThrough
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates, position_lr
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Phase, Schedule

SCHEDULE = Schedule(total=60, min_density_interval=4, min_reset_interval=11, min_replacement_interval=5, min_finetune=1)


def scene_bytes(trainer: Trainer) -> bytes:
    return (run_folder(trainer) / "scene.nsvq").read_bytes()


def test_a_run_passes_all_phases(paper: Whole) -> None:
    witness, module = paper.witness, paper.module
    assert paper.trainer.global_step == 60
    assert module.schedule == SCHEDULE
    assert witness.phases == [SCHEDULE.phase_at(i) for i in range(1, 61)]
    assert ["opacity" in terms for terms in witness.terms] == [phase is Phase.PRUNE for phase in witness.phases]
    assert max(witness.splats) > witness.splats[0]  # it grew
    assert len(set(witness.splats[SCHEDULE.ends[Phase.PRUNE] :])) == 1  # and stood still once quantized


def test_codes_are_frozen_in_fine_tuning(paper: Whole) -> None:
    module, frozen_at = paper.module, SCHEDULE.ends[Phase.QUANTIZE]
    assert all(quantizer.codes.shape == (len(module.splats),) for quantizer in module.quantizers.values())
    # The raw attributes the codes stand for no longer move, though Adam has momentum for them.
    scales = paper.witness.scales
    assert torch.equal(scales[frozen_at], scales[60])
    assert not torch.equal(scales[frozen_at - 1], scales[60])


def test_the_file_has_the_size_of_the_formula(paper: Whole, tmp_path: Path) -> None:
    # 16 N + ⌈N·Σ bits / 8⌉ + Σ 4·K·D + header; 24 and 16 codes have 5 and 4 bits.
    path, n = tmp_path / "paper.nsvq", len(paper.module.splats)
    codebooks = 4 * (24 * 3 + 24 * 4 + 16 * 3 + 16 * 9)
    write_nsvq(path, paper.module.compressed(), Storage("paper"))
    assert path.stat().st_size == 16 * n + (n * 18 + 7) // 8 + codebooks + read_header(path).size
    assert len(load(paper.folder / "scene.ply")) == n


def test_the_preview_shows_the_photo_beside_the_render(paper: Whole) -> None:
    data: ColmapDataModule = paper.trainer.datamodule  # type: ignore[attr-defined]
    view = data.scene.view(data.scene.test[0])
    preview = read_image(paper.folder / "preview.png")
    assert np.array_equal(preview[:, : view.camera.width], view.image)
    assert preview.shape[1] == 2 * view.camera.width


def test_the_report_measures_the_decoded_file(paper: Whole, demo_scene: Path) -> None:
    exported = paper.scene
    data = ColmapDataModule(str(demo_scene), factor=2)
    paper.trainer.test(paper.module, datamodule=data, verbose=False)
    assert paper.scene == exported
    assert paper.module.evaluation_splats is None
    folder = paper.folder
    metrics = json.loads((folder / "metrics.json").read_text())
    # Oracle: decode the file here, render, round to 8 bit, PSNR by its formula.
    splats = load(folder / "scene.nsvq")
    expected = []
    for index in data.scene.test:
        view = data.scene.view(index)
        image = (render(splats, view.camera).image.detach().clamp(0, 1) * 255).round() / 255
        error = (image.double() - view.image.double() / 255).square().mean()
        expected.append(-10 * np.log10(float(error)))
    assert metrics["psnr"] == pytest.approx(np.mean(expected), abs=1e-3)
    assert metrics["num_splats"] == len(splats)
    assert metrics["file_bytes"] == (folder / "scene.nsvq").stat().st_size < metrics["paper_level"]["file_bytes"]
    assert metrics["level"] == "compact"
    assert metrics["plain_bytes"] == (folder / "scene.ply").stat().st_size
    assert metrics["ratio"] == pytest.approx(metrics["plain_bytes"] / metrics["file_bytes"])
    assert (metrics["lpips"] is None) == (metrics["lpips_reason"] is not None)
    assert [end["phase"] for end in metrics["phases"]] == ["warmup", "prune", "quantize", "finetune"]
    assert [end["iteration"] for end in metrics["phases"]] == list(SCHEDULE.ends)
    assert metrics["before_quantization"] == metrics["phases"][1]
    assert 0 < metrics["phases"][0]["seconds"] <= metrics["train_seconds"]
    # The last evaluation of the run is of the scene before it is stored; after 60 steps, rounding shows, on some
    # processors more than on others.
    assert metrics["phases"][-1]["psnr"] == pytest.approx(metrics["psnr"], abs=0.15)
    rows = list(csv.DictReader((folder / "views.csv").open()))
    assert [float(row["psnr"]) for row in rows] == pytest.approx(expected, abs=1e-3)
    assert [row["iteration"] for row in csv.DictReader((folder / "curve.csv").open())] == ["20", "27", "40", "57", "60"]
    assert len(list((folder / "renders").iterdir())) == len(rows)
    assert not [path for path in folder.rglob("*") if path.suffix == ".tmp"]


def test_training_improves_the_picture(run: RunFactory, recipe: Recipe) -> None:
    # Without density control: its opacity resets are no help to a run of 60 steps.
    _, module = run(recipe(report=MetricReport(every=13), density=None).values())
    quality = {entry["iteration"]: entry["psnr"] for entry in module.history}
    assert quality[26] > quality[13] + 0.3  # end of the prune phase


def test_the_same_seed_gives_the_same_bytes_whatever_the_order_of_callbacks(
    paper: Whole, run: RunFactory, recipe: Recipe
) -> None:
    backwards, module = run(list(recipe().values())[::-1])
    assert scene_bytes(backwards) == paper.scene
    assert measured(module) == measured(paper.module)


def measured(module: SplatModule) -> list[tuple[int, int, float]]:
    return [(entry["iteration"], entry["splats"], entry["psnr"]) for entry in module.history]


@pytest.mark.parametrize("iteration", [24, 57])
def test_a_resumed_run_is_the_run_not_interrupted(
    paper: Whole, run: RunFactory, recipe: Recipe, iteration: int
) -> None:
    resumed, module = run(recipe(checkpoint=RunCheckpoint(every=0)).values(), paper.checkpoint(iteration))
    assert resumed.global_step == 60
    assert_same_end(run_folder(resumed), paper.folder)
    assert measured(module) == measured(paper.module)
    stored = read(paper.checkpoint(iteration))  # no code in a checkpoint
    assert 0.0 < float(stored["state_dict"]["_extra_state"][3]) < module.stopwatch.seconds


def test_a_checkpoint_is_complete_without_its_trainer(paper: Whole) -> None:
    path = paper.folder / "checkpoints" / "last.ckpt"
    loaded = SplatModule.load_from_checkpoint(path, weights_only=True, quantizer=NSVQ)
    assert (loaded.phase, loaded.active_sh_degree, loaded.extent) == (Phase.FINETUNE, 1, paper.module.extent)
    assert loaded.schedule == paper.module.schedule
    assert measured(loaded) == measured(paper.module)
    write_nsvq(paper.folder / "again.nsvq", loaded.compressed())
    assert (paper.folder / "again.nsvq").read_bytes() == paper.scene


def test_gradient_accumulation_acts_once_a_step(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    witness = Witness()
    caplog.set_level("DEBUG", logger="nsvq_lightning")
    trainer, _ = run([*recipe().values(), witness], accumulate_grad_batches=2)
    assert trainer.global_step == 60
    assert len(witness.phases) == 120
    grown = [r for r in caplog.messages if " splats, now " in r]
    assert len(grown) == len(SCHEDULE.density_times(600, 14_900, 100))
    placed = [r for r in caplog.messages if "codebooks for" in r]
    assert len(placed) == 1
    # Within a step the splats stand still: rows of both micro-batches match.
    assert all(len(set(witness.splats[i : i + 2])) == 1 for i in range(1, 120 - 2, 2))


def test_learning_rates_can_follow_the_views_of_a_step(run: RunFactory, recipe: Recipe) -> None:
    for scale, factor in ((False, 1.0), (True, 2.0)):
        rates = LearningRates(scale_with_views=scale)
        trainer, module = run(recipe().values(), module={"rates": rates}, accumulate_grad_batches=4, max_steps=2)
        groups = {group["name"]: group["lr"] for group in trainer.optimizers[0].param_groups}
        assert groups["opacities"] == factor * rates.opacities
        positions = position_lr(2, module.extent, rates, module.schedule.iteration(module.schedule.position_decay))
        assert groups["means"] == pytest.approx(factor * positions)


def test_callbacks_of_an_earlier_fit_act_again(fast: Whole, run: RunFactory, recipe: Recipe) -> None:
    callbacks = recipe(**recipe_options()).values()
    run(callbacks, module=RECIPE_MODULE, max_steps=20)
    assert scene_bytes(run(callbacks, module=RECIPE_MODULE)[0]) == fast.scene


def test_codes_of_a_codebook_that_was_never_placed_are_not_frozen(run: RunFactory, recipe: Recipe) -> None:
    callbacks = recipe()
    del callbacks["codebook_init"]
    with pytest.raises(RuntimeError, match="the codebook of scales has never been placed"):
        run(callbacks.values(), max_steps=20)


def test_a_run_without_codebooks_is_plain_splatting(run: RunFactory, recipe: Recipe, demo_scene: Path) -> None:
    trainer, module = run(recipe().values(), module={"codebooks": None, "storage": Storage("paper")}, max_steps=20)
    trainer.test(module, datamodule=ColmapDataModule(str(demo_scene), factor=2), verbose=False)
    folder = run_folder(trainer)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["level"] == "paper"
    assert metrics["paper_level"] == {"file_bytes": metrics["file_bytes"], "header_bytes": ANY}
    decoded = load(folder / "scene.nsvq")
    expected = placed(CompressedScene.from_splats(module.splats), module.frame).decode()
    assert all(torch.equal(getattr(decoded, n), p) for n, p in expected.attributes().items())


def test_any_subset_of_attributes_can_be_quantized(run: RunFactory, recipe: Recipe) -> None:
    codebooks = {"quats": 5, "shN": 3}
    trainer, _ = run(recipe().values(), module={"codebooks": codebooks}, max_steps=20)
    stored = read_nsvq(run_folder(trainer) / "scene.nsvq")
    # Codes that no splat uses are not in the file.
    assert all(2 <= len(stored.codebooks[name]) <= count for name, count in codebooks.items())
    assert stored.codebooks.keys() == codebooks.keys()
    assert set(stored.raw) == {"scales", "quats", "sh0", "shN"} - set(codebooks)


def test_more_codes_than_splats_are_no_problem(run: RunFactory, recipe: Recipe) -> None:
    trainer, module = run(recipe(density=None).values(), module={"codebooks": "0.5k"}, max_steps=20)
    stored = read_nsvq(run_folder(trainer) / "scene.nsvq")
    assert all(len(book) <= len(module.splats) for book in stored.codebooks.values())


class Plant(Callback):
    """Breaks a code of SH after an iteration."""

    def __init__(self, *iterations: int) -> None:
        self.iterations = iterations

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        assert isinstance(pl_module, SplatModule)
        if trainer.global_step in self.iterations:
            pl_module.quantizers["sh0"].codebook.data[3] = torch.nan


def test_a_run_whose_codes_turn_non_finite_goes_on(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    callbacks = [Plant(31, 58), *recipe(codebook_finite=FiniteCodes(every=4)).values()]
    _, module = run(callbacks, module={"psnr_loss": False})  # too short a run for it
    assert all(bool(quantizer.codebook.isfinite().all()) for quantizer in module.quantizers.values())
    found = [message for message in caplog.messages if "codes of sh0 are non-finite" in message]
    # Frozen codes are drawn: the loss shows a broken one at once, not only at the next check.
    assert [message.split(" codes")[0] for message in found] == ["step 32: 1 of 16", "step 59: 1 of 16"]
    assert 10 < module.history[-1]["psnr"] < 100


class PlantSplats(Callback):
    """Breaks an attribute of some splats at the end of an iteration."""

    def __init__(self, attribute: str, iteration: int) -> None:
        self.attribute, self.iteration = attribute, iteration

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, SplatModule)
        if trainer.global_step == self.iteration:
            pl_module.splats.attributes()[self.attribute].data[:20] = torch.nan


def drops(caplog: pytest.LogCaptureFixture, attribute: str) -> list[str]:
    """Where splats with a non-finite attribute were dropped, and how many."""
    suffix = f"with non-finite values: {attribute} in 20 rows"
    return [message.split(" of ")[0] for message in caplog.messages if message.endswith(suffix)]


def test_splats_that_turn_non_finite_in_fine_tuning_are_dropped(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    phases = paper_phases(quantize_end=30_000, min_finetune=1)
    callbacks = [*recipe(phases=phases).values(), PlantSplats("sh0", 15)]
    _, module = run(callbacks, module={"codebooks": {"scales": 24}}, max_steps=20)
    assert module.schedule.phase_at(15) is Phase.FINETUNE
    assert drops(caplog, "sh0") == ["step 16: dropped 20"]
    assert sum("no update" in message for message in caplog.messages) == 1
    assert module.quantizers["scales"].codes.shape == (len(module.splats),)
    assert 10 < module.history[-1]["psnr"] < 100


class LateScalar(AsyncScalar):
    """On the CPU, one that is on its way at first, as from a GPU."""

    def __init__(self, value: torch.Tensor) -> None:
        super().__init__(value)
        self.is_here, self._copied = False, Mock(["synchronize"])


def test_a_loss_that_is_known_only_after_the_backward_pass_changes_no_bit(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def outcome() -> tuple[SplatModule, list[str]]:
        caplog.clear()
        _, module = run([*recipe().values(), PlantSplats("sh0", 5), PlantSplats("sh0", 9)], max_steps=30)
        return module, [message for message in caplog.messages if "no update" in message]

    at_once, said_at_once = outcome()
    monkeypatch.setattr("nsvq_lightning.training.module.AsyncScalar", LateScalar)
    late, said_late = outcome()
    assert len(said_late) == 2
    assert said_late == said_at_once
    for name, tensor in at_once.state_dict().items():
        assert name == "_extra_state" or torch.equal(late.state_dict()[name], tensor), name


@pytest.mark.parametrize("with_density", [True, False])
def test_codebooks_are_placed_on_finite_splats(
    with_density: bool, run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    callbacks = recipe(codebook_init=CodebookInit(), canonical=None)
    if not with_density:
        del callbacks["density"]
    # After the search at the end of the prune phase, and before the form of the covariances is chosen.
    late = [PlantSplats("quats", 9), CanonicalCovariance()]
    _, module = run([*callbacks.values(), *late], max_steps=20)
    assert module.schedule.first_of(Phase.QUANTIZE) == 10
    assert drops(caplog, "quats") == ["step 9: dropped 20"]
    assert 10 < module.history[-1]["psnr"] < 100


@pytest.mark.parametrize(
    ("callbacks", "quantizer", "step"),
    [
        ({"codebook_refit": CodebookRefit()}, StraightThrough, 13),  # refits come at 14 and 19
        ({"codebook_replacement": paper_replacement(jitter=0.5)}, NSVQ, 15),  # after 10 and 15
    ],
)
def test_codes_move_to_finite_splats_only(
    callbacks: dict[str, Callback],
    quantizer: type,
    step: int,
    run: RunFactory,
    recipe: Recipe,
    caplog: pytest.LogCaptureFixture,
) -> None:
    standard = [*recipe(**callbacks).values(), PlantSplats("quats", 13)]
    _, module = run(standard, module={"quantizer": quantizer}, max_steps=20)
    assert drops(caplog, "quats") == [f"step {step}: dropped 20"]
    assert 10 < module.history[-1]["psnr"] < 100


def test_post_hoc_codebooks_are_evaluated_although_splats_are_not_finite(run: RunFactory, recipe: Recipe) -> None:
    callbacks = [*recipe(report=MetricReport(every=15)).values(), PlantSplats("quats", 15)]
    _, module = run(callbacks, module={"quantizer": PostHoc}, max_steps=20)
    assert 15 in [entry["iteration"] for entry in module.history]
    assert all(10 < entry["psnr"] < 100 for entry in module.history if entry["iteration"] >= 15)
