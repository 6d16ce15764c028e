"""Checkpoints of a run."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from torch.optim import Optimizer

from nsvq_lightning.io.atomic import atomic_path
from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.run_folder import is_trial, run_folder
from nsvq_lightning.training.schedule import Schedule

from .boundary import StepBoundary
from .hosted import WritingCallback
from .latch import LatchedCallback
from .signals import HeldSignals

__all__ = ["RunCheckpoint"]

log = logging.getLogger(__name__)


class RunCheckpoint(WritingCallback, LatchedCallback, Checkpoint):
    """Saves the whole state of the run in ``checkpoints/last.ckpt``: regularly, at ends of phases, and when it stops.

    ``fit --ckpt_path …/last.ckpt`` continues exactly where it was saved. Lightning calls checkpoint callbacks after all
    others, so a checkpoint holds the finished step. Saving does not count as training time. Files are written
    atomically: the previous one stays until the new one is complete.

    Ctrl-C and SIGTERM stop the run after the current iteration, with a checkpoint of it; a second one stops it at once.
    An exception leaves a checkpoint of the last complete iteration if it comes before the update of the next one
    begins. During an update the state belongs to no iteration, and the last checkpoint is the one to continue from.

    Several processes stop together after the iteration in which any of them receives a signal. After an exception in
    one they can no longer agree on an iteration, and the last periodic checkpoint is the one to continue from.

    Args:
        every: Iterations between two checkpoints; None is a tenth of the schedule, 0 saves only at the end of the run.
        keep: Also keep each checkpoint as ``step-<iteration>.ckpt``.
        folder: Where; None is ``checkpoints`` in the folder of the run.

    Raises:
        ValueError: ``every`` is negative.

    Example:
        >>> from nsvq_lightning.callbacks import RunCheckpoint
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> checkpoint = RunCheckpoint(every=1000)  # --callbacks.checkpoint.every=1000
        >>> schedule = Schedule(total=4500)
        >>> [iteration for iteration in range(1, 4501) if checkpoint.is_due(schedule, iteration)]
        [1000, 1500, 2000, 3000, 4000, 4200, 4500]
    """

    def __init__(self, every: int | None = None, keep: bool = False, folder: str | None = None) -> None:
        super().__init__()
        if every is not None and every < 0:
            raise ValueError(f"every must be None or at least 0, got {every}")
        self.every = every
        self.keep = keep
        self.folder = folder
        self.best_model_path = ""
        """Path of ``last_path`` under the name by which Lightning looks for ``ckpt_path="best"``."""
        self._boundary = StepBoundary()
        self._signals = HeldSignals()
        self._saved = -1
        self._training = False
        self._amending = False

    @property
    def last_path(self) -> Path | None:
        """Checkpoint to continue from: the last one written, or at first the one this run was continued from."""
        return Path(self.best_model_path) if self.best_model_path else None

    def is_due(self, schedule: Schedule, iteration: int) -> bool:
        """Whether to save after this iteration; the end of the run is saved separately.

        Ends of phases are due, as the next step (placing codebooks, freezing codes) takes longest and cannot be undone.
        """
        every = max(1, schedule.total // 10) if self.every is None else self.every
        return every > 0 and (iteration % every == 0 or iteration in schedule.ends)

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit; come after all other checkpoint callbacks, whose best one Lightning then finds."""
        super().setup(trainer, pl_module, stage)
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]  # Lightning does not type it
        # A new list: Lightning is going through the old one.
        trainer.callbacks = [*(each for each in callbacks if each is not self), self]  # type: ignore[attr-defined]
        if stage == "fit":
            self.best_model_path, self._saved = "", -1
            self._boundary.drop()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start to hold back signals."""
        super().on_train_start(trainer, pl_module)
        if trainer.ckpt_path is not None:
            self.best_model_path, self._saved = str(trainer.ckpt_path), trainer.global_step
        self._training = True
        self._signals.hold(trainer)

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """The update begins: from here until the end of the iteration there is no state to save."""
        self._boundary.drop()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save when it is time; stop here if a signal came."""
        iteration = trainer.global_step
        if iteration == 0 or not self._latch.first_time(iteration):
            self._boundary.drop()  # of the next iteration some micro-batches are done
            return
        if trainer.world_size == 1:
            self._boundary.take(trainer, pl_module)
        if iteration == trainer.max_steps:
            return  # the end of training belongs to the checkpoint, too: it is saved then, and signals wait
        received = self._signals.received(trainer)
        # One process writes its checkpoint when it has stopped; several can do so together only now.
        if self.is_due(as_host(pl_module).schedule, iteration) or (received and trainer.world_size > 1):
            self._save(trainer, pl_module)
        self._signals.deliver(received)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the end of the run."""
        if trainer.global_step > 0:
            self._save(trainer, pl_module)
        self._training = False
        self._signals.deliver(self._signals.received(trainer, now=True))
        self._signals.release()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save the last complete iteration if it still exists; say where to continue from."""
        self._signals.release()
        if not self._training or is_trial(trainer):
            return
        self._training = False
        if self._boundary.iteration != self._saved and self._boundary.restore(trainer, pl_module):
            self._amending = True
            try:
                self._save(trainer, pl_module)
            except Exception as error:  # the user must see what stopped the run
                log.warning("the checkpoint of iteration %d could not be written: %s", self._boundary.iteration, error)
            finally:
                self._amending = False
        if self.last_path is not None:
            log.warning("stopped; the last checkpoint is of iteration %d: %s", self._saved, self.last_path)
        else:
            log.warning("stopped before the first checkpoint")

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """After an incomplete iteration, store counters and callbacks as they were before it."""
        if self._amending:
            self._boundary.amend(checkpoint)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Restore the signal handlers in any case."""
        super().teardown(trainer, pl_module, stage)
        self._signals.release()

    def _save(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if is_trial(trainer):
            return
        host = as_host(pl_module)
        folder = run_folder(trainer) / "checkpoints" if self.folder is None else Path(self.folder)
        with host.stopwatch.paused(host.device):
            if self.keep:
                _write(trainer, folder / f"step-{trainer.global_step}.ckpt")
            _write(trainer, folder / "last.ckpt")
        self.best_model_path, self._saved = str(folder / "last.ckpt"), trainer.global_step


def _write(trainer: Trainer, path: Path) -> None:
    """Write a checkpoint in one step; Lightning itself writes into the system's temporary folder and copies."""
    # weights_only=False here: save the optimiser's state too. The file holds plain data all the same.
    if not trainer.is_global_zero:
        trainer.save_checkpoint(path, weights_only=False)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        trainer.save_checkpoint(temporary, weights_only=False)
