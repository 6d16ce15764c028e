"""Rows far from a codebook, drawn at random: where new codes help most."""

from __future__ import annotations

import torch
from torch import Tensor

from nsvq_lightning.quantize.nearest import nearest

__all__ = ["draw_far_rows", "spread_rows"]

_ROUNDS = 3
"""A spread start doubles its rows this often."""


def draw_far_rows(rows: Tensor, codebook: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Numbers ``[count]`` of different rows, each drawn with a chance that grows with its squared distance to its code.

    This is the D² sampling of k-means++ (Arthur and Vassilvitskii 2007), many rows at a time and without replacement.

    Args:
        rows: Rows ``[N, D]``.
        codebook: Codes ``[K, D]``.
        count: Rows wanted; fewer come where fewer have a distance to their code.
        generator: Source of the draw.
    """
    squared = (rows - codebook[nearest(rows, codebook)]).square().sum(1).double()
    # The largest of w / e with e ~ Exp(1) are a draw without replacement with chances w (Efraimidis and Spirakis 2006).
    draws = torch.empty(len(rows), dtype=torch.float64, device=generator.device).exponential_(generator=generator)
    return (squared / draws.to(rows.device)).topk(min(count, int((squared > 0).sum()))).indices


def spread_rows(rows: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """``[count, D]`` of different rows ``[N, D]``, N ≥ count, that reach into all corners: a start for k-means.

    An eighth is a random sample; then each round draws as many far rows as there are already. Rows too close to those
    for their squared distance to be above 0 come last.
    """
    shuffled = torch.randperm(len(rows), generator=generator, device=generator.device).to(rows.device)
    chosen = shuffled[: -(-count // 2**_ROUNDS)]
    while len(chosen) < count:
        far = draw_far_rows(rows, rows[chosen], min(len(chosen), count - len(chosen)), generator)
        if len(far) == 0:
            rest = shuffled[~torch.isin(shuffled, chosen)]
            return rows[torch.cat([chosen, rest[: count - len(chosen)]])]
        chosen = torch.cat([chosen, far])
    return rows[chosen]
