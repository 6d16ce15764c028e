"""Random splats left out of training steps, so that no splat relies on a few photos."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.schedule import next_iteration

from .hosted import HostedCallback

__all__ = ["SplatDropout"]


class SplatDropout(HostedCallback):
    """Leaves out random splats in each training view; the others get more opaque (DropGaussian, Park et al. 2025).

    With few photos splats close to a camera are trained by that one alone. Where some are missing, those behind them
    get gradients, too. The share of missing splats grows linearly from 0 at the start of the run.

    Args:
        share: Share of the splats that is left out at ``end`` and later; 0 leaves all in.
        end: Iteration of the reference run until which the share grows; None for the end of the run.

    Raises:
        ValueError: ``share`` is not in [0, 1), or ``end`` is below 1.

    Example:
        >>> from nsvq_lightning.callbacks import SplatDropout, standard
        >>> callbacks = [*standard(), SplatDropout(share=0.05)]  # --trainer.callbacks+=SplatDropout
        >>> callbacks[-1].share
        0.05
    """

    def __init__(self, share: float = 0.0, end: int | None = None) -> None:
        if not 0.0 <= share < 1.0:
            raise ValueError(f"share must be at least 0 and below 1, got {share}")
        if end is not None and end < 1:
            raise ValueError(f"end must be at least 1, got {end}")
        self.share = share
        self.end = end

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Set the share of the iteration that starts."""
        host = as_host(pl_module)
        schedule = host.schedule
        end = schedule.total if self.end is None else schedule.iteration(self.end)
        host.dropout = self.share * min(1.0, next_iteration(trainer) / end)
