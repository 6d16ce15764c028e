"""Runs through all four phases in seconds, finished once for all tests: 9 views of 48×36, some hundred splats."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import Checkpoint
from runs import (
    PAPER,
    PAPER_MODULE,
    RECIPE_MODULE,
    Recipe,
    RunFactory,
    Whole,
    Witness,
    paper_phases,
    quiet_trainer,
    recipe_options,
)

from nsvq_lightning.callbacks import OPTIONAL, STANDARD, DensityControl, MetricReport, RunCheckpoint, standard
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.training.module import SplatModule

STEPS = 60
CODES = {"scales": 24, "quats": 24, "sh0": 16, "shN": 16}


@pytest.fixture(scope="session")
def recipe() -> Recipe:
    """``recipe(**replaced)``: the callbacks of the paper's run, with intervals that fit 60 steps."""

    def build(**replaced: Callback) -> dict[str, Callback]:
        chosen: dict[str, Callback | None] = {
            "phases": paper_phases(
                min_density_interval=4, min_reset_interval=11, min_replacement_interval=5, min_finetune=1
            ),
            "density": DensityControl(grad_threshold=5e-6),
            "report": MetricReport(every=20),
            **dict.fromkeys(("predictions", "checkpoint", "progress")),
            **replaced,
        }
        given = dict.fromkeys(OPTIONAL) | PAPER["callbacks"] | chosen
        names = [name for name in STANDARD if given.get(name, STANDARD) is not None]
        return dict(zip(names, standard("paper", **chosen), strict=True))

    return build


@pytest.fixture(scope="session")
def run(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFactory:
    """``run(callbacks, ckpt_path=…, module={…}, scene=…, **trainer)`` fits and returns trainer and module."""

    def fit(
        callbacks: Iterable[Callback],
        ckpt_path: Path | None = None,
        module: dict[str, Any] | None = None,
        scene: Path = demo_scene,
        **trainer_arguments: Any,
    ) -> tuple[Trainer, SplatModule]:
        callbacks = list(callbacks)
        trainer = quiet_trainer(
            tmp_path_factory.mktemp("run"),
            STEPS,
            enable_checkpointing=any(isinstance(c, Checkpoint) for c in callbacks),
            callbacks=callbacks,
            **{"limit_val_batches": 0} | trainer_arguments,
        )
        splat_module = SplatModule(**PAPER_MODULE | {"sh_degree": 1, "codebooks": CODES} | (module or {}))
        trainer.fit(splat_module, datamodule=ColmapDataModule(str(scene), factor=2), ckpt_path=ckpt_path)
        return trainer, splat_module

    return fit


def finished(run: RunFactory, callbacks: dict[str, Callback], module: dict[str, Any]) -> Whole:
    witness = Witness()
    trainer, trained = run([*callbacks.values(), witness], module=module)
    return Whole(trainer, trained, witness)


@pytest.fixture(scope="session")
def paper(run: RunFactory, recipe: Recipe) -> Whole:
    """The paper's run."""
    return finished(run, recipe(checkpoint=RunCheckpoint(every=4, keep=True)), {})


@pytest.fixture(scope="session")
def fast(run: RunFactory, recipe: Recipe) -> Whole:
    """The recipe's run."""
    return finished(run, recipe(**recipe_options(), checkpoint=RunCheckpoint(every=4, keep=True)), RECIPE_MODULE)
