"""Opacity regularisation of the prune phase."""

from __future__ import annotations

import math
from typing import Any

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.schedule import Phase, next_iteration

from .hosted import HostedCallback

__all__ = ["OpacityRegularization"]


class OpacityRegularization(HostedCallback):
    """Adds λ · Σ opacity to the loss during the prune phase, so that unneeded splats fade and are pruned.

    The term is a sum over the splats (paper, section 3.4), so its strength grows with their number. A shorter run has
    fewer iterations for splats to fade, and a proportionally larger λ
    (:meth:`nsvq_lightning.training.schedule.Schedule.strength`).

    Args:
        weight: λ of the reference run.

    Raises:
        ValueError: λ is negative or not finite.

    Example:
        >>> from nsvq_lightning.callbacks import OpacityRegularization
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> regularization = OpacityRegularization(weight=2e-7)  # --callbacks.opacity.weight=2e-7
        >>> Schedule(total=4500).strength(regularization.weight)  # λ of a tenth of the paper's run
        2e-06
    """

    def __init__(self, weight: float = 1e-7) -> None:
        if not (math.isfinite(weight) and weight >= 0):
            raise ValueError(f"weight must be finite and at least 0, got {weight}")
        self.weight = weight

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Turn the term on and off."""
        host = as_host(pl_module)
        pruning = host.schedule.phase_at(next_iteration(trainer)) is Phase.PRUNE
        host.opacity_weight = host.schedule.strength(self.weight) if pruning else 0.0
