"""The base of density control: statistics of the views in, more or fewer splats out."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor

from nsvq_lightning.compression.importance import most_contributing
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.training.edit import keep_rows, replace_attribute, reset_moments
from nsvq_lightning.training.footprint import say_footprint
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.replicas import check_replicas, sum_over_processes
from nsvq_lightning.training.schedule import Phase, next_iteration
from nsvq_lightning.training.train_views import train_contributions

from .density_rules import lower_opacities
from .finite import FiniteSearch, keep_finite_splats
from .latch import LatchedCallback

__all__ = ["Densification"]

log = logging.getLogger(__name__)


class Densification(LatchedCallback, ABC):
    """Base of the callbacks that add and remove splats by what the views of the last iterations have shown.

    A subclass names its side tables, asks the module for what a view must bring (:meth:`ask`), adds a view to the
    tables (:meth:`add`), and acts on them after a complete iteration (:meth:`act`). This class sees to the rest: the
    views of all processes are added, those whose splats have changed in between are left out with a warning, and
    non-finite splats are dropped in every phase.

    Args:
        finite_every: Iterations between two searches for non-finite splats; a step whose loss is not finite always
            causes one.

    Raises:
        ValueError: ``finite_every`` is below 1.
    """

    tables: ClassVar[tuple[str, ...]]
    """Names of the side tables ``[N]`` of the splats that hold the statistics."""
    limit_name: ClassVar[str]
    """What sets :meth:`limit`, for messages."""

    def __init__(self, finite_every: int = 100) -> None:
        super().__init__()
        self._search = FiniteSearch(finite_every, "finite_every")
        self._warned = False

    @abstractmethod
    def limit(self, host: SplatHost) -> int | None:
        """How many splats there may be; None without a limit."""

    @abstractmethod
    def ask(self, host: SplatHost, iteration: int, batch: Any) -> None:
        """Ask the module for what the statistics need of the view ``batch``, or for nothing."""

    @abstractmethod
    def has_asked(self, host: SplatHost) -> bool:
        """Whether the view of this step counts."""

    @abstractmethod
    def add(self, tables: Sequence[Tensor], render: Render, micro_batches: int) -> None:
        """Add a rendered view to the tables ``[N]``, in place.

        Args:
            tables: In the order of :attr:`tables`.
            render: The rendering, after its backward pass.
            micro_batches: Views in a step of this process, by which the loss was divided.
        """

    @abstractmethod
    def act(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        """Do what is due after a complete iteration; the same on every process."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Reject strategies that would lose the replaced parameters.

        Raises:
            ValueError: The strategy wraps the module in ``DistributedDataParallel``.
        """
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._warned = False
        # A strategy that follows replaced parameters has this attribute.
        follows = getattr(trainer.strategy, "follows_replaced_parameters", False)
        if stage == "fit" and isinstance(trainer.strategy, DDPStrategy) and not follows:
            raise ValueError(
                "DistributedDataParallel binds gradient hooks to the parameters it finds at the start: after the first "
                "clone it crashes or silently stops averaging. Train with --trainer.strategy=view_parallel, or on one "
                "device (--trainer.devices=1)"
            )

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say on a CPU how much memory the run will take, and remove splats if there are already too many.

        Raises:
            ValueError: There are more than :meth:`limit`, and the trainer has no data module whose views show which
                ones matter.
        """
        super().on_train_start(trainer, pl_module)
        host = as_host(pl_module)
        limit = self.limit(host)
        if limit is None:
            return
        if host.device.type == "cpu" and trainer.is_global_zero:
            say_footprint(trainer, limit)
        self._keep_at_most(trainer, host, limit)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Ask for what the statistics need while they are needed."""
        self.ask(as_host(pl_module), next_iteration(trainer), batch)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Add the statistics of this view; after a complete step do what is due."""
        host = as_host(pl_module)
        if self.has_asked(host):
            self._observe(trainer, host, self._view(trainer, host, outputs or {}))
        iteration = trainer.global_step
        if iteration == 0 or not self._latch.first_time(iteration):
            return
        if self._search.is_due(trainer):
            keep_finite_splats(trainer, host)
        self.act(trainer, host, iteration)

    def _keep_at_most(self, trainer: Trainer, host: SplatHost, limit: int) -> None:
        """Remove splats if there are more than ``limit``: those that contribute least to the train views."""
        count = len(host.splats)
        if count <= limit:
            return
        if host.phase > Phase.PRUNE:
            log.warning(
                "%s=%d comes too late for %d splats with codebooks; all are kept", self.limit_name, limit, count
            )
            return
        kept = most_contributing(train_contributions(trainer, host), limit)
        keep_rows(host.splats, raw_optimizer(trainer), kept)
        check_replicas(trainer, "the limit of splats")
        log.info("kept %d of %d splats, those that contribute most to the train views", limit, count)

    @torch.no_grad()
    def prune(self, trainer: Trainer, host: SplatHost, mask: Tensor, min_splats: int) -> int:
        """Remove the splats of ``mask [N]``, unless fewer than ``min_splats`` would be left; returns how many."""
        count = int(mask.sum())
        if len(host.splats) - count < min_splats:
            log.warning(
                "iteration %d: pruning %d of %d splats would leave fewer than min_splats=%d; skipped. Opacities or "
                "scales have collapsed: lower the learning rates, or check the camera poses",
                trainer.global_step,
                count,
                len(host.splats),
                min_splats,
            )
            return 0
        keep_rows(host.splats, raw_optimizer(trainer), ~mask)
        return count

    @torch.no_grad()
    def reset_opacities(self, trainer: Trainer, host: SplatHost, ceiling: float) -> None:
        """Lower all opacities to at most ``ceiling``, and forget their moments."""
        optimizer = raw_optimizer(trainer)
        replace_attribute(host.splats, optimizer, "opacities", lower_opacities(host.splats.opacities, ceiling))
        reset_moments(optimizer, "opacities")

    def _view(self, trainer: Trainer, host: SplatHost, outputs: Mapping[str, Any]) -> Render | None:
        """The step's rendering; None if there is none, its loss is not finite, or the splats have changed since."""
        splats, render, loss = host.splats, outputs.get("render"), outputs.get("late_loss")
        if loss is not None and not math.isfinite(loss.read()):
            return None
        if render is None or (len(render.radii) == len(splats) and outputs.get("edits", splats.edits) == splats.edits):
            return render
        if not self._warned:
            self._warned = True
            log.warning(
                "iteration %d: another callback has removed or added splats (%d were rendered, now %d) before density "
                "control took the statistics of the view; such views are left out from now on. List that callback "
                "after %s to count all views",
                trainer.global_step,
                len(render.radii),
                len(splats),
                type(self).__name__,
            )
        return None

    def _observe(self, trainer: Trainer, host: SplatHost, render: Render | None) -> None:
        """Add one view (of each process) to the statistics; None, for a view without a loss, adds nothing."""
        tables = [host.splats.add_table(name) for name in self.tables]
        micro_batches = trainer.accumulate_grad_batches
        if trainer.world_size == 1:
            if render is not None:
                self.add(tables, render, micro_batches)
            return
        own = tables[0].new_zeros(len(tables), len(tables[0]))
        if render is not None:
            self.add(own.unbind(), render, micro_batches)
        # A collective: every process must call it, even with nothing to add.
        for table, total in zip(tables, sum_over_processes(trainer, own), strict=True):
            table.add_(total)
