"""One Adam with a named parameter group per attribute and codebook, and the position's learning rate."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import nn
from torch.optim import Adam, Optimizer

from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import Splats

# Prefix of a codebook's parameter group, before the name of its attribute.
CODEBOOK_PREFIX = "codebook_"
# Adam's epsilon in 3D Gaussian splatting: gradients of a splat are far below PyTorch's default of 1e-8.
EPS = 1e-15


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of the recipe (docs/recipe.md); ``configs/paper.yaml`` has those of 3D Gaussian splatting.

    Attributes:
        means: Position at the start, times the extent of the scene or, with ``by_distance``, the splat's distance.
        means_final: Position at the end of the decay, times the same.
        scales: Log-scale.
        quats: Quaternion.
        opacities: Opacity logit.
        sh0: Constant colour coefficient.
        shN: Higher colour coefficients.
        codebook_factor: Factor from the rate of an attribute to that of its codebook.
        scale_with_views: For B views in a step, multiply these rates by √B and adapt Adam's other settings
            (:func:`adapt_to_views`); otherwise use the rates for one view.
        by_distance: Positions move in proportion to a splat's distance from the nearest train camera, so that all move
            alike in the photos, however far the cameras went.

    Raises:
        ValueError: A rate is negative or not finite, or a rate of the position is 0.
    """

    means: float = ATTRIBUTES["means"].rate
    means_final: float = 5.6e-6
    scales: float = ATTRIBUTES["scales"].rate
    quats: float = ATTRIBUTES["quats"].rate
    opacities: float = ATTRIBUTES["opacities"].rate
    sh0: float = ATTRIBUTES["sh0"].rate
    shN: float = ATTRIBUTES["shN"].rate
    codebook_factor: float = 1.0
    scale_with_views: bool = False
    by_distance: bool = True

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive = name.startswith("means")  # interpolated in the logarithm
            if not (math.isfinite(value) and (value > 0 if positive else value >= 0)):
                raise ValueError(f"rate {name} must be finite and {'above' if positive else 'at least'} 0, got {value}")


def position_lr(iteration: int, extent: float, rates: LearningRates, decay_end: int) -> float:
    """Learning rate of the positions at a 1-based iteration.

    Log-linear from ``means · extent`` to ``means_final · extent`` at ``decay_end``, then constant.
    """
    t = min(iteration / decay_end, 1.0)
    return extent * math.exp((1.0 - t) * math.log(rates.means) + t * math.log(rates.means_final))


def codebook_group(attribute: str) -> str:
    """Name of the parameter group of an attribute's codebook."""
    return f"{CODEBOOK_PREFIX}{attribute}"


def param_groups(
    splats: Splats, quantizers: Mapping[str, nn.Module], rates: LearningRates, extent: float
) -> list[dict[str, Any]]:
    """One group per parameter, named after its attribute (``means``) or its codebook (``codebook_scales``).

    Codebooks are included from the start: Adam skips them while they have no gradient, and a checkpoint of any phase
    has the same groups.

    Args:
        splats: The splats.
        quantizers: Quantizer by attribute, each with a parameter ``codebook``.
        rates: Learning rates.
        extent: Extent of the scene, scene units; the position's rate is relative to it.
    """
    books = {codebook_group(name): quantizer.codebook for name, quantizer in quantizers.items()}
    parameters = splats.attributes() | books
    return [{"params": [each], "lr": group_lr(name, rates, extent), "name": name} for name, each in parameters.items()]


def group_lr(name: str, rates: LearningRates, extent: float) -> float:
    """Initial learning rate of the parameter group ``name``."""
    attribute = name.removeprefix(CODEBOOK_PREFIX)
    rate: float = getattr(rates, attribute)
    if attribute != name:
        return rate * rates.codebook_factor
    return rate * extent if name == "means" else rate


def adapt_to_views(optimizer: Optimizer, rates: LearningRates, views: int) -> float:
    """Set betas and epsilon of all groups, for example after a checkpoint has replaced them.

    With ``rates.scale_with_views``, for a step of B views with averaged gradients: √B·lr, 1 - B·(1 - β), ε / √B.
    B views in one step then move parameters like B steps of a view each, in mean and in variance (Malladi et al. 2022,
    "On the SDEs and Scaling Rules for Adaptive Gradient Algorithms").

    Args:
        optimizer: Adam with named groups.
        rates: Learning rates for a step of one view.
        views: Views in a step, over all processes and micro-batches.

    Returns:
        By what the learning rates of such a step are multiplied.

    Raises:
        ValueError: No views, or so many that a beta would not be positive.
    """
    scale = views if rates.scale_with_views else 1
    betas = tuple(1 - scale * (1 - beta) for beta in (0.9, 0.999))
    if min(*betas, views) <= 0:
        raise ValueError(
            f"cannot train on {views} views a step, as Adam's first beta would be {betas[0]:.2g}: train fewer at once, "
            "or leave --model.rates.scale_with_views off"
            if views > 0
            else f"{views} views a step: accumulate_grad_batches must be above 0"
        )
    for group in optimizer.param_groups:
        group["betas"], group["eps"] = betas, EPS / math.sqrt(scale)
    return math.sqrt(scale)


def build_adam(groups: list[dict[str, Any]]) -> Adam:
    """Adam of the paper over ``groups``: default betas, epsilon 1e-15, no weight decay; fused where torch can."""
    fused = all(group["params"][0].device.type in ("cpu", "cuda") for group in groups)
    return Adam(groups, eps=EPS, fused=fused or None)


def find_group(optimizer: Optimizer, name: str) -> dict[str, Any]:
    """The parameter group ``name``.

    Raises:
        ValueError: There is none.
    """
    groups = {group.get("name"): group for group in optimizer.param_groups}
    if name not in groups:
        raise ValueError(f"the optimiser has no parameter group {name!r}, only: {', '.join(map(str, groups))}")
    return groups[name]


def check_groups(optimizers: Sequence[Optimizer], quantized: Iterable[str]) -> None:
    """Check that a module's optimiser has the groups that callbacks edit by name.

    Args:
        optimizers: Those of the trainer.
        quantized: Attributes with a codebook.

    Raises:
        ValueError: A group is missing or has several parameters, or there is not exactly one optimiser.
    """
    sizes = {group.get("name"): len(group["params"]) for each in optimizers for group in each.param_groups}
    missing = [name for name in (*ATTRIBUTES, *map(codebook_group, quantized)) if sizes.get(name) != 1]
    if missing or len(optimizers) != 1:
        raise ValueError(
            "splats need one optimiser with a group of one parameter for each attribute and codebook, named after it; "
            f"there are {len(optimizers)} optimisers, without groups for: {', '.join(missing) or 'none'}. Build the "
            "groups with nsvq_lightning.training.optim.param_groups"
        )
