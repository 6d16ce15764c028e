"""Codes that turn non-finite are put back among the others."""

from __future__ import annotations

import logging
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.quantize.base import is_mendable
from nsvq_lightning.random import generator
from nsvq_lightning.training.edit import reset_moments
from nsvq_lightning.training.host import SplatHost, as_host, raw_optimizer
from nsvq_lightning.training.optim import codebook_group
from nsvq_lightning.training.schedule import Phase

from .finite_search import FiniteSearch
from .latch import LatchedCallback

__all__ = ["FiniteCodes"]

log = logging.getLogger(__name__)


class FiniteCodes(LatchedCallback):
    """Searches codebooks for NaN and infinite numbers, from the quantize phase on, and mends such codes with a warning.

    As with splats that turn non-finite (:class:`~nsvq_lightning.callbacks.DensityControl`), the run goes on. A code
    cannot be dropped, as the others would change their numbers: the quantizer puts it back
    (:class:`nsvq_lightning.quantize.base.Mendable`), and its Adam moments start anew.

    Args:
        every: Iterations between two searches; a step whose loss is not finite always causes one.

    Raises:
        ValueError: ``every`` is below 1.
    """

    def __init__(self, every: int = 100) -> None:
        super().__init__()
        self._search = FiniteSearch(every)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Search when it is time.

        Raises:
            FloatingPointError: All codes of an attribute are non-finite, or its quantizer cannot mend them.
        """
        host, iteration = as_host(pl_module), trainer.global_step
        if iteration == 0 or host.schedule.phase_at(iteration) < Phase.QUANTIZE:
            return
        if self._latch.first_time(iteration) and self._search.is_due(trainer):
            self._mend(trainer, host, iteration)

    def _mend(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        for name, quantizer in host.quantizers.items():
            broken = (~torch.isfinite(quantizer.codebook.detach()).all(1)).nonzero()[:, 0]
            if len(broken) == 0:
                continue
            found = f"step {iteration}: {len(broken)} of {len(quantizer.codebook)} codes of {name} are non-finite"
            if len(broken) == len(quantizer.codebook) or not is_mendable(quantizer):
                raise FloatingPointError(f"{found}; lower the learning rates")
            quantizer.mend(broken, host.rows(name), generator(host.seed, iteration, "mend", name))
            reset_moments(raw_optimizer(trainer), codebook_group(name), broken)
            log.warning("%s (%s); mended", found, _numbers(broken.tolist()))


def _numbers(rows: list[int]) -> str:
    shown = ", ".join(map(str, rows[:5]))
    return f"rows {shown}{', …' * (len(rows) > 5)}"
