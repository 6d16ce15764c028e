"""Checkpoints of a run: regularly, and when a signal asks for a stop."""

import signal
from contextlib import nullcontext
from dataclasses import field
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Checkpoint

from nsvq_lightning.io.atomic import atomic_path, make_folder_of, optional
from nsvq_lightning.top_level import log
from nsvq_lightning.training.distributed import sum_over_processes
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import is_fast_dev_run, run_folder

from .base import WritingCallback
from .settings import Whole

HELD = (signal.SIGINT, signal.SIGTERM)
# Steps between two exchanges of signals among several GPUs.
APART = 16


class GracefulStop:
    """Holds back the first SIGINT and the first SIGTERM until :meth:`deliver`; a second one acts at once.

    With several processes a second one does nothing: launchers forward signals that a process has already received, and
    a process that stopped in the middle of an iteration would leave the others waiting.

    Delivering calls the previous handler, so the trainer and the interpreter still decide what a signal does. Ignored
    signals stay ignored; outside the main thread, where Python allows no handlers, nothing is held back.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, Any] = {}
        self._pending: list[int] = []

    def hold(self, trainer: Trainer) -> None:
        """Start to hold signals back."""
        self._several = trainer.world_size > 1
        if self._handlers or current_thread() is not main_thread():
            return
        for number in HELD:
            handler = signal.getsignal(number)
            if callable(handler):
                self._handlers[number] = handler
                signal.signal(number, self._receive)

    def received(self, trainer: Trainer, *, now: bool = False) -> list[int]:
        """Signals received by any process in the meantime: a collective, which every process must call.

        Several GPUs ask each other only in one step of 16, because the answer is waited for.

        Args:
            trainer: The trainer.
            now: Ask in any case; what one process says, all must say.
        """
        if trainer.world_size == 1:
            return list(self._pending)
        if trainer.strategy.root_device.type != "cpu" and trainer.global_step % APART and not now:
            return []
        own = torch.tensor([number in self._pending for number in HELD], dtype=torch.float32)
        counts = sum_over_processes(trainer, own.to(trainer.strategy.root_device)).tolist()
        return [number for number, count in zip(HELD, counts, strict=True) if count]

    def deliver(self, received: list[int]) -> None:
        """Call the previous handlers of the signals."""
        for number in received:
            if number in self._pending:
                self._pending.remove(number)
            if number in self._handlers:
                self._handlers[number](number, None)

    def release(self) -> None:
        """Restore the previous handlers."""
        for number, handler in self._handlers.items():
            if signal.getsignal(number) == self._receive:
                signal.signal(number, handler)
        self._handlers, self._pending = {}, []

    def _receive(self, number: int, frame: Any) -> None:
        if number not in self._pending:
            self._pending.append(number)
            more = "" if self._several else "; a second one stops at once, without a checkpoint"
            log.warning(f"{signal.Signals(number).name}: stopping after this iteration{more}")
        elif not self._several:
            self._pending.remove(number)
            self._handlers[number](number, frame)


class RunCheckpoint(WritingCallback, Checkpoint):
    """Saves the whole state of the run in ``checkpoints/last.ckpt``: regularly, at ends of phases, and when it stops.

    ``fit --ckpt_path …/last.ckpt`` continues exactly where it was saved. Lightning calls checkpoint callbacks after all
    others, so a checkpoint holds the finished step. Saving does not count as training time. Files are written
    atomically: the previous one stays until the new one is complete. If one cannot be written, as on a full disk, a run
    of one process warns and goes on; if it is the last one, the run fails at its very end.

    Ctrl-C and SIGTERM stop the run after the current iteration, with a checkpoint of it; a second one stops it at once.
    Several processes stop together after the iteration in which any of them receives a signal. After an exception,
    which comes in the middle of an iteration, the last checkpoint is the one to continue from.

    Example:
        >>> from nsvq_lightning import SplatModule
        >>> from nsvq_lightning.callbacks import RunCheckpoint
        >>> checkpoint = RunCheckpoint(every=10_000)  # --callbacks.checkpoint.every=10000
        >>> module = SplatModule(codebooks="4k")
        >>> [iteration for iteration in range(1, 45_001) if checkpoint.is_due(module, iteration)]
        [10000, 15000, 20000, 30000, 40000, 43000, 45000]
    """

    passing = ("best_model_path", "_missing", "_saved")

    every: Whole | None = None
    """Iterations between two checkpoints; None is a tenth of the schedule, 0 saves only at the end of the run."""
    keep: bool = False
    """Also keep each checkpoint as ``step-<iteration>.ckpt``."""
    # Path of ``last_path`` under the name by which Lightning looks for ``ckpt_path="best"``.
    best_model_path = ""
    _stop: GracefulStop = field(default_factory=GracefulStop, init=False)
    _saved = -1
    _missing = _training = False

    @property
    def last_path(self) -> Path | None:
        """Checkpoint to continue from: the last one written, or at first the one this run was continued from."""
        return Path(self.best_model_path) if self.best_model_path else None

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether to save after this iteration; the end of the run is saved separately.

        Ends of phases are due, as the next step (placing codebooks, freezing codes) takes longest and cannot be undone.
        """
        every = module.schedule.part(10) if self.every is None else self.every
        return every > 0 and (iteration % every == 0 or iteration in module.schedule.ends)

    def setup(self, trainer: Trainer, module: SplatModule, stage: str) -> None:
        """Come after all other checkpoint callbacks, whose best one Lightning then finds."""
        super().setup(trainer, module, stage)
        # A new list: Lightning is going through the old one.
        trainer.callbacks = [*(each for each in trainer.callbacks if each is not self), self]  # type: ignore[attr-defined]

    def on_train_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Start to hold back signals."""
        if trainer.ckpt_path:
            self.best_model_path, self._saved = str(trainer.ckpt_path), trainer.global_step
        self._training = True
        self._stop.hold(trainer)

    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Save when it is time; stop here if a signal came."""
        if iteration == trainer.max_steps:
            # The end of training may fail; it belongs to a checkpoint, too, and signals wait.
            self._save(trainer, module)
            return
        received = self._stop.received(trainer)
        if received or self.is_due(module, iteration):
            self._save(trainer, module)
        self._stop.deliver(received)

    def on_train_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Save the end of the run."""
        if trainer.global_step > 0:
            self._save(trainer, module)
        self._training = False
        self._stop.deliver(self._stop.received(trainer, now=True))
        self._stop.release()

    def on_fit_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Fail where the end of the run could not be saved, now that other callbacks have written what is left of it.

        Raises:
            OSError: Its checkpoint could not be written.
        """
        if self._missing:
            raise OSError("last.ckpt is not of the end of the run, which could not be written: make room, and continue")

    def on_exception(self, trainer: Trainer, module: SplatModule, exception: BaseException) -> None:
        """Say where to continue from."""
        self._stop.release()
        if not self._training or is_fast_dev_run(trainer):
            return
        self._training = False
        if self.last_path:
            log.warning(f"stopped; the last checkpoint is of iteration {self._saved}: {self.last_path}")
        else:
            log.warning("stopped before the first checkpoint")

    def teardown(self, trainer: Trainer, module: SplatModule, stage: str) -> None:
        """Restore the signal handlers in any case."""
        super().teardown(trainer, module, stage)
        self._stop.release()

    def _save(self, trainer: Trainer, module: SplatModule) -> None:
        if is_fast_dev_run(trainer):
            return
        self._missing = True
        last = run_folder(trainer) / "checkpoints" / "last.ckpt"
        # One process alone can go on without: others would wait for it where a save ends.
        with module.stopwatch.paused(module.device), nullcontext() if trainer.world_size > 1 else optional(last):
            if self.keep:
                _write(trainer, last.with_name(f"step-{trainer.global_step}.ckpt"))
            _write(trainer, last)
            self.best_model_path, self._saved, self._missing = str(last), trainer.global_step, False


def _write(trainer: Trainer, path: Path) -> None:
    """Write a checkpoint in one step; other trainers than ours write where the system has temporary files, and move."""
    # weights_only=False here: save the optimiser's state too. The file holds plain data all the same.
    make_folder_of(path)
    with atomic_path(path) if trainer.is_global_zero else nullcontext(path) as target:
        trainer.save_checkpoint(target, weights_only=False)
