"""Callbacks for runs started from the command line: what goes wrong on one of two processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

SECOND = 1
"""Number of the view in its step that trouble comes with: that of the second process, or the second micro-batch."""


class SpoiltViews(Callback):
    """Makes the loss of the second view of some steps NaN, and of others the gradient of one position infinite."""

    def __init__(self, losses: Sequence[int] = (), gradients: Sequence[int] = ()) -> None:
        self.losses, self.gradients = losses, gradients
        self._view = 0
        self._weight = 0.0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        module: Any = pl_module
        micro_batch = batch_idx % trainer.accumulate_grad_batches
        self._view = micro_batch * trainer.world_size + trainer.global_rank
        self._weight = module.dssim_weight
        if trainer.global_step + 1 in self.losses and self._view == SECOND:
            module.dssim_weight = float("nan")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *args: Any) -> None:
        module: Any = pl_module
        module.dssim_weight = self._weight

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        module: Any = pl_module
        if trainer.global_step + 1 in self.gradients and self._view == SECOND:
            module.splats.means.grad[5, 1] = torch.inf


class Stopped(Callback):
    """Ends a run in an iteration: by an exception or SIGKILL in the second process, or by SIGTERM to all of them."""

    def __init__(self, iteration: int, by: str) -> None:
        self.iteration, self.by = iteration, by

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step + 1 != self.iteration:
            return
        if self.by == "SIGTERM" and trainer.is_global_zero:
            os.killpg(os.getpgrp(), signal.SIGTERM)
        elif self.by == "SIGKILL" and trainer.global_rank == SECOND:
            os.kill(os.getpid(), signal.SIGKILL)
        elif self.by == "exception" and trainer.global_rank == SECOND:
            raise RuntimeError("trouble in the second process")
