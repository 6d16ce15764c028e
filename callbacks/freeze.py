"""Freeze the codes at the start of fine-tuning."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.host import as_host, from_first_process, next_iteration
from nsvq_lightning.replicas import check_replicas
from nsvq_lightning.schedule import Phase

from .latch import StepLatch

__all__ = ["FreezeCodes"]


class FreezeCodes(Callback):
    """At the first iteration of fine-tuning, search the nearest code of every splat once and keep it from then on."""

    def __init__(self) -> None:
        self._latch = StepLatch()

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Freeze when fine-tuning starts."""
        host = as_host(pl_module)
        iteration = next_iteration(trainer)
        if iteration != host.schedule.first_of(Phase.FINETUNE) or not self._latch.first_time(iteration):
            return
        for name, quantizer in host.quantizers.items():
            quantizer.freeze(from_first_process(trainer, quantizer.encode(host.rows(name))))
        check_replicas(trainer, "freezing the codes")
