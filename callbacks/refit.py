"""Refit codebooks that get no gradient to the current rows."""

from __future__ import annotations

import logging
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from torch.optim import Optimizer

from nsvq_lightning.quantize.base import Refittable, is_refittable
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.replicas import from_first_process
from nsvq_lightning.training.schedule import Phase, next_iteration

from .finite import keep_finite_splats
from .hosted import HostedCallback

__all__ = ["CodebookRefit"]

log = logging.getLogger(__name__)


class CodebookRefit(HostedCallback):
    """Refits codebooks to the rows of all splats in the quantize phase, as CompGS does (Navaneet et al. 2024).

    Only quantizers that support it (:class:`nsvq_lightning.quantize.base.Refittable`, such as ``StraightThrough``) are
    refitted. CompGS runs up to 10 steps of k-means every 100 iterations.

    A refit comes between backward pass and update: once a step, also with gradient accumulation, and before other
    callbacks replace codes or evaluate, so the order of the callbacks does not matter.

    Args:
        every: Iterations of the reference run between two refits.
        steps: Lloyd steps of a refit.

    Raises:
        ValueError: ``every`` or ``steps`` is below 1.

    Example:
        >>> from nsvq_lightning import SplatModule
        >>> from nsvq_lightning.callbacks import CodebookRefit
        >>> from nsvq_lightning.quantize import StraightThrough
        >>> refit = CodebookRefit(every=5000)  # --callbacks.codebook_refit.every=5000
        >>> module = SplatModule(codebooks="4k", quantizer=StraightThrough)
        >>> [iteration for iteration in range(1, 45_001) if refit.is_due(module, iteration)]
        [25000, 30000, 35000, 40000]
    """

    def __init__(self, every: int = 100, steps: int = 10) -> None:
        if every < 1 or steps < 1:
            raise ValueError(f"refits need every >= 1 and steps >= 1, got every={every}, steps={steps}")
        self.every = every
        self.steps = steps

    def is_due(self, host: SplatHost, iteration: int) -> bool:
        """Whether codebooks are refitted in this iteration."""
        schedule = host.schedule
        if schedule.phase_at(iteration) is not Phase.QUANTIZE:
            return False
        return iteration in schedule.refit_times(self.every)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Drop non-finite splats before a refit to all rows: after the backward pass this would lose the gradients."""
        host = as_host(pl_module)
        if self.is_due(host, next_iteration(trainer)) and _refittable(host):
            keep_finite_splats(trainer, host)

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """Refit when due, on the first process."""
        host = as_host(pl_module)
        iteration = next_iteration(trainer)
        if not self.is_due(host, iteration):
            return
        for name, quantizer in _refittable(host).items():
            if trainer.is_global_zero:
                quantizer.refit(host.rows(name), self.steps)
            quantizer.codebook.data = from_first_process(trainer, quantizer.codebook.data)
            log.debug("iteration %d: refitted the codebook of %s", iteration, name)


def _refittable(host: SplatHost) -> dict[str, Refittable]:
    """The quantizers that support it, by attribute."""
    return {name: quantizer for name, quantizer in host.quantizers.items() if is_refittable(quantizer)}
