"""Checkpoints of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint

from nsvq_lightning.host import as_host, is_trial, output_folder

from .latch import StepLatch

__all__ = ["RunCheckpoint"]


class RunCheckpoint(Checkpoint):
    """Saves the whole state of the run in ``checkpoints/last.ckpt``, now and then and at the end.

    ``fit --ckpt_path …/last.ckpt`` continues exactly where it was saved. Lightning calls checkpoint callbacks after all
    others, so a checkpoint holds the finished step. The time of saving is not training time.

    Args:
        every: Iterations between two checkpoints; None is a tenth of the run, 0 saves at the end only.
        keep: Keep each checkpoint as ``step-<iteration>.ckpt`` too, instead of only the last.
        folder: Where; None is ``checkpoints`` in the trainer's log folder.

    Raises:
        ValueError: ``every`` is negative.
    """

    def __init__(self, every: int | None = None, keep: bool = False, folder: str | None = None) -> None:
        if every is not None and every < 0:
            raise ValueError(f"every must be None or at least 0, got {every}")
        self.every = every
        self.keep = keep
        self.folder = folder
        self._latch = StepLatch()

    def is_due(self, total: int, iteration: int) -> bool:
        """Whether to save after this iteration of a run of ``total``; the end is saved by itself."""
        every = max(1, total // 10) if self.every is None else self.every
        return 0 < iteration < total and every > 0 and iteration % every == 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save when it is time."""
        iteration = trainer.global_step
        if self.is_due(as_host(pl_module).schedule.total, iteration) and self._latch.first_time(iteration):
            self._save(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the end of the run."""
        if trainer.global_step > 0:
            self._save(trainer, pl_module)

    def _save(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if is_trial(trainer):
            return
        host = as_host(pl_module)
        folder = output_folder(trainer) / "checkpoints" if self.folder is None else Path(self.folder)
        with host.stopwatch.paused(host.device):
            if self.keep:
                trainer.save_checkpoint(folder / f"step-{trainer.global_step}.ckpt", weights_only=False)
            # weights_only=False here: save the optimiser's state too. The file holds plain data all the same.
            trainer.save_checkpoint(folder / "last.ckpt", weights_only=False)

    def state_dict(self) -> dict[str, Any]:
        """The last iteration saved at."""
        return {"last": self._latch.last}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do not save again what was loaded."""
        self._latch.last = state_dict["last"]
