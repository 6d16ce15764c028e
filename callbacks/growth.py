"""Density control with a budget: how many splats there are to be, and splits where the photos have edges."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import torch
from lightning.pytorch import Trainer
from torch import Tensor

from nsvq_lightning.data.images import edges_of
from nsvq_lightning.data.scene import Scene, View, detailed_pixels, stretch
from nsvq_lightning.io.nsvq.precision import Precision
from nsvq_lightning.random import draw_rows, generator, top_rows
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.rendering.reference import rotation_matrices
from nsvq_lightning.splats.attributes import QUANTIZABLE, attribute_dims, codebook_bits
from nsvq_lightning.splats.splats import RawSplats, detached, times_vectors
from nsvq_lightning.top_level import log
from nsvq_lightning.training import distributed, run_scene
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase, Schedule

from .base import SplatCallback
from .density import KEPT, Densification, reset_opacities
from .settings import AT_LEAST_1, Count, NonNegative, Opacity, Positive, Share, Whole

# Fewest splats of a scene.
MIN_BUDGET = 1000


class SplatBudget(SplatCallback):
    """Decides how many splats the scene is to have, and says why.

    :class:`~nsvq_lightning.callbacks.BudgetedGrowth` grows up to it,
    :class:`~nsvq_lightning.callbacks.SplatSelection` removes what is above it. Without a number of splats or bytes it
    comes from the photos.

    Raises:
        ValueError: Splats and bytes are both given.
    """

    quality: Positive = 1.0
    """Times the default for the photos (:func:`nsvq_lightning.callbacks.growth.splats_for_photos`)."""
    splats: Count | None = None
    """Number of splats."""
    bytes: Count | None = None
    """Size of the file at level ``compact``."""
    start: NonNegative = 0.8
    """Points to start with, as a share of the number of splats: those of SfM, and as many more as that takes from the
    flow between photos (:func:`nsvq_lightning.data.dense_start.dense_points`); 0 for those of SfM. A fiftieth more lies
    far around them (:func:`~nsvq_lightning.data.dense_start.far_points`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.splats is not None and self.bytes is not None:
            raise ValueError("splats and bytes both say how large the scene is to be: give one of them")

    def before_fit(self, trainer: Trainer, module: SplatModule) -> None:
        """Set the module's budget, and how many points it starts with.

        Raises:
            ValueError: The budget in bytes has no room for codebooks; or it is to come from photos, and the trainer has
                no data module with a scene.
        """
        budget, reason = self.splats or 0, "as asked"
        if self.bytes is not None:
            codebooks = {name: quantizer.codebook.shape for name, quantizer in module.quantizers.items()}
            stored = module.splats.sh_degree, module.storage.precision, module.rate_strength, module.values_per_splat
            budget = splats_for_bytes(self.bytes, codebooks, *stored)
            reason = f"for a file of {self.bytes} bytes at level compact"
        elif self.splats is None:
            advice = "give a number of splats (--splats) or bytes (--bytes)"
            scene = run_scene.needed_scene(trainer, "a budget from the photos needs them", advice)
            detail = distributed.on_first_process(trainer, lambda: detailed_pixels(scene))
            far = stretch(scene)
            budget = splats_for_photos(len(scene.train), detail, far * self.quality)
            shown = f"{len(scene.train)} photos with {detail:,.0f} detailed pixels each support"
            walk = f", {far:.1f} times as each shows little of the scene" if far > 1 else ""
            reason = f"quality {self.quality:g} times what {shown}{walk}; --quality changes it"
        module.splat_budget, module.first_points = budget, round(self.start * budget)
        log.info(f"budget: {budget} splats, {reason}")


# Distance of a child from its parent's centre, in units of the parent's longest axis (Improved-GS, section 3.2).
CHILD_OFFSET = 1.35
# Longest axis of a child over that of its parent, before the factor of all axes.
CHILD_LENGTH = 0.55
# Other axes of a child over those of its parent: √(1 - 0.45²), the width of an ellipsoid at 0.45 of its length.
CHILD_WIDTH = 0.893
# Opacity of a child over that of its parent.
CHILD_OPACITY = 0.6


def split_longest(parents: RawSplats) -> RawSplats:
    """Two children for each parent, all first ones before all second ones, along its longest axis.

    They lie on either side of the parent's centre and together cover about what it covered.

    Args:
        parents: Raw attributes of the ``M`` parents.
    """
    scales = parents.scales.exp()
    longest, axis = scales.max(1, keepdim=True)
    along = torch.zeros_like(scales).scatter(1, axis, CHILD_OFFSET * longest)
    offsets = times_vectors(rotation_matrices(parents.quats), along)
    shrink = torch.full_like(scales, math.log(CHILD_WIDTH)).scatter(1, axis, math.log(CHILD_LENGTH))
    opacities = torch.logit(CHILD_OPACITY * parents.opacities.sigmoid())
    child = parents._replace(scales=parents.scales + shrink, opacities=opacities)
    pair = (child._replace(means=parents.means + side * offsets) for side in (1, -1))
    return RawSplats(*map(torch.cat, zip(*pair, strict=True)))


# Growth is idle if it adds less than this share of what it may add, or of what there is.
IDLE = 0.01


class BudgetedGrowth(Densification):
    """Splits splats where the photos have edges, up to a budget: fewer splats for the same quality.

    During warm-up each view adds, in its own backward pass, the absolute screen-space gradient of every splat (AbsGS,
    Ye et al. 2024) and its blending weight times the strength of the photo's edges. At the scheduled iterations as many
    splats as the budget allows are drawn, in proportion to their edge weight, from those whose gradient reaches a
    threshold, and each is split along its longest axis (Improved-GS, Deng et al. 2025). Transparent splats are pruned,
    and opacities reset if asked. Growth ends with the warm-up phase, or ends that phase early if hardly any splat needs
    to be split; non-finite splats are dropped in every phase.

    Iterations are those of the reference run; :class:`~nsvq_lightning.training.schedule.Schedule` scales them.

    Raises:
        ValueError: ``budget`` is below ``min_splats``, or ``full`` is not after ``start``.
    """

    tables = ("gradient_sum", "view_count", "edge_sum")
    limit_name = "the budget"

    budget: int | None = None
    """How many splats the scene is to have in the end; None for the module's
    (:class:`nsvq_lightning.callbacks.SplatBudget`)."""
    overshoot: Annotated[float, AT_LEAST_1] = 2.0
    """Growth may reach this many times the budget: more than 1 is for a run that selects the best of them afterwards
    (:class:`nsvq_lightning.callbacks.SplatSelection`)."""
    start: Whole = 0
    """Iteration at which growth may begin."""
    full: int = 6200
    """Iteration at which the number of splats may reach the budget; between the two it may grow with the root of the
    time. From here on the gradient itself is a splat's weight."""
    every: Count = 100
    """Interval of growth."""
    grad_threshold: NonNegative = 3e-4
    """A splat may be split where its absolute screen-space gradient (in normalised device coordinates), averaged over
    the views that saw it, reaches this."""
    late_threshold: NonNegative = 2e-4
    """The same after ``full``."""
    min_opacity: Opacity = 0.005
    """Splats with a lower opacity are pruned at each growth but the last."""
    first_prune: Whole = 300
    """Iteration at which opacities below ``first_opacity`` are pruned once; 0 for never."""
    first_opacity: Opacity = 0.02
    """See ``first_prune``."""
    reset_every: Count = 2600
    """Interval of opacity resets."""
    reset_last: int = 0
    """Last opacity reset; 0 for none. Long runs need them (docs/recipe.md)."""
    reset_photos: Whole = 40
    """None with fewer train photos, or of a walk, or without a scene: what resets clear away would not come back in its
    place."""
    reset_opacity: Opacity = 0.05
    """Opacities are reset to at most this."""
    recovery: Count = 600
    """Iterations after a reset at which those with the lowest opacity are pruned."""
    recovery_share: Share = 0.2
    """Share of the splats that this prunes."""
    patience: Whole = 5
    """After so many times at which there is room, but hardly a splat over the threshold, the warm-up phase ends; 0 for
    never."""
    state = ("idle",)
    idle = 0
    """How many times in a row hardly a splat had to be split."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.full <= self.start:
            raise ValueError(f"growth must be full after its start={self.start}, got full={self.full}")
        if self.budget is not None and self.budget < self.min_splats:
            raise ValueError(f"budget must be at least min_splats={self.min_splats}, got {self.budget}")

    def tell(self, module: SplatModule) -> None:
        """Tell how splats grow."""
        module.stretches = self.stretches

    def stretches(self, schedule: Schedule, first: int, budget: int) -> list[tuple[float, int]]:
        """Shares of a run, and how many splats it has in them on average: while it grows, fully grown, at the budget.

        Args:
            schedule: Phases of the run.
            first: Points at the start, of which no more become splats than growth leaves room for.
            budget: Splats at the end, after their selection.
        """
        warmup = schedule.share(schedule.warmup_end)
        full = min(schedule.share(self.full), warmup)
        most = round(self.overshoot * budget)
        first = min(first, round(KEPT * most))
        grows = round(first + (most - first) * 2 / 3)  # along the root of the time
        return [(full, grows), (warmup - full, most), (1 - warmup, budget)]

    def limit(self, module: SplatModule) -> int:
        """How many splats growth may reach.

        Raises:
            ValueError: Neither the callback nor the module has a budget.
        """
        budget = self.budget or module.splat_budget
        if budget is None:
            raise ValueError(
                "growth needs a budget: list SplatBudget before it (--callbacks.budget=SplatBudget), or set "
                "--callbacks.density.budget to a number of splats"
            )
        return int(self.overshoot * budget)

    def ask(self, module: SplatModule, iteration: int, batch: View) -> bool:
        """Ask for absolute gradients and edge weights during warm-up."""
        growing = module.schedule.phase_at(iteration) is Phase.WARMUP
        module.pixel_weights = None
        if growing:
            scene = run_scene.scene_of(module.trainer)
            view = batch.smaller(1) if batch.image.is_floating_point() else batch  # in bytes
            edges = edges_of(view.image, view.mask) if scene is None else scene.images.edges(batch.index)
            module.pixel_weights = edges.strength(batch.image.device)
        return growing

    def gradients(self, render: Render) -> Tensor | None:
        """The absolute gradients and edge weights."""
        return None if render.absgrad is None else render.absgrad.grad

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether splats are split after this iteration."""
        schedule = module.schedule
        last = round(schedule.reference(schedule.ends[Phase.WARMUP]))
        times = schedule.density_times(self.start + self.every, last, self.every)
        return schedule.phase_at(iteration) is Phase.WARMUP and iteration in times

    def act(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Split, prune and reset when due."""
        schedule = module.schedule
        if schedule.phase_at(iteration) is not Phase.WARMUP:
            return
        if self.first_prune and iteration == schedule.iteration(self.first_prune):
            self.prune(module, module.splats.opacities.sigmoid() < self.first_opacity)
        if self.is_due(module, iteration):
            self._split_and_prune(module, iteration)
            if module.schedule is not schedule:  # the phase has ended
                return
        resets = schedule.reset_times(self.reset_last, self.reset_every)
        recoveries = [reset + schedule.interval(self.recovery) for reset in resets]
        if iteration in (*resets, *recoveries) and _around(run_scene.scene_of(trainer)) >= self.reset_photos:
            if iteration in resets:
                reset_opacities(module, self.reset_opacity)
            if iteration in recoveries:
                transparency = -module.splats.opacities
                self.prune(module, top_rows(transparency, int(self.recovery_share * len(transparency))))

    def _split_and_prune(self, module: SplatModule, iteration: int) -> None:
        """Split, prune unless it is the last time, and end the phase where splitting has become idle."""
        schedule = module.schedule
        last = schedule.ends[Phase.WARMUP]
        room, added = self._grow(module, iteration)
        again = any(self.is_due(module, later) for later in range(iteration + 1, last + 1))
        pruned = self.prune(module, module.splats.opacities.sigmoid() < self.min_opacity) if again else 0
        distributed.check_replicas(module.trainer, "growth")
        log.debug(f"iteration {iteration}: +{added} -{pruned} splats, now {len(module.splats)}")
        self.idle = self.idle + 1 if added < IDLE * min(room, len(module.splats)) else 0
        if self.idle >= self.patience > 0:
            module.schedule = replace(schedule, saved=schedule.saved + last - iteration)
            log.info(
                f"iteration {iteration}: growth ends with {len(module.splats)} splats, as hardly any needs to be "
                f"split; the run will be {last - iteration} iterations shorter"
            )

    @torch.no_grad()
    def _grow(self, module: SplatModule, iteration: int) -> tuple[int, int]:
        """Split as many splats as the budget allows; returns how many that was, and were. Resets the statistics."""
        splats, schedule = module.splats, module.schedule
        gradients, views, edges = (splats.add_table(name) for name in self.tables)
        statistic = gradients / views.clamp(min=1)
        reference = schedule.reference(iteration)
        weight, threshold = (statistic, self.late_threshold) if reference > self.full else (edges, self.grad_threshold)
        candidates = torch.where(statistic >= threshold, weight, 0)
        progress = min(max((reference - self.start) / (self.full - self.start), 0.0), 1.0)
        room = int(self.limit(module) * math.sqrt(progress)) - len(splats)
        divided = draw_rows(candidates, room, generator(module.seed, iteration, "grow"))
        return room, self.divide(module, divided, split_longest(detached(splats).take(divided)))


def _around(scene: Scene | None) -> int:
    """Train photos around a place; 0 of a walk, whose places are in few."""
    return len(scene.train) if scene and stretch(scene) < 2 else 0


def splats_for_photos(photos: int, detail: float, quality: float = 1.0) -> int:
    """A default for the number of splats: quality · 0.165 · ∛photos · detail.

    Detail asks for splats; more photos of it show more of its sides, and support more without fitting the noise.

    Args:
        photos: Number of train photos.
        detail: Detailed pixels of a photo (:func:`nsvq_lightning.data.scene.detailed_pixels`).
        quality: Factor.
    """
    return max(MIN_BUDGET, round(quality * 0.165 * math.cbrt(photos) * detail))


def splats_for_bytes(
    size: int, books: Mapping[str, Sequence[int]], sh_degree: int, precision: Precision, strength: float, most: float
) -> int:
    """Number of splats in a file of level ``compact``, within a tenth; a fifth where codes are chosen by their rate.

    Args:
        size: Bytes of the file.
        books: Codes and dimension of each codebook by attribute.
        sh_degree: Of the splats.
        precision: Largest errors of the file.
        strength: Of the choice of codes by rate and distortion; 0 without it.
        most: Numbers of a codebook for each splat; infinite without a limit.

    Raises:
        ValueError: There is no room for splats beside the codebooks.
    """
    usual = Precision()
    position, opacity = precision.position / usual.position, precision.opacity / usual.opacity
    # Position and opacity of a splat take 22 to 25 bits on the measured scenes.
    bits = 23.5 - math.log2(position**3 * opacity)
    # What remains of codes and codebooks where codes are chosen by rate and distortion, as measured.
    coded = 1 / (1 + 0.25 * strength)
    # A number without a codebook takes 5.8 to 7.6 bits after 2500 iterations, one of shN 2.8 to 3, as measured; with an
    # error from 8 times as large to a 16th, the logarithm is right to a quarter of a bit.
    for name in QUANTIZABLE:
        levels = 1 + (63, 7)[name == "shN"] * usual.of(name) / precision.of(name)
        bits += (name not in books) * math.log2(levels) * attribute_dims(sh_degree)[name]
    splats = size
    for _ in range(8):  # codebooks depend on the splats, and these on what codebooks and the header, 2 KB, leave
        placed = {name: (min(count, max(1.0, most * splats / dim)), dim) for name, (count, dim) in books.items()}
        all_books, codes = codebook_bits(placed)
        splats = max(1, int((8 * (size - 2048) - coded * all_books) / (bits + coded * codes)))
    if splats < MIN_BUDGET:
        raise ValueError(f"{size} bytes leave no room beside codebooks: allow more, or --model.codebooks=0.5k")
    return splats
