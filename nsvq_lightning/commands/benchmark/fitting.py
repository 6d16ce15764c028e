"""Training runs with the package's own trainer, callbacks and loggers, timed step by step."""

from __future__ import annotations

import logging
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from lightning.pytorch import Callback, LightningDataModule, LightningModule, Trainer

from nsvq_lightning.callbacks import PhaseSchedule
from nsvq_lightning.callbacks.standard import standard
from nsvq_lightning.commands.benchmark.timing import finish
from nsvq_lightning.commands.fit import default_loggers
from nsvq_lightning.data.scene import View
from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.schedule import Phase

__all__ = ["Step", "StepClock", "fit", "one_phase", "quiet", "quiet_trainer", "training_callbacks"]

WATCHING = frozenset({"report", "export", "predictions", "checkpoint", "kernels", "progress"})
"""Callbacks of ``nsvq fit`` that write files or lines but train nothing; the benchmark measures by itself."""


class Step(NamedTuple):
    """One step, or the last of some that are timed together: its 1-based iteration, its phase, and ms for each."""

    iteration: int
    phase: Phase
    milliseconds: float


class StepClock(Callback):
    """Times steps from the end of one to the end of the next: data, hooks, loggers and loops are in it.

    Args:
        between: Called after a step that has been timed with the module, its view and the step; not in the time.
        together: Steps that are timed as one. A GPU is waited for only after the last, as in training: a wait after
            every step would hide that the host prepares the next one in the meantime.
    """

    def __init__(self, between: Callable[[Any, View, Step], None], together: int = 1) -> None:
        self.steps: list[Step] = []
        self._between, self._together = between, together
        self._open = 0
        self._since = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the first step."""
        self._since = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: View, batch_idx: int
    ) -> None:
        """End a step and start the next."""
        self._open += 1
        if self._open < self._together:
            return
        finish()
        seconds = (time.perf_counter() - self._since) / self._open
        phase, self._open = getattr(as_host(pl_module), "phase", Phase.WARMUP), 0
        self.steps.append(Step(trainer.global_step, phase, 1000 * seconds))
        self._between(pl_module, batch, self.steps[-1])
        self._since = time.perf_counter()


def training_callbacks(**replaced: Callback) -> list[Callback]:
    """The callbacks of ``nsvq fit`` that take part in the training, some of them replaced by name."""
    return standard(**dict.fromkeys(WATCHING), **replaced)


def one_phase(phase: Phase, steps: int) -> PhaseSchedule:
    """A run of ``steps`` iterations in one phase; only fine-tuning has a step before it, which places its codebooks.

    Nothing scales, so density control and resets of the paper's schedule stay outside a short run.
    """
    ends = [steps if phase <= earlier else 0 for earlier in (Phase.WARMUP, Phase.PRUNE, Phase.QUANTIZE)]
    if phase is Phase.FINETUNE:
        ends[-1] = 1
    return PhaseSchedule(steps, None, *ends)


def fit(
    module: LightningModule,
    data: LightningDataModule,
    callbacks: Sequence[Callback],
    steps: int,
    accelerator: str = "cpu",
) -> None:
    """Train silently, with loggers that write into a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder, quiet():
        loggers = default_loggers(Path(folder, "benchmark"))
        trainer = quiet_trainer(
            folder,
            steps,
            limit_val_batches=0,
            logger=loggers,
            callbacks=list(callbacks),
            accelerator=accelerator,
        )
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


@contextmanager
def quiet() -> Iterator[None]:
    """Silence what Lightning says about devices, loaders and the end of the run."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.pytorch.utilities.rank_zero")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
