"""Short runs of training in tests: settings of the paper and of the recipe, and the types of fixtures that train."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch import Callback, LightningDataModule, LightningModule, Trainer

from nsvq_lightning.callbacks import (
    BudgetedGrowth,
    CanonicalCovariance,
    CodebookInit,
    CodebookReplacement,
    LearningRateDecay,
    PhaseSchedule,
    RateDistortion,
    ShDegreeSchedule,
    SplatBudget,
    SplatSelection,
)
from nsvq_lightning.commands.fit import default_loggers
from nsvq_lightning.quantize import NSVQ, TrainedStraightThrough
from nsvq_lightning.top_level import folder_of
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Phase

PAPER: dict[str, Any] = yaml.safe_load((folder_of("configs") / "paper.yaml").read_text())
PAPER_MODULE: dict[str, Any] = {"quantizer": NSVQ, "rates": LearningRates(**PAPER["model"]["rates"])}
"""What the paper's run gives the module, but for the size of its codebooks."""

Recipe = Callable[..., dict[str, Callback]]
"""``recipe(**replaced)``: the callbacks of a full run by name."""
RunFactory = Callable[..., tuple[Trainer, SplatModule]]
"""``run(callbacks, ckpt_path=…, module={…}, scene=…, **trainer)`` fits."""


def paper_phases(**replaced: Any) -> PhaseSchedule:
    """The phases of the paper's run."""
    return PhaseSchedule(**PAPER["callbacks"]["phases"] | replaced)


def paper_replacement(**replaced: Any) -> CodebookReplacement:
    """The replacement of codes of the paper's run."""
    return CodebookReplacement(**PAPER["callbacks"]["codebook_replacement"] | replaced)


RECIPE_MODULE: dict[str, Any] = {"quantizer": TrainedStraightThrough, "rates": LearningRates()}
BUDGET = 500
ENDS = {"warmup_end": 24, "prune_end": 40, "quantize_end": 50}


def recipe_options(**replaced: Callback | None) -> dict[str, Callback | None]:
    """The recipe and rate–distortion in 60 iterations: growth in 24, selection in 16, codes in 10, then 10 more."""
    intervals = {"min_density_interval": 1, "min_reset_interval": 1, "min_replacement_interval": 1, "min_finetune": 1}
    return {
        "phases": PhaseSchedule(reference_total=60, position_decay=40, **ENDS, **intervals),
        "sh_degree": ShDegreeSchedule(every=10),
        "budget": SplatBudget(splats=BUDGET),
        "density": BudgetedGrowth(
            start=0,
            full=20,
            every=4,
            grad_threshold=1e-6,
            first_prune=3,
            reset_every=9,
            reset_last=9,
            reset_photos=0,
            recovery=3,
        ),
        "selection": SplatSelection(),
        "opacity": None,
        "rate_decay": LearningRateDecay(start=50),
        "canonical": CanonicalCovariance(),
        "codebook_init": CodebookInit(),
        "codebook_refit": None,
        "codebook_replacement": CodebookReplacement(start=43, early_end=45, early_every=2, end=47, late_every=2),
        "rate_distortion": RateDistortion(0.02),
        **replaced,
    }


def fit(module: LightningModule, data: LightningDataModule, callbacks: Sequence[Callback], steps: int) -> None:
    """Train with the loggers of ``nsvq fit``, into a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        loggers = default_loggers(Path(folder, "run"))
        trainer = quiet_trainer(folder, steps, limit_val_batches=0, logger=loggers, callbacks=list(callbacks))
        trainer.fit(module, datamodule=data)


def quiet_trainer(folder: str | Path, steps: int, **options: Any) -> Trainer:
    """A trainer of ``steps`` iterations on the CPU that shows nothing and stores nothing.

    Args:
        folder: Where what ``options`` ask for is written.
        steps: Optimiser steps.
        options: Further arguments of :class:`lightning.pytorch.Trainer`, or others in place of those chosen here.
    """
    chosen: dict[str, Any] = {
        "accelerator": "cpu",
        "devices": 1,
        "max_steps": steps,
        "max_epochs": -1,
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "default_root_dir": folder,
    }
    return Trainer(**(chosen | options))


@dataclass
class Witness(Callback):
    """Notes what every view and every iteration begins with."""

    phases: list[Phase] = field(default_factory=list)
    splats: list[int] = field(default_factory=list)
    terms: list[set[str]] = field(default_factory=list)
    rates: list[dict[str, float]] = field(default_factory=list)
    scales: dict[int, Any] = field(default_factory=dict)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        assert isinstance(pl_module, SplatModule)
        self.phases.append(pl_module.phase)
        self.splats.append(len(pl_module.splats))
        self.terms.append(set(pl_module.loss_terms))
        self.rates.append({group["name"]: group["lr"] for group in trainer.optimizers[0].param_groups})
        self.scales[trainer.global_step] = pl_module.splats.scales.detach().clone()


@dataclass
class Whole:
    """A finished run that several tests look at, with a checkpoint every fourth iteration and at ends of phases."""

    trainer: Trainer
    module: SplatModule
    witness: Witness

    @property
    def folder(self) -> Path:
        return run_folder(self.trainer)

    @property
    def scene(self) -> bytes:
        return (self.folder / "scene.nsvq").read_bytes()

    def checkpoint(self, iteration: int) -> Path:
        return self.folder / "checkpoints" / f"step-{iteration}.ckpt"
