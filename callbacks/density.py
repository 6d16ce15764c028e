"""Adaptive density control of the warm-up and prune phases (Kerbl et al. 2023, section 5), and the base of its kind."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor

from nsvq_lightning.compression.importance import most_contributing
from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.rendering.reference import rotation_matrices, times_vectors
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.distributed import check_replicas, sum_over_processes
from nsvq_lightning.training.edit import append_rows, keep_rows, replace_attribute, reset_moments
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.memory_estimate import say_footprint
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.scene_access import train_contributions
from nsvq_lightning.training.schedule import Phase, next_iteration

from .base import FiniteSearch, StepCallback, keep_finite_splats

__all__ = [
    "Densification",
    "DensityControl",
    "DensityRules",
    "add_view",
    "clone_mask",
    "limit_growth",
    "lower_opacities",
    "prune_mask",
    "screen_gradient",
    "split",
    "split_mask",
]


@dataclass(frozen=True)
class DensityRules:
    """Settings of adaptive density control (Kerbl et al. 2023, section 5) and the prune phase (paper, section 3.4).

    Iterations are those of the reference run of 45 000; :class:`~nsvq_lightning.training.schedule.Schedule` scales
    them.

    Attributes:
        start: First iteration that clones and splits.
        last: Last iteration that clones and splits.
        every: Interval of cloning and splitting.
        grad_threshold: A splat is cloned or split where the norm of its screen-space gradient (in normalised device
            coordinates), averaged over the views that saw it, reaches this.
        dense_fraction: Splats up to this share of the extent are cloned, larger ones split.
        children: Splats that a split leaves in place of its parent.
        shrink: Children are smaller than their parent by this factor.
        min_opacity: Splats with a lower opacity are pruned.
        huge_fraction: Splats larger than this share of the extent are pruned.
        huge_after: Huge splats are pruned only after this iteration.
        reset_every: Interval of opacity resets.
        reset_last: Last opacity reset.
        reset_opacity: Opacities are reset to at most this.
        white_reset: Iteration of one more reset on a white background; 0 for none.
        prune_start: First pruning of the prune phase.
        prune_last: Last pruning of the prune phase.
        prune_every: Interval of pruning in the prune phase; 0 never prunes.
        min_splats: A pruning that would leave fewer splats is skipped with a warning.

    Raises:
        ValueError: A setting is out of range.

    Example:
        >>> from nsvq_lightning.callbacks import DensityControl, DensityRules
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> rules = DensityControl(DensityRules(every=200)).rules  # --callbacks.density.rules.every=200
        >>> Schedule(total=22_500).density_times(rules.start, rules.last, rules.every)[:3]
        (300, 400, 500)
    """

    start: int = 600
    last: int = 14_900
    every: int = 100
    grad_threshold: float = 2e-4
    dense_fraction: float = 0.01
    children: int = 2
    shrink: float = 1.6
    min_opacity: float = 0.005
    huge_fraction: float = 0.1
    huge_after: int = 3000
    reset_every: int = 3000
    reset_last: int = 12_000
    reset_opacity: float = 0.01
    white_reset: int = 500
    prune_start: int = 16_000
    prune_last: int = 20_000
    prune_every: int = 1000
    min_splats: int = 10

    def __post_init__(self) -> None:
        for name in ("start", "every", "reset_every", "children", "min_splats"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("white_reset", "prune_every", "huge_after", "grad_threshold", "dense_fraction"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        for name in ("min_opacity", "reset_opacity"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        for name in ("shrink", "huge_fraction"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)}")


def screen_gradient(grad: Tensor, width: int, height: int) -> Tensor:
    """Norm ``[N]`` of the gradient of projected centres in normalised device coordinates.

    An image is 2 wide and 2 high in these coordinates, so pixel gradients are scaled by 0.5·width and 0.5·height.

    Args:
        grad: Gradient of the loss ``[N, 2]`` by the centre in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
    """
    return torch.hypot(grad[:, 0] * (0.5 * width), grad[:, 1] * (0.5 * height))


def add_view(sums: Tensor, views: Tensor, grad: Tensor, radii: Tensor, width: int, height: int) -> None:
    """Add :func:`screen_gradient` of one view to ``sums [N]`` and 1 to ``views [N]``, where a splat was seen.

    Args:
        sums: Sum of the norms, changed in place.
        views: Number of views, changed in place.
        grad: Gradient of the loss ``[N, 2]`` by the centre in pixels.
        radii: Radius on the screen ``[N]`` in pixels, 0 for splats that were not seen.
        width: Image width in pixels.
        height: Image height in pixels.
    """
    if kernels_for(grad) == "cpu":
        from nsvq_lightning.rendering.cpu.statistics import add_view as add_view_cpu

        add_view_cpu(sums, views, grad, radii, (0.5 * width, 0.5 * height))
        return
    seen = (radii > 0).to(sums)
    sums.add_(screen_gradient(grad, width, height) * seen)
    views.add_(seen)


def largest_scale(scales: Tensor) -> Tensor:
    """Longest axis ``[N]`` in scene units of log-scales ``[N, 3]``."""
    return scales.amax(1).exp()


def clone_mask(statistic: Tensor, scales: Tensor, extent: float, rules: DensityRules) -> Tensor:
    """Which splats ``[N]`` to clone: those with a large screen-space gradient that are small.

    Args:
        statistic: Mean screen-space gradient ``[N]``.
        scales: Log-scales ``[N, 3]``.
        extent: Extent of the scene, scene units.
        rules: Thresholds.
    """
    return (statistic >= rules.grad_threshold) & (largest_scale(scales) <= rules.dense_fraction * extent)


def split_mask(statistic: Tensor, scales: Tensor, extent: float, rules: DensityRules) -> Tensor:
    """Which splats ``[N]`` to split: those with a large gradient that are large; arguments as in :func:`clone_mask`."""
    return (statistic >= rules.grad_threshold) & (largest_scale(scales) > rules.dense_fraction * extent)


def prune_mask(opacities: Tensor, scales: Tensor, extent: float, rules: DensityRules, huge: bool) -> Tensor:
    """Which splats ``[N]`` to prune: nearly transparent ones, and with ``huge`` also huge ones.

    Args:
        opacities: Opacity logits ``[N]``.
        scales: Log-scales ``[N, 3]``.
        extent: Extent of the scene, scene units.
        rules: Thresholds.
        huge: Whether to prune huge splats, too.
    """
    prune = opacities.sigmoid() < rules.min_opacity
    if huge:
        prune |= largest_scale(scales) > rules.huge_fraction * extent
    return prune


def limit_growth(mask: Tensor, statistic: Tensor, added: Tensor, budget: int) -> Tensor:
    """The splats of ``mask [N]`` with the largest statistic that together add at most ``budget``; in ties, the first.

    Args:
        mask: Splats that want to grow.
        statistic: Mean screen-space gradient ``[N]``.
        added: Splats that each would add ``[N]`` int64, not negative: 1 for a clone, children - 1 for a split.
        budget: Splats that may be added.
    """
    candidates = mask.nonzero()[:, 0]
    if int(added[candidates].sum()) <= budget:
        return mask
    order = statistic[candidates].argsort(descending=True, stable=True)
    candidates = candidates[order]
    limited = torch.zeros_like(mask)
    limited[candidates[added[candidates].cumsum(0) <= budget]] = True
    return limited


def split(parents: RawSplats, rules: DensityRules, generator: torch.Generator) -> RawSplats:
    """Children ``[children · M, ...]`` of ``M`` parents: centres drawn from each parent's own Gaussian, axes shrunk.

    Args:
        parents: Raw attributes of the parents; all first children come before all second ones.
        rules: Number of children and shrinking factor.
        generator: Source of the draws, on the CPU.
    """
    count = parents.means.shape[0] * rules.children
    repeated = RawSplats(*(t.repeat(rules.children, *([1] * (t.dim() - 1))) for t in parents))
    draws = torch.randn(count, 3, generator=generator).to(parents.means)
    offsets = times_vectors(rotation_matrices(repeated.quats), repeated.scales.exp() * draws)
    return repeated._replace(means=repeated.means + offsets, scales=repeated.scales - math.log(rules.shrink))


def lower_opacities(opacities: Tensor, ceiling: float) -> Tensor:
    """Opacity logits ``[N]``, limited to opacity ``ceiling``."""
    return opacities.clamp(max=math.log(ceiling / (1.0 - ceiling)))


log = logging.getLogger(__name__)


class Densification(StepCallback, ABC):
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
        if iteration == 0 or not self._once.first_time(iteration):
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
        rules: DensityRules = DensityRules(),
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
