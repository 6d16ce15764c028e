"""Budgeted growth: its settings, and its decisions as functions of parameters and statistics."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.rendering.reference import rotation_matrices, times_vectors
from nsvq_lightning.splats.splats import RawSplats

__all__ = ["GrowthRules", "add_observed", "budget_at", "draw_rows", "lowest_share", "split_longest"]

CHILD_OFFSET = 1.35
"""Distance of a child from its parent's centre, in units of the parent's longest axis (Improved-GS, section 3.2)."""
CHILD_LENGTH = 0.55
"""Longest axis of a child over that of its parent, before the factor of all axes."""
CHILD_WIDTH = 0.893
"""Other axes of a child over those of its parent: √(1 - 0.45²), the width of an ellipsoid at 0.45 of its length."""
CHILD_OPACITY = 0.6
"""Opacity of a child over that of its parent."""


@dataclass(frozen=True)
class GrowthRules:
    """Settings of budgeted growth (Improved-GS, arXiv 2508.12313, on the absolute gradients of arXiv 2404.10484).

    Iterations are those of the reference run; :class:`~nsvq_lightning.training.schedule.Schedule` scales them.

    Attributes:
        start: Iteration at which growth may begin.
        full: Iteration at which the number of splats may reach the budget; between the two it may grow with the root of
            the time. From here on the gradient itself is a splat's weight.
        every: Interval of growth.
        grad_threshold: A splat may be split where its absolute screen-space gradient (in normalised device
            coordinates), averaged over the views that saw it, reaches this.
        late_threshold: The same after ``full``.
        min_opacity: Splats with a lower opacity are pruned at each growth but the last.
        first_prune: Iteration at which opacities below ``first_opacity`` are pruned once; 0 for never.
        first_opacity: See ``first_prune``.
        reset_every: Interval of opacity resets.
        reset_last: Last opacity reset.
        reset_opacity: Opacities are reset to at most this.
        recovery: Iterations after a reset at which those with the lowest opacity are pruned.
        recoveries: After how many resets, from the first, that is done.
        recovery_share: Share of the splats that this prunes.
        patience: After so many times at which there is room, but hardly a splat over the threshold, the warm-up phase
            ends; 0 for never.
        min_splats: A pruning that would leave fewer splats is skipped with a warning.

    Raises:
        ValueError: A setting is out of range.

    Example:
        >>> from nsvq_lightning.callbacks import BudgetedGrowth, GrowthRules
        >>> BudgetedGrowth(GrowthRules(every=200)).growth.every  # --callbacks.density.growth.every=200
        200
    """

    start: int = 500
    full: int = 14_500
    every: int = 100
    grad_threshold: float = 3e-4
    late_threshold: float = 2e-4
    min_opacity: float = 0.005
    first_prune: int = 300
    first_opacity: float = 0.02
    reset_every: int = 3000
    reset_last: int = 12_000
    reset_opacity: float = 0.05
    recovery: int = 300
    recoveries: int = 2
    recovery_share: float = 0.2
    patience: int = 5
    min_splats: int = 10

    def __post_init__(self) -> None:
        for name in ("every", "reset_every", "recovery", "min_splats"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("start", "first_prune", "recoveries", "patience", "grad_threshold", "late_threshold"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        if self.full <= self.start:
            raise ValueError(f"growth must be full after its start={self.start}, got full={self.full}")
        for name in ("min_opacity", "first_opacity", "reset_opacity"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if not 0.0 <= self.recovery_share < 1.0:
            raise ValueError(f"recovery_share must be in [0, 1), got {self.recovery_share}")


def add_observed(
    gradients: Tensor, views: Tensor, weights: Tensor, observed: Tensor, radii: Tensor, width: int, height: int
) -> None:
    """Add what one view has observed to the statistics ``[N]`` of the splats that it saw, in place.

    Args:
        gradients: Sum over the views of the norm of the two absolute sums, in normalised device coordinates, in which
            an image is 2 wide and 2 high.
        views: Number of views.
        weights: Sum over the views of the edge weight, divided by the mean of those in the view that are positive.
        observed: Gradient of ``Render.observed``: Σ |∂L/∂x|, Σ |∂L/∂y| per pixel, Σ weight · edge strength ``[N, 3]``.
        radii: Radius on the screen ``[N]``, 0 for splats that were not seen.
        width: Image width in pixels.
        height: Image height in pixels.
    """
    if kernels_for(observed) == "cpu":
        from nsvq_lightning.rendering.cpu.statistics import add_observed as add_observed_cpu

        add_observed_cpu(gradients, views, weights, observed, radii, (0.5 * width, 0.5 * height))
        return
    seen = (radii > 0).to(observed)
    edges = observed[:, 2].clamp_min(0)
    mean = edges.sum() / (edges > 0).sum().clamp_min(1)
    gradients.add_(torch.hypot(observed[:, 0] * (0.5 * width), observed[:, 1] * (0.5 * height)) * seen)
    views.add_(seen)
    weights.add_(edges / mean.clamp_min(torch.finfo(edges.dtype).tiny) * seen)


def budget_at(progress: float, budget: int) -> int:
    """How many splats there may be at ``progress`` (0 to 1) of the growth: budget · √progress."""
    return int(budget * math.sqrt(min(max(progress, 0.0), 1.0)))


def draw_rows(weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Mask ``[N]`` of ``count`` rows drawn without replacement in proportion to their weight; never one of weight 0.

    The ``count`` largest of log weight + Gumbel noise are such a sample (Efraimidis and Spirakis 2006): one draw per
    row, whatever is chosen.

    Args:
        weight: Weight of each row ``[N]``, not negative; with fewer positive ones than ``count``, all those.
        count: How many to draw.
        generator: Source of the draws, on the CPU.
    """
    uniform = torch.rand(weight.shape[0], generator=generator, dtype=torch.float64)
    tiny = torch.finfo(torch.float64).tiny
    key = weight.detach().double().cpu().log() - (-uniform.clamp_min(tiny).log()).clamp_min(tiny).log()
    chosen = torch.zeros(weight.shape[0], dtype=torch.bool)
    count = min(max(count, 0), int((weight > 0).sum()))
    chosen[key.argsort(descending=True, stable=True)[:count]] = True
    return chosen.to(weight.device)


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
    return RawSplats(*(torch.cat(two) for two in zip(*pair, strict=True)))


def lowest_share(opacities: Tensor, share: float) -> Tensor:
    """Mask ``[N]`` of the ``share`` of the splats with the lowest opacity; ties go to the first."""
    mask = torch.zeros_like(opacities, dtype=torch.bool)
    mask[opacities.argsort(stable=True)[: int(share * opacities.shape[0])]] = True
    return mask
