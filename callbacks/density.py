"""Adaptive density control of the warm-up and prune phases (Kerbl et al. 2023, section 5), and the base of its kind."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from lightning.pytorch import Trainer
from torch import Generator, Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.data.scene import View
from nsvq_lightning.random import draw_rows, generator, top_rows
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.rendering.reference import rotation_matrices
from nsvq_lightning.splats.splats import RawSplats, detached, times_vectors
from nsvq_lightning.top_level import log
from nsvq_lightning.training import distributed, row_ops, run_scene
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

from .base import SplatCallback, finite_search_is_due, keep_finite_splats
from .settings import Count, NonNegative, Opacity, Positive, Whole

# Share of the limit that is left where a run starts with more points, or with more splats than the limit. The others
# are added where they are missed: all that the limit allows, those that contribute most, were 1 dB worse.
KEPT = 0.7


class Densification(SplatCallback, ABC, kw_only=True):  # type: ignore[call-arg]  # of dataclass
    """Base of the callbacks that add and remove splats by what the views of the last iterations have shown.

    A subclass names its side tables, asks the module for what a view must bring (:meth:`ask`), adds a view to the
    tables (:meth:`gradients`), and acts on them after a complete iteration (:meth:`act`). This class sees to the rest:
    the views of all processes are added, those whose splats have changed in between are left out with a warning, and
    non-finite splats are dropped in every phase.
    """

    tables: ClassVar[tuple[str, ...]]
    """Names of the side tables ``[N]`` of the splats that hold the statistics."""
    limit_name: ClassVar[str]
    """What sets :meth:`limit`, for messages."""

    min_splats: Count = 10
    """A pruning that would leave fewer splats is skipped with a warning."""
    finite_every: Count = 100
    """Iterations between two searches for non-finite splats; a step whose loss is not finite always causes one."""
    passing = ("_warned",)
    _warned = _counts = False

    @abstractmethod
    def limit(self, module: SplatModule) -> int | None:
        """How many splats there may be; None without a limit."""

    @abstractmethod
    def ask(self, module: SplatModule, iteration: int, batch: View) -> bool:
        """Ask the module for what the statistics need of the view ``batch``; returns whether the view counts."""

    @abstractmethod
    def gradients(self, render: Render) -> Tensor | None:
        """The gradients of a rendering after its backward pass as :func:`add_view` takes them; None if it has none."""

    @abstractmethod
    def act(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Do what is due after a complete iteration; the same on every process."""

    def on_train_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Remove splats if there are already too many: those that are left are fewer, so that others can be added.

        Raises:
            ValueError: There are more than :meth:`limit`, and the trainer has no data module whose views show which
                ones matter.
        """
        limit, count = self.limit(module), len(module.splats)
        # Of points, which have no harmonics yet, all beyond the share are too many: they are placed anew by growth.
        if limit is None or count <= limit * (1 if trainer.global_step or module.active_sh_degree else KEPT):
            return
        if module.phase > Phase.PRUNE:
            log.warning(f"{self.limit_name}={limit} comes too late for {count} splats with codebooks; all are kept")
        else:
            weights = run_scene.train_contributions(trainer, module.scene).clamp_min(1e-12).sqrt()
            kept = draw_rows(weights, round(KEPT * limit), generator(module.seed, 0, "limit"))
            row_ops.keep_rows(module.splats, trainer.optimizers[0], kept)
            distributed.check_replicas(trainer, "the limit of splats")
            log.info(f"drew {len(module.splats)} of {count} splats by what they contribute to the train views")

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, batch: View, *args: Any) -> None:
        """Ask for what the statistics need while they are needed."""
        super().on_train_batch_start(trainer, module, batch, *args)
        self._counts = self.ask(module, trainer.global_step + 1, batch)

    def on_train_batch_end(self, trainer: Trainer, module: SplatModule, outputs: Any, *args: Any) -> None:
        """Add the statistics of this view; after a complete step do what is due."""
        if self._counts:
            self._observe(trainer, module, outputs or {})
        super().on_train_batch_end(trainer, module, outputs, *args)

    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Drop non-finite splats, then do what is due."""
        if finite_search_is_due(trainer, self.finite_every):
            keep_finite_splats(module)
        self.act(trainer, module, iteration)

    @torch.no_grad()
    def prune(self, module: SplatModule, mask: Tensor) -> int:
        """Remove the splats of ``mask [N]``, unless fewer than :attr:`min_splats` would be left; returns how many."""
        count = int(mask.sum())
        if count and len(module.splats) - count < self.min_splats:
            log.warning(
                f"iteration {module.trainer.global_step}: pruning {count} of {len(module.splats)} splats would leave "
                f"fewer than min_splats={self.min_splats}; skipped. Opacities or scales have collapsed: lower the "
                "learning rates, or check the camera poses"
            )
            return 0
        row_ops.keep_rows(module.splats, module.trainer.optimizers[0], ~mask)
        return count

    def _observe(self, trainer: Trainer, module: SplatModule, outputs: dict[str, Any]) -> None:
        """Add a view (of each process) to the statistics, unless its loss is not finite or its splats have changed."""
        splats = module.splats
        loss, render = outputs.get("late_loss"), outputs.get("render")
        if loss is not None and not math.isfinite(loss.read()):
            render = None
        # As many as were rendered may be others.
        edits = outputs.get("edits", splats.edits)
        if render is not None and (len(render.radii) != len(splats) or edits != splats.edits):
            if not self._warned:
                self._warned = True
                log.warning(
                    f"iteration {trainer.global_step}: another callback has removed or added splats "
                    f"({len(render.radii)} were rendered, now {len(splats)}) before density control took the "
                    "statistics of the view; such views are left out from now on. List that callback after "
                    f"{type(self).__name__} to count all views"
                )
            render = None
        tables = [splats.add_table(name) for name in self.tables]
        several = trainer.world_size > 1
        own = [torch.zeros_like(table) for table in tables] if several else tables
        gradients = None if render is None else self.gradients(render)
        if render is not None and gradients is not None:
            # Each micro-batch is a separate view here; the loss was divided by their number.
            height, width = (side * trainer.accumulate_grad_batches for side in render.alpha.shape)
            add_view(own, gradients, render.radii, width, height)
        if several:  # a collective: every process must call it, even with nothing to add
            for table, total in zip(tables, distributed.sum_over_processes(trainer, torch.stack(own)), strict=True):
                table.add_(total)

    def divide(self, module: SplatModule, divided: Tensor, new: RawSplats) -> int:
        """Put new splats in place of those of ``divided [N]``, and begin the statistics anew.

        Returns:
            How many splats there are more.
        """
        splats, optimizer, before = module.splats, module.trainer.optimizers[0], len(module.splats)
        row_ops.append_rows(splats, optimizer, new)
        row_ops.keep_rows(splats, optimizer, torch.cat([~divided, divided.new_ones(len(splats) - before)]))
        for name in self.tables:
            splats.add_table(name).zero_()
        return len(splats) - before


class DensityControl(Densification):
    """Clones, splits and prunes splats (Kerbl et al. 2023, section 5), and drops those that become NaN or infinite.

    During warm-up the norm of the screen-space gradient is averaged over the views that see a splat; at the scheduled
    iterations splats above the threshold are cloned or split, transparent and huge ones pruned, and opacities reset. In
    the prune phase (paper, section 3.2) transparent splats are pruned and none are added. Non-finite splats are dropped
    in every phase.

    Callbacks that remove or add splats may come before or after it. A view whose splats were changed before its step
    ended is left out of the statistics, with a warning: its norms no longer match the rows.

    Iterations are those of the reference run; :class:`~nsvq_lightning.training.schedule.Schedule` scales them.

    Raises:
        ValueError: ``max_splats`` is below ``min_splats``.
    """

    tables = ("gradient_sum", "view_count")
    limit_name = "max_splats"

    max_splats: int | None = None
    """Upper limit on the number of splats. Of more at the start, or about as many points, 0.7 of it are drawn by what
    they contribute to the train views; in growth, the largest statistic comes first. None for the budget (--splats)
    where there is one, and otherwise for no limit, as in the paper."""
    start: Count = 600
    """First iteration that clones and splits."""
    last: int = 14_900
    """Last iteration that clones and splits."""
    every: Count = 100
    """Interval of cloning and splitting."""
    grad_threshold: NonNegative = 2e-4
    """A splat is cloned or split where the norm of its screen-space gradient (in normalised device coordinates),
    averaged over the views that saw it, reaches this."""
    dense_fraction: NonNegative = 0.01
    """Splats up to this share of the extent are cloned, larger ones split."""
    shrink: Positive = 1.6
    """The two children of a split are smaller than their parent by this factor."""
    min_opacity: Opacity = 0.005
    """Splats with a lower opacity are pruned."""
    huge_fraction: Positive = 0.1
    """Splats larger than this share of the extent are pruned."""
    huge_after: Whole = 3000
    """Huge splats are pruned only after this iteration."""
    reset_every: Count = 3000
    """Interval of opacity resets."""
    reset_last: int = 12_000
    """Last opacity reset."""
    reset_opacity: Opacity = 0.01
    """Opacities are reset to at most this."""
    white_reset: Whole = 500
    """Iteration of one more reset on a white background; 0 for none."""
    prune_every: Whole = 1000
    """Interval of pruning in the prune phase; 0 never prunes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_splats is not None and self.max_splats < self.min_splats:
            raise ValueError(f"max_splats must be at least min_splats={self.min_splats}, got {self.max_splats}")

    def limit(self, module: SplatModule) -> int | None:
        """``max_splats``, or else the module's budget, if it has one."""
        return self.max_splats or module.splat_budget

    def ask(self, module: SplatModule, iteration: int, batch: View) -> bool:
        """Count the views of the warm-up phase; the gradients are there in any case."""
        return module.schedule.phase_at(iteration) is Phase.WARMUP and iteration <= module.schedule.iteration(self.last)

    def gradients(self, render: Render) -> Tensor | None:
        """The screen-space gradients."""
        return render.means2d.grad

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether splats are cloned, split and pruned or, in the prune phase, pruned after this iteration."""
        schedule = module.schedule
        phase = schedule.phase_at(iteration)
        if phase is Phase.WARMUP:
            return iteration in schedule.density_times(self.start, self.last, self.every)
        if phase is Phase.PRUNE and (every := self.prune_every):
            return iteration in schedule.times(schedule.warmup_end + every, schedule.prune_end, every)
        return False

    def act(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Clone, split, prune and reset when due."""
        schedule = module.schedule
        growing = schedule.phase_at(iteration) is Phase.WARMUP
        due = self.is_due(module, iteration)
        if due and growing:
            added = self._grow(module, iteration)
            pruned = self._prune(module, huge=iteration > schedule.iteration(self.huge_after))
            distributed.check_replicas(trainer, "density control")
            log.debug(f"iteration {iteration}: +{added} -{pruned} splats, now {len(module.splats)}")
        elif due:
            pruned = self._prune(module, huge=False)
            distributed.check_replicas(trainer, "pruning")
            say = log.info if pruned else log.debug
            say(f"iteration {iteration}: pruned {pruned} splats, {len(module.splats)} remain")
        on_white = module.background == "white" and self.white_reset > 0
        first = on_white and iteration == schedule.iteration(self.white_reset)
        if growing and (first or iteration in schedule.reset_times(self.reset_last, self.reset_every)):
            reset_opacities(module, self.reset_opacity)

    @torch.no_grad()
    def _grow(self, module: SplatModule, iteration: int) -> int:
        """Clone and split; returns how many splats were added. Resets the statistics."""
        splats = module.splats
        gradient_sum, views = (splats.add_table(name) for name in self.tables)
        statistic = gradient_sum / views.clamp(min=1)
        large = splats.scales.amax(1).exp() > self.dense_fraction * module.extent
        grown = statistic >= self.grad_threshold
        if (limit := self.limit(module)) is not None:
            grown &= top_rows(torch.where(grown, statistic, -torch.inf), max(0, limit - len(splats)))
        clones, parents = (detached(splats).take(grown & mask) for mask in (~large, large))
        children = split(parents, self.shrink, generator(module.seed, iteration, "split"))
        return self.divide(module, grown & large, RawSplats(*map(torch.cat, zip(clones, children, strict=True))))

    def _prune(self, module: SplatModule, *, huge: bool) -> int:
        """Prune transparent splats, and huge ones if asked for; returns how many."""
        splats = module.splats
        marked = splats.opacities.sigmoid() < self.min_opacity
        if huge:
            marked |= splats.scales.amax(1).exp() > self.huge_fraction * module.extent
        return self.prune(module, marked)


@torch.no_grad()
def reset_opacities(module: SplatModule, ceiling: float) -> None:
    """Lower all opacities to at most ``ceiling``, and forget their moments."""
    lowered = module.splats.opacities.clamp(max=math.log(ceiling / (1.0 - ceiling)))
    row_ops.replace_attribute(module.splats, "opacities", lowered)
    row_ops.reset_moments(module.trainer.optimizers[0], "opacities")
    distributed.check_replicas(module.trainer, "the opacity reset")


def add_view(tables: Sequence[Tensor], gradients: Tensor, radii: Tensor, width: int, height: int) -> None:
    """Add a view to the statistics ``[N]`` of the splats that it saw, in place.

    Args:
        tables: Sum over the views of the norm of the gradient in normalised device coordinates, in which an image is 2
            wide and 2 high; number of views; and, if there is a third one, sum over the views of the edge weight,
            divided by the mean of those in the view that are positive.
        gradients: Gradient of the loss by the centre in pixels ``[N, 2]``; with a table of edge weights that of
            ``Render.absgrad``: Σ |∂L/∂x|, Σ |∂L/∂y| per pixel, Σ weight · edge strength ``[N, 3]``.
        radii: Radius on the screen ``[N]`` in pixels, 0 for splats that were not seen.
        width: Image width in pixels.
        height: Image height in pixels.
    """
    factors = 0.5 * width, 0.5 * height
    if kernels_for(gradients) == "cpu":
        from nsvq_lightning.rendering.cpu.rasterizer import add_view as add_view_cpu

        add_view_cpu(tables, gradients, radii, factors)
        return
    sums, views, *weights = tables
    seen = (radii > 0).to(gradients)
    sums.add_(torch.hypot(gradients[:, 0] * factors[0], gradients[:, 1] * factors[1]) * seen)
    views.add_(seen)
    for total in weights:
        edges = gradients[:, 2].clamp_min(0)
        mean = edges.sum() / (edges > 0).sum().clamp_min(1)
        total.add_(edges / mean.clamp_min(torch.finfo(edges.dtype).tiny) * seen)


def split(parents: RawSplats, shrink: float, generator: Generator) -> RawSplats:
    """Two children for each of ``M`` parents ``[2 · M, ...]``: centres drawn from the parent's Gaussian, axes shrunk.

    Args:
        parents: Raw attributes of the parents; all first children come before all second ones.
        shrink: Children are smaller than their parent by this factor.
        generator: Source of the draws, on the CPU.
    """
    repeated = RawSplats(*(torch.cat([tensor, tensor]) for tensor in parents))
    draws = torch.randn(len(repeated.means), 3, generator=generator).to(parents.means)
    offsets = times_vectors(rotation_matrices(repeated.quats), repeated.scales.exp() * draws)
    return repeated._replace(means=repeated.means + offsets, scales=repeated.scales - math.log(shrink))
