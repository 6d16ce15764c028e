"""The callbacks of ``nsvq fit`` in a trainer of Lightning's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar

from nsvq_lightning.callbacks import (
    DensityControl,
    MetricReport,
    PhaseSchedule,
    RateDistortion,
    RunCheckpoint,
    SplatProgressBar,
    standard,
)
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.training.module import SplatModule


def fit(scene: Path, folder: Path, *more: Any, **flags: Any) -> Trainer:
    """Ten iterations with the standard callbacks, and a test of the best checkpoint if there is one."""
    flags = {"logger": False, "enable_model_summary": False} | flags
    callbacks = [*standard(report=MetricReport(every=5, lpips=False, pictures=False)), *more]
    trainer = Trainer(
        max_steps=10,
        max_epochs=-1,
        limit_val_batches=0,
        accelerator="cpu",
        default_root_dir=folder,
        callbacks=callbacks,
        **flags,
    )
    module, data = SplatModule(sh_degree=0, codebooks={"scales": 4}), ColmapDataModule(str(scene), factor=4)
    trainer.fit(module, data)
    if trainer.checkpoint_callback is not None:
        trainer.test(module, data, ckpt_path="best", verbose=False)
    return trainer


@pytest.mark.parametrize(
    ("flags", "kinds"),
    [
        ({}, [SplatProgressBar, RunCheckpoint]),
        ({"enable_progress_bar": False}, [RunCheckpoint]),
        ({"enable_checkpointing": False}, [SplatProgressBar]),
        ({"barebones": True}, []),
    ],
)
def test_a_trainer_has_the_bar_and_the_checkpoints_that_its_flags_allow(
    flags: dict[str, Any], kinds: list[type], demo_scene: Path, tmp_path: Path
) -> None:
    trainer = fit(demo_scene, tmp_path, **flags)
    callbacks = trainer.callbacks  # type: ignore[attr-defined]
    found = [type(each) for each in callbacks if isinstance(each, TQDMProgressBar | ModelCheckpoint | RunCheckpoint)]
    assert found == kinds
    names = {path.name for path in tmp_path.rglob("*.ckpt")}
    assert names == ({"last.ckpt"} if RunCheckpoint in kinds else set())


def test_a_checkpoint_callback_of_the_users_is_the_trainers(demo_scene: Path, tmp_path: Path) -> None:
    best = ModelCheckpoint(monitor="report/psnr", mode="max", dirpath=tmp_path / "best")
    trainer = fit(demo_scene, tmp_path, best, enable_progress_bar=False)
    assert trainer.checkpoint_callbacks[0] is best
    assert Path(best.best_model_path).is_file()
    assert isinstance(trainer.checkpoint_callbacks[-1], RunCheckpoint)
    assert trainer.checkpoint_callbacks[-1].last_path is not None


def test_a_shipped_config_gives_its_callbacks() -> None:
    (density,) = (each for each in standard("plain") if isinstance(each, DensityControl))
    assert (density.prune_every, density.every) == (0, 100)
    (phases,) = (each for each in standard("paper") if isinstance(each, PhaseSchedule))
    assert phases.schedule(45_000).ends == (15_000, 20_000, 43_000, 45_000)
    assert any(isinstance(each, RateDistortion) for each in standard("small"))
    assert {type(each) for each in standard("fast")} == {type(each) for each in standard()}
