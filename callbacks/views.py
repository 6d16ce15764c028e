"""Several views in one step, late in a run."""

from __future__ import annotations

import logging
from typing import Any

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.schedule import Phase, next_iteration

from .hosted import HostedCallback

__all__ = ["ViewsPerStep"]

log = logging.getLogger(__name__)


class ViewsPerStep(HostedCallback):
    """Accumulates the gradients of several views in each step from some iteration on.

    Early on many steps matter more than exact ones; later the noise of single views is what keeps a scene from settling
    (Improved-GS, arXiv 2508.12313, takes 5 and then 20 views). An iteration is a step, so one of ``views`` views takes
    about that many times as long.

    Args:
        views: Views of each process in a step; 1 changes nothing.
        start: Iteration of the reference run from which on; None for the start of fine-tuning. The change waits until
            the number of views so far is a multiple of ``views``.

    Raises:
        ValueError: ``views`` is below 1, or ``start`` is negative.

    Example:
        >>> from nsvq_lightning.callbacks import ViewsPerStep, standard
        >>> callbacks = [*standard(), ViewsPerStep(views=5)]  # --trainer.callbacks+=ViewsPerStep
        >>> callbacks[-1].views
        5
    """

    def __init__(self, views: int = 1, start: int | None = None) -> None:
        if views < 1:
            raise ValueError(f"views must be at least 1, got {views}")
        if start is not None and start < 0:
            raise ValueError(f"start must be at least 0, got {start}")
        self.views = views
        self.start = start
        self._before: int | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Remember how many views a step has by the trainer's own setting."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._before = trainer.accumulate_grad_batches

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Change the number of views when it is time, between two steps."""
        views = self.views * (self._before or 1)
        if views == trainer.accumulate_grad_batches:
            return
        schedule = as_host(pl_module).schedule
        start = schedule.ends[Phase.QUANTIZE] + 1 if self.start is None else schedule.iteration(self.start)
        if next_iteration(trainer) >= start and batch_idx % views == 0:
            trainer.accumulate_grad_batches = views
            log.info("iteration %d: %d views a step from now on", next_iteration(trainer), views)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Give the trainer back its own setting."""
        if self._before is not None:
            trainer.accumulate_grad_batches = self._before
