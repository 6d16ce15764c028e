"""A run through all four phases that takes seconds: 9 views of 48×36, some hundred splats, codebooks of a few codes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import Checkpoint
from runs import Recipe, RunFactory, quiet_trainer

from nsvq_lightning.callbacks import STANDARD, DensityControl, MetricReport, PhaseSchedule, standard
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.training.module import SplatModule

STEPS = 60
CODES = {"scales": 24, "quats": 24, "sh0": 16, "shN": 16}


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """``recipe(**replaced)``: the callbacks of a full run, with intervals that fit 60 steps."""

    def build(**replaced: Callback) -> dict[str, Callback]:
        chosen: dict[str, Callback | None] = {
            "phases": PhaseSchedule(
                min_density_interval=4, min_reset_interval=11, min_replacement_interval=5, min_finetune=1
            ),
            "density": DensityControl(grad_threshold=5e-6),
            "report": MetricReport(every=20),
            **dict.fromkeys(("predictions", "checkpoint", "kernels", "progress")),
            **replaced,
        }
        names = [name for name in STANDARD if name not in chosen or chosen[name] is not None]
        return dict(zip(names, standard(**chosen), strict=True))

    return build


@pytest.fixture(scope="module")
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
            limit_val_batches=0,
            enable_checkpointing=any(isinstance(c, Checkpoint) for c in callbacks),
            callbacks=callbacks,
            **trainer_arguments,
        )
        splat_module = SplatModule(**{"sh_degree": 1, "codebooks": CODES, **(module or {})})
        trainer.fit(splat_module, datamodule=ColmapDataModule(str(scene), factor=2), ckpt_path=ckpt_path)
        return trainer, splat_module

    return fit
