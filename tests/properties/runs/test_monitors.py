"""Metrics of the report where Lightning looks for them, and what looks there."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from runs import Recipe, RunFactory

from nsvq_lightning.callbacks import MetricReport, RunCheckpoint
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import View
from nsvq_lightning.training.run_folder import run_folder


def curve(folder: Path) -> dict[int, float]:
    with open(folder / "curve.csv", newline="") as file:
        return {int(row["iteration"]): float(row["psnr"]) for row in csv.DictReader(file)}


def test_the_report_is_in_the_callback_metrics(run: RunFactory, recipe: Recipe) -> None:
    trainer, module = run(recipe().values(), max_steps=20)
    last = module.history[-1]
    assert last["iteration"] == 20
    for name in ("psnr", "ssim", "splats"):
        assert float(trainer.callback_metrics[f"report/{name}"]) == pytest.approx(last[name])


def test_a_checkpoint_keeps_the_best_evaluation_and_continues_to_the_same_bits(
    run: RunFactory, recipe: Recipe, tmp_path: Path
) -> None:
    best = ModelCheckpoint(tmp_path, "{step}", monitor="report/psnr", mode="max", save_top_k=-1)
    trainer, _ = run([*recipe(report=MetricReport(every=10)).values(), best])
    scores = curve(run_folder(trainer))
    assert {10, 20, 27, 57, 60} <= scores.keys()  # ends of phases among them, where the next one has begun already
    stored = {int(Path(path).stem.partition("=")[2]): float(score) for path, score in best.best_k_models.items()}
    assert stored == pytest.approx(scores, abs=1e-3)
    assert Path(best.best_model_path).stem == f"step={max(scores, key=scores.__getitem__)}"
    expected = (run_folder(trainer) / "scene.nsvq").read_bytes()
    resumed, _ = run(recipe(checkpoint=RunCheckpoint(every=0)).values(), tmp_path / "step=27.ckpt")
    assert (run_folder(resumed) / "scene.nsvq").read_bytes() == expected


@pytest.mark.parametrize("at_epochs", [None, False])
def test_early_stopping_ends_the_run(run: RunFactory, recipe: Recipe, at_epochs: bool | None) -> None:
    stop = EarlyStopping(
        "report/psnr", min_delta=100.0, patience=2, mode="max", check_on_train_epoch_end=at_epochs, verbose=False
    )
    trainer, module = run([*recipe(report=MetricReport(every=5)).values(), stop])
    # The first evaluation is the best there was, two more are no better; what was begun is finished.
    assert trainer.global_step == 16
    assert [entry["iteration"] for entry in module.history] == [5, 10, 15, 16]
    assert (run_folder(trainer) / "scene.nsvq").is_file()


def test_metrics_of_the_module_are_watched_and_unknown_ones_refused_at_the_first_evaluation(
    run: RunFactory, recipe: Recipe, tmp_path: Path
) -> None:
    stop = EarlyStopping("train/loss", min_delta=100.0, patience=2, verbose=False)
    best = ModelCheckpoint(tmp_path, "{step}", monitor="train/loss", save_top_k=-1)
    trainer, _ = run([*recipe(report=MetricReport(every=5)).values(), stop, best], log_every_n_steps=7)
    # At iteration 5 there is none yet.
    assert sorted(best.best_k_models) == [str(tmp_path / f"step={step}.ckpt") for step in (10, 15, 20, 21)]
    assert trainer.global_step == 21
    seen: list[int] = []

    class Steps(Callback):
        def on_train_batch_end(self, trainer: Trainer, *_: object) -> None:
            seen.append(trainer.global_step)

    with pytest.raises(RuntimeError, match="conditioned on metric `val/psnr` which is not available"):
        run([*recipe(report=MetricReport(every=5)).values(), Steps(), EarlyStopping("val/psnr", verbose=False)])
    assert max(seen) <= 5


def test_what_monitors_validation_is_called_by_it_alone(run: RunFactory, recipe: Recipe, tmp_path: Path) -> None:
    best = ModelCheckpoint(tmp_path, "{step}", monitor="val/psnr", mode="max", save_top_k=-1)
    options: dict[str, Any] = {"limit_val_batches": 1.0, "val_check_interval": 8, "max_steps": 20}
    run([*recipe(report=MetricReport(every=5)).values(), best], **options)
    assert {int(Path(path).stem.partition("=")[2]) for path in best.best_k_models} == {8, 16}


class Watcher(Callback):
    """Has a monitor, and notes when it is called."""

    monitor = "report/psnr"

    def __init__(self) -> None:
        self.seen: list[int] = []

    def on_validation_end(self, trainer: Trainer, module: LightningModule) -> None:
        self.seen.append(trainer.global_step)


def test_any_callback_with_a_monitor_is_called(run: RunFactory, recipe: Recipe) -> None:
    watcher = Watcher()
    _, module = run([*recipe(report=MetricReport(every=5)).values(), watcher], max_steps=20)
    assert watcher.seen == [entry["iteration"] for entry in module.history]


def test_the_report_has_the_photos_that_the_module_has(
    run: RunFactory, recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    def darken(_: ColmapDataModule, batch: View, dataloader_idx: int) -> View:
        return replace(batch, image=batch.image // 2)

    monkeypatch.setattr(ColmapDataModule, "on_after_batch_transfer", darken)
    options: dict[str, Any] = {"limit_val_batches": 1.0, "val_check_interval": 20, "max_steps": 20}
    trainer, module = run(recipe().values(), **options)
    assert float(trainer.callback_metrics["val/psnr"]) == pytest.approx(module.history[-1]["psnr"], abs=0.01)


def test_tensorboard_gets_the_pictures_of_the_test(
    run: RunFactory, recipe: Recipe, demo_scene: Path, tmp_path: Path
) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    logger = TensorBoardLogger(tmp_path, "a", version="b")
    callbacks: dict[str, Callback] = recipe()
    trainer, module = run(callbacks.values(), max_steps=4, logger=logger)
    trainer.test(module, datamodule=ColmapDataModule(str(demo_scene), factor=2), verbose=False)
    record = events.EventAccumulator(str(tmp_path / "a" / "b")).Reload()
    pictures = {path.stem for path in (tmp_path / "a" / "b" / "renders").iterdir()}
    assert {tag.removeprefix("test/") for tag in record.Tags()["images"]} == pictures
    (image,) = record.Images(f"test/{min(pictures)}")
    assert (image.width, image.height) == (3 * 48, 36)
    assert image.step == 4
    assert "report/psnr" in record.Tags()["scalars"]
    assert torch.isfinite(trainer.callback_metrics["test/psnr"])
