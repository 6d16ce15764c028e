"""Density control: the paper's settings, and its decisions as functions of parameters and statistics."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.rendering.reference import rotation_matrices, times_vectors
from nsvq_lightning.splats.splats import RawSplats

__all__ = [
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
