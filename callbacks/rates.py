"""Learning rates that fall towards the end of a run."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.schedule import Phase, next_iteration

from .hosted import HostedCallback

__all__ = ["RateDecay"]


class RateDecay(HostedCallback):
    """Lets all learning rates but that of the positions, which have their own, fall in the last iterations of a run.

    They fall from their value to ``final`` times it, linearly in the logarithm.

    Args:
        final: Factor at the end of the run; 1 leaves the rates alone.
        start: Iteration of the reference run at which they begin to fall; None for the start of fine-tuning.

    Raises:
        ValueError: ``final`` is not in (0, 1], or ``start`` is negative.

    Example:
        >>> from nsvq_lightning.callbacks import RateDecay, standard
        >>> callbacks = standard(rate_decay=RateDecay(final=0.1))  # --callbacks.rate_decay.final=0.1
        >>> [callback.final for callback in callbacks if isinstance(callback, RateDecay)]
        [0.1]
    """

    def __init__(self, final: float = 1.0, start: int | None = None) -> None:
        if not 0.0 < final <= 1.0:
            raise ValueError(f"final must be above 0 and at most 1, got {final}")
        if start is not None and start < 0:
            raise ValueError(f"start must be at least 0, got {start}")
        self.final = final
        self.start = start

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Scale the rates of this iteration."""
        if self.final == 1.0:
            return
        host, iteration = as_host(pl_module), next_iteration(trainer)
        ends = host.schedule.ends
        start = ends[Phase.QUANTIZE] if self.start is None else self.start * host.schedule.scale
        end = ends[Phase.FINETUNE]
        progress = min(max((iteration - start) / max(end - start, 1), 0.0), 1.0)
        if progress > 0.0:
            for group in raw_optimizer(trainer).param_groups:
                if group["name"] != "means":
                    host.scale_rate(group["name"], self.final**progress)
