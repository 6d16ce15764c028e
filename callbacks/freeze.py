"""Freeze the codes at the start of fine-tuning."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.host import as_host, from_first_process, next_iteration
from nsvq_lightning.replicas import check_replicas
from nsvq_lightning.schedule import Phase

from .finite_search import keep_finite_splats
from .latch import LatchedCallback

__all__ = ["FreezeCodes"]


class FreezeCodes(LatchedCallback):
    """At the first iteration of fine-tuning, search the nearest code of every splat once and keep it from then on.

    A quantizer that says whether its codebook has been placed, by an attribute ``fitted``, must have one by then.
    """

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Freeze when fine-tuning starts.

        Raises:
            RuntimeError: A codebook has never been placed.
        """
        host = as_host(pl_module)
        iteration = next_iteration(trainer)
        if iteration != host.schedule.first_of(Phase.FINETUNE) or not self._latch.first_time(iteration):
            return
        keep_finite_splats(trainer, host)
        for name, quantizer in host.quantizers.items():
            codes = quantizer.encode(host.rows(name))
            # Only now: some place their codebooks where rows are encoded.
            if not getattr(quantizer, "fitted", True):
                raise RuntimeError(
                    f"iteration {iteration}: the codebook of {name} has never been placed, its codes cannot be frozen; "
                    "fit with CodebookInit among the callbacks"
                )
            quantizer.freeze(from_first_process(trainer, codes))
        check_replicas(trainer, "freezing the codes")
