"""The degree of the spherical harmonics grows during the run."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.schedule import next_iteration

from .hosted import HostedCallback

__all__ = ["ShDegreeSchedule"]


class ShDegreeSchedule(HostedCallback):
    """Starts with SH degree 0 and adds a degree every ``every`` iterations, up to that of the splats.

    Args:
        every: Iterations of the reference run between two degrees (the paper's 1000).

    Raises:
        ValueError: ``every`` is below 1.

    Example:
        >>> from nsvq_lightning.callbacks import ShDegreeSchedule
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> degrees = ShDegreeSchedule(every=2000)  # --callbacks.sh_degree.every=2000
        >>> [Schedule(total=4500).sh_degree_at(iteration, degrees.every, 3) for iteration in (1, 200, 400, 600, 800)]
        [0, 1, 2, 3, 3]
    """

    def __init__(self, every: int = 1000) -> None:
        if every < 1:
            raise ValueError(f"every must be at least 1 iteration, got {every}")
        self.every = every

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Set the degree of the iteration that starts."""
        host = as_host(pl_module)
        degree = host.schedule.sh_degree_at(next_iteration(trainer), self.every, host.splats.sh_degree)
        # A run that starts from a trained scene keeps its degree.
        host.active_sh_degree = max(degree, host.active_sh_degree)
