"""Splats that are left out of one picture at random."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["dropped_out"]

ABSENT = -100.0
"""Opacity logit of a splat that is left out; no pixel sees it."""
LARGEST = 1.0 - 2.0**-16
"""Largest opacity that the others are raised to."""


def dropped_out(opacities: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Opacity logits ``[N]`` in which each splat is absent with probability ``share`` and the others σ / (1 - share).

    So the mean opacity of each splat stays (DropGaussian, Park et al. 2025, eq. 4). Absent splats get no gradient.

    Args:
        opacities: Opacity logits ``[N]``.
        share: In [0, 1).
        generator: Source of the draws, on the CPU.
    """
    present = (torch.rand(opacities.shape, generator=generator) >= share).to(opacities.device)
    raised = torch.logit((opacities.sigmoid() / (1.0 - share)).clamp_max(LARGEST))
    return torch.where(present, raised, torch.full_like(raised, ABSENT))
