"""Adaptive density control in the warm-up and prune phases; the search for non-finite splats."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from lightning.pytorch import Trainer
from torch import Tensor

from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.edit import append_rows, keep_rows
from nsvq_lightning.training.host import SplatHost
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.replicas import check_replicas
from nsvq_lightning.training.schedule import Phase

from .densification import Densification
from .density_rules import (
    DensityRules,
    add_view,
    clone_mask,
    limit_growth,
    prune_mask,
    split,
    split_mask,
)

__all__ = ["DensityControl"]

log = logging.getLogger(__name__)

GRADIENTS, VIEWS = "gradient_sum", "view_count"
"""Side tables of the splats: sum of the screen-space gradient norms, and number of views that saw the splat."""


class DensityControl(Densification):
    """Clones, splits and prunes splats (Kerbl et al. 2023, section 5), and drops those that become NaN or infinite.

    During warm-up the norm of the screen-space gradient is averaged over the views that see a splat; at the scheduled
    iterations splats above the threshold are cloned or split, transparent and huge ones pruned, and opacities reset. In
    the prune phase transparent splats are pruned and none are added. Non-finite splats are dropped in every phase.

    Callbacks that remove or add splats may come before or after it. A view whose splats were changed before its step
    ended is left out of the statistics, with a warning: its norms no longer match the rows.

    Args:
        rules: All thresholds, intervals and limits.
        max_splats: Upper limit on the number of splats. If the scene starts with more, those that contribute most to
            the train views are kept; during growth, those with the largest statistic come first. None for no limit, as
            in the paper.
        finite_every: Iterations between two searches for non-finite splats; a step whose loss is not finite always
            causes one.

    Raises:
        ValueError: ``max_splats`` is below ``rules.min_splats``, or ``finite_every`` below 1.

    Example:
        >>> from nsvq_lightning.callbacks import DensityControl, standard
        >>> callbacks = standard(density=DensityControl(max_splats=200_000))  # --callbacks.density.max_splats=200000
        >>> [callback.max_splats for callback in callbacks if isinstance(callback, DensityControl)]
        [200000]
    """

    tables: ClassVar[tuple[str, ...]] = (GRADIENTS, VIEWS)
    limit_name: ClassVar[str] = "max_splats"

    def __init__(
        self,
        rules: DensityRules = DensityRules(),  # noqa: B008  frozen
        max_splats: int | None = None,
        finite_every: int = 100,
    ) -> None:
        super().__init__(finite_every)
        if max_splats is not None and max_splats < rules.min_splats:
            raise ValueError(f"max_splats must be at least min_splats={rules.min_splats}, got {max_splats}")
        self.rules = rules
        self.max_splats = max_splats

    def limit(self, host: SplatHost) -> int | None:
        """``max_splats``."""
        return self.max_splats

    def ask(self, host: SplatHost, iteration: int, batch: Any) -> None:
        """Ask for screen-space gradients while they are needed."""
        growing = host.schedule.phase_at(iteration) is Phase.WARMUP
        host.wants_screen_gradients = growing and iteration <= host.schedule.iteration(self.rules.last)

    def has_asked(self, host: SplatHost) -> bool:
        """Whether screen-space gradients are there."""
        return host.wants_screen_gradients

    def add(self, tables: Sequence[Tensor], render: Render, micro_batches: int) -> None:
        """Add the norms of a view's screen-space gradients, and count it."""
        if render.means2d.grad is None:
            return
        height, width = render.alpha.shape
        # Gradient accumulation divides the loss by the number of micro-batches; each is a separate view here.
        sums, views = tables
        add_view(sums, views, render.means2d.grad, render.radii, width * micro_batches, height * micro_batches)

    def act(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        """Clone, split, prune and reset when due."""
        phase = host.schedule.phase_at(iteration)
        if phase is Phase.WARMUP:
            self._warmup_step(trainer, host, iteration)
        elif phase is Phase.PRUNE:
            self._prune_step(trainer, host, iteration)

    def _warmup_step(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        rules, schedule = self.rules, host.schedule
        if iteration in schedule.density_times(rules.start, rules.last, rules.every):
            added = self._grow(trainer, host, iteration)
            huge = iteration > schedule.iteration(rules.huge_after)
            pruned = self._prune_marked(trainer, host, huge)
            check_replicas(trainer, "density control")
            log.debug("iteration %d: +%d -%d splats, now %d", iteration, added, pruned, len(host.splats))
        white = host.background == "white" and rules.white_reset and iteration == schedule.iteration(rules.white_reset)
        if white or iteration in schedule.reset_times(rules.reset_last, rules.reset_every):
            self.reset_opacities(trainer, host, rules.reset_opacity)
            check_replicas(trainer, "the opacity reset")

    def _prune_step(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        rules = self.rules
        if not rules.prune_every:
            return
        if iteration in host.schedule.times(rules.prune_start, rules.prune_last, rules.prune_every):
            pruned = self._prune_marked(trainer, host, huge=False)
            check_replicas(trainer, "pruning")
            level = logging.INFO if pruned else logging.DEBUG
            log.log(level, "iteration %d: pruned %d splats, %d remain", iteration, pruned, len(host.splats))

    @torch.no_grad()
    def _grow(self, trainer: Trainer, host: SplatHost, iteration: int) -> int:
        """Clone and split; returns how many splats were added. Resets the statistics."""
        splats, rules, optimizer = host.splats, self.rules, raw_optimizer(trainer)
        gradient_sum, views = splats.add_table(GRADIENTS), splats.add_table(VIEWS)
        statistic = gradient_sum / views.clamp(min=1)
        cloned = clone_mask(statistic, splats.scales, host.extent, rules)
        divided = split_mask(statistic, splats.scales, host.extent, rules)
        if self.max_splats is not None:
            added = torch.where(divided, rules.children - 1, 1)
            grown = limit_growth(cloned | divided, statistic, added, self.max_splats - len(splats))
            cloned, divided = cloned & grown, divided & grown
        before = len(splats)
        draws = generator(host.seed, iteration, "split")
        children = split(_rows(splats.raw(), divided), rules, draws)
        new = (torch.cat(pair) for pair in zip(_rows(splats.raw(), cloned), children, strict=True))
        append_rows(splats, optimizer, RawSplats(*new)._asdict())
        keep_rows(splats, optimizer, torch.cat([~divided, divided.new_ones(len(splats) - before)]))
        for table in (GRADIENTS, VIEWS):
            splats.add_table(table).zero_()
        return len(splats) - before

    def _prune_marked(self, trainer: Trainer, host: SplatHost, huge: bool) -> int:
        """Prune what the rules mark; returns how many splats were removed."""
        marked = prune_mask(host.splats.opacities, host.splats.scales, host.extent, self.rules, huge)
        return self.prune(trainer, host, marked, self.rules.min_splats)


def _rows(splats: RawSplats, mask: Tensor) -> RawSplats:
    return RawSplats(*(tensor.detach()[mask] for tensor in splats))
