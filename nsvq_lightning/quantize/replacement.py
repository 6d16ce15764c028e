"""Which codes are replaced and by which (paper, section 3.1): decisions only, the codebook is edited by its owner."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["choose_replacements", "inactive_codes"]


def inactive_codes(usage: Tensor, window: Tensor | int, threshold: float) -> Tensor:
    """Mask ``[K]`` of the codes hit in less than ``threshold`` of the ``window`` iterations; none in an empty window.

    Raises:
        ValueError: ``threshold`` is not in [0, 1].
    """
    if not 0.0 <= threshold <= 1.0:
        raise ValueError(f"threshold is a share of the iterations and must be in [0, 1], got {threshold}")
    return usage < threshold * window


def choose_replacements(active: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """``count`` active codes in random order; none is taken twice before all were taken once.

    Args:
        active: Active codes ``[A]``, A > 0.
        count: Codes to replace.
        generator: Source of the permutations.
    """
    rounds = -(-count // len(active))
    order = [torch.randperm(len(active), generator=generator, device=generator.device) for _ in range(rounds)]
    return active[torch.cat(order)[:count].to(active.device)]
