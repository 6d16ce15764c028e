"""Which codes are replaced and by what (paper, section 3.1): decisions only; the codebook's owner edits it."""

from __future__ import annotations

import torch
from torch import Tensor

from nsvq_lightning.quantize.kmeans import draw_far_rows
from nsvq_lightning.quantize.nearest import nearest

__all__ = ["choose_replacements", "copy_codes", "inactive_codes", "split_codes"]


def inactive_codes(usage: Tensor, window: Tensor | int, threshold: float) -> Tensor:
    """Mask ``[K]`` of the codes hit in fewer than ``threshold`` of the ``window`` iterations; none in an empty window.

    Raises:
        ValueError: ``threshold`` is not in [0, 1].
    """
    if not 0.0 <= threshold <= 1.0:
        raise ValueError(f"threshold is a share of the iterations and must be in [0, 1], got {threshold}")
    return usage < threshold * window


def choose_replacements(active: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """``count`` active codes in random order; none is taken twice before all have been taken once.

    Args:
        active: Active codes, as indices ``[A]`` or vectors ``[A, D]``, A > 0.
        count: Number of codes to replace.
        generator: Source of the permutations.
    """
    rounds = -(-count // len(active))
    order = [torch.randperm(len(active), generator=generator, device=generator.device) for _ in range(rounds)]
    return active[torch.cat(order)[:count].to(active.device)]


def copy_codes(active: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """New codes ``[count, D]`` by the paper's rule: random picks of the active codes ``[A, D]``, plus noise of 1e-12.

    In float32 the noise rarely changes a value, so a copy gets rows only once training has moved it.
    """
    copies = choose_replacements(active, count, generator)
    noise = torch.randn(count, active.shape[1], generator=generator, device=generator.device)
    return copies + 1e-12 * noise.to(active)


def split_codes(active: Tensor, rows: Tensor, count: int, jitter: float, generator: torch.Generator) -> Tensor:
    """New codes next to the active ones with the largest distortion, each placed where it takes over rows at once.

    For each far row x that is drawn (:func:`~nsvq_lightning.quantize.kmeans.draw_far_rows`), its code c is split: the
    new code c + jitter · (x − c) lies that fraction of the way from c to x. So codes are split in proportion to their
    share of the distortion.

    Args:
        active: Active codes ``[A, D]``, A > 0.
        rows: Rows of the scene ``[N, D]``.
        count: Number of new codes wanted.
        jitter: In (0, 1]: near 0 a copy of the code, at 1 the row itself.
        generator: Source of the draw.

    Returns:
        New codes ``[count, D]``; fewer if fewer rows differ from their code.
    """
    far = rows[draw_far_rows(rows, active, count, generator)]
    return active[nearest(far, active)].lerp(far, jitter)
