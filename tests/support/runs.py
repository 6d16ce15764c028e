"""Short runs of training in tests, the paper's settings, and the types of fixtures that train (``training/conftest.py``)."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch import Callback, LightningDataModule, LightningModule, Trainer

from nsvq_lightning.callbacks import CodebookReplacement, PhaseSchedule
from nsvq_lightning.commands.fit import default_loggers
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.top_level import folder_of
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates

__all__ = [
    "PAPER",
    "PAPER_MODULE",
    "Recipe",
    "RunFactory",
    "fit",
    "paper_phases",
    "paper_replacement",
    "quiet_trainer",
]

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
