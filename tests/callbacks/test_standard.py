"""The callbacks of ``nsvq fit`` in a trainer of Lightning's own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

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
from nsvq_lightning.top_level import folder_of
from nsvq_lightning.training.module import SplatModule


def fit(scene: Path, folder: Path, *more: Callback) -> Trainer:
    """Ten iterations with the standard callbacks, and a test of the best checkpoint."""
    callbacks = [*standard(report=MetricReport(every=5, lpips=False, pictures=False)), *more]
    trainer = Trainer(
        max_steps=10,
        max_epochs=-1,
        limit_val_batches=0,
        accelerator="cpu",
        default_root_dir=folder,
        callbacks=callbacks,
        logger=False,
    )
    module, data = SplatModule(sh_degree=0, codebooks={"scales": 4}), ColmapDataModule(str(scene), factor=4)
    trainer.fit(module, data)
    trainer.test(module, data, ckpt_path="best", verbose=False)
    return trainer


def test_a_checkpoint_callback_of_the_users_is_the_trainers(demo_scene: Path, tmp_path: Path) -> None:
    best = ModelCheckpoint(monitor="report/psnr", mode="max", dirpath=tmp_path / "best")
    trainer = fit(demo_scene, tmp_path, best)
    assert isinstance(trainer.progress_bar_callback, SplatProgressBar)
    assert trainer.checkpoint_callbacks[0] is best
    assert Path(best.best_model_path).is_file()
    assert isinstance(trainer.checkpoint_callbacks[-1], RunCheckpoint)
    assert trainer.checkpoint_callbacks[-1].last_path is not None


def test_a_trainer_makes_none_of_its_own(demo_scene: Path, tmp_path: Path) -> None:
    fit(demo_scene, tmp_path)
    assert {path.name for path in tmp_path.rglob("*.ckpt")} == {"last.ckpt"}


def test_a_shipped_config_gives_its_callbacks() -> None:
    (density,) = (each for each in standard("plain") if isinstance(each, DensityControl))
    assert (density.prune_every, density.every) == (0, 100)
    (phases,) = (each for each in standard("paper") if isinstance(each, PhaseSchedule))
    assert phases.schedule(45_000).ends == (15_000, 20_000, 43_000, 45_000)
    assert any(isinstance(each, RateDistortion) for each in standard("small"))
    assert {type(each) for each in standard("fast")} == {type(each) for each in standard()}


@pytest.mark.parametrize("name", ["paper", "plain"])
def test_runs_to_compare_with_have_the_loss_and_the_rates_of_their_papers(name: str) -> None:
    model = yaml.safe_load((folder_of("configs") / f"{name}.yaml").read_text())["model"]
    assert (model["psnr_loss"], model["rates"]["by_distance"], model["rates"]["means"]) == (False, False, 1.6e-4)


@pytest.mark.parametrize("make", [lambda: standard("nosuch"), lambda: standard(nosuch=None)])
def test_names_that_are_not_known_are_told_with_those_that_are(make: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=r"there is no (config|standard callback) nosuch; there are .*(small|density)"):
        make()
