"""Density control with a budget: where the photos have edges, along the longest axis."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.data.edges import edge_strength
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.edit import append_rows, keep_rows
from nsvq_lightning.training.host import SplatHost
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.replicas import check_replicas
from nsvq_lightning.training.schedule import Phase

from .densification import Densification
from .growth_rules import GrowthRules, add_observed, budget_at, draw_rows, lowest_share, split_longest

__all__ = ["BudgetedGrowth"]

log = logging.getLogger(__name__)

GRADIENTS, VIEWS, EDGES = "gradient_sum", "view_count", "edge_sum"

IDLE = 0.01
"""Growth is idle if it adds at most this share of what it may add, or of what there is."""


class BudgetedGrowth(Densification):
    """Splits splats where the photos have edges, up to a budget: fewer splats for the same quality.

    During warm-up each view adds, in its own backward pass, the absolute screen-space gradient of every splat (AbsGS,
    Ye et al. 2024) and its blending weight times the strength of the photo's edges. At the scheduled iterations as many
    splats as the budget allows are drawn, in proportion to their edge weight, from those whose gradient reaches a
    threshold, and each is split along its longest axis (Improved-GS, Deng et al. 2025). Transparent splats are pruned,
    and opacities reset. Growth ends with the warm-up phase, or ends that phase early if hardly any splat needs to be
    split; non-finite splats are dropped in every phase.

    Args:
        growth: All thresholds, intervals and limits.
        budget: How many splats the scene is to have in the end; None for the module's
            (:class:`nsvq_lightning.callbacks.SplatBudget`).
        overshoot: Growth may reach this many times the budget: more than 1 is for a run that selects the best of them
            afterwards (:class:`nsvq_lightning.callbacks.OpacitySelection`).
        finite_every: Iterations between two searches for non-finite splats; a step whose loss is not finite always
            causes one.

    Raises:
        ValueError: ``budget`` is below ``growth.min_splats``, ``overshoot`` below 1, or ``finite_every`` below 1.

    Example:
        >>> from nsvq_lightning.callbacks import BudgetedGrowth, standard
        >>> callbacks = standard(density=BudgetedGrowth(budget=100_000))  # --callbacks.density=BudgetedGrowth ...
        >>> [callback.budget for callback in callbacks if isinstance(callback, BudgetedGrowth)]
        [100000]
    """

    tables: ClassVar[tuple[str, ...]] = (GRADIENTS, VIEWS, EDGES)
    limit_name: ClassVar[str] = "the budget"

    def __init__(
        self,
        growth: GrowthRules = GrowthRules(),  # noqa: B008  frozen
        budget: int | None = None,
        overshoot: float = 2.0,
        finite_every: int = 100,
    ) -> None:
        super().__init__(finite_every)
        if budget is not None and budget < growth.min_splats:
            raise ValueError(f"budget must be at least min_splats={growth.min_splats}, got {budget}")
        if not overshoot >= 1.0:
            raise ValueError(f"overshoot must be at least 1, got {overshoot}")
        self.growth = growth
        self.budget = budget
        self.overshoot = overshoot
        self._idle = 0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit; reject strategies that would lose the replaced parameters.

        Raises:
            ValueError: The strategy wraps the module in ``DistributedDataParallel``.
        """
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._idle = 0

    def state_dict(self) -> dict[str, Any]:
        """The last iteration acted on, and for how long growth has been idle."""
        return {**super().state_dict(), "idle": self._idle}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there."""
        super().load_state_dict(state_dict)
        self._idle = state_dict["idle"]

    def limit(self, host: SplatHost) -> int:
        """How many splats growth may reach.

        Raises:
            ValueError: Neither the callback nor the module has a budget.
        """
        budget = host.splat_budget if self.budget is None else self.budget
        if budget is None:
            raise ValueError(
                "growth needs a budget: list SplatBudget before it (--callbacks.budget=SplatBudget), or set "
                "--callbacks.density.budget to a number of splats"
            )
        return int(self.overshoot * budget)

    def ask(self, host: SplatHost, iteration: int, batch: Any) -> None:
        """Ask for absolute gradients and edge weights during warm-up."""
        growing = host.schedule.phase_at(iteration) is Phase.WARMUP
        host.pixel_map = edge_strength(batch.image, batch.mask) if growing else None

    def has_asked(self, host: SplatHost) -> bool:
        """Whether a map of edges was asked for."""
        return host.pixel_map is not None

    def add(self, tables: Sequence[Tensor], render: Render, micro_batches: int) -> None:
        """Add a view's absolute gradients and edge weights, and count it."""
        if render.observed is None or render.observed.grad is None:
            return
        height, width = render.alpha.shape
        # Gradient accumulation divides the loss by the number of micro-batches; each is a separate view here.
        size = width * micro_batches, height * micro_batches
        gradients, views, edges = tables
        add_observed(gradients, views, edges, render.observed.grad, render.radii, *size)

    def act(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        """Split, prune and reset when due."""
        rules, schedule = self.growth, host.schedule
        if schedule.phase_at(iteration) is not Phase.WARMUP:
            return
        if rules.first_prune and iteration == schedule.iteration(rules.first_prune):
            self.prune(trainer, host, host.splats.opacities.sigmoid() < rules.first_opacity, rules.min_splats)
        last = schedule.ends[Phase.WARMUP]
        times = schedule.density_times(rules.start + rules.every, round(last / schedule.scale), rules.every)
        if iteration in times:
            room, added = self._grow(trainer, host, iteration)
            pruned = 0
            if iteration != times[-1]:
                pruned = self.prune(
                    trainer, host, host.splats.opacities.sigmoid() < rules.min_opacity, rules.min_splats
                )
            check_replicas(trainer, "growth")
            log.debug("iteration %d: +%d -%d splats, now %d", iteration, added, pruned, len(host.splats))
            self._idle = self._idle + 1 if added <= IDLE * min(room, len(host.splats)) else 0
            if self._idle >= rules.patience > 0:
                host.schedule = replace(schedule, saved=schedule.saved + last - iteration)
                log.info(
                    "iteration %d: growth ends with %d splats, as hardly any needs to be split; the run will be %d "
                    "iterations shorter",
                    iteration,
                    len(host.splats),
                    last - iteration,
                )
        resets = schedule.reset_times(rules.reset_last, rules.reset_every)
        if iteration in resets:
            self.reset_opacities(trainer, host, rules.reset_opacity)
            check_replicas(trainer, "the opacity reset")
        if iteration in (reset + schedule.interval(rules.recovery) for reset in resets[: rules.recoveries]):
            self.prune(trainer, host, lowest_share(host.splats.opacities, rules.recovery_share), rules.min_splats)

    @torch.no_grad()
    def _grow(self, trainer: Trainer, host: SplatHost, iteration: int) -> tuple[int, int]:
        """Split as many splats as the budget allows; returns how many that was, and were. Resets the statistics."""
        splats, rules, schedule = host.splats, self.growth, host.schedule
        gradients, views, edges = (splats.add_table(name) for name in self.tables)
        statistic = gradients / views.clamp(min=1)
        reference = iteration / schedule.scale
        late = reference > rules.full
        weight = statistic if late else edges
        threshold = rules.late_threshold if late else rules.grad_threshold
        candidates = torch.where(statistic >= threshold, weight, torch.zeros_like(weight))
        room = budget_at((reference - rules.start) / (rules.full - rules.start), self.limit(host)) - len(splats)
        divided = draw_rows(candidates, room, generator(host.seed, iteration, "grow"))
        before = len(splats)
        parents = RawSplats(*(tensor.detach()[divided] for tensor in splats.raw()))
        append_rows(splats, raw_optimizer(trainer), split_longest(parents)._asdict())
        keep_rows(splats, raw_optimizer(trainer), torch.cat([~divided, divided.new_ones(len(splats) - before)]))
        for name in self.tables:
            splats.add_table(name).zero_()
        return room, len(splats) - before
