"""Pixels that do not count: no loss and no metric depends on them.

Both pictures are black there, as the structural similarity takes them to be beyond their borders, and means are over
the pixels that count.
"""

from __future__ import annotations

from torch import Tensor

__all__ = ["kept", "mean_of_kept"]


def kept(image: Tensor, mask: Tensor | None) -> Tensor:
    """An image ``[H, W, 3]`` that is 0 where its mask ``[H, W]`` is; itself without a mask."""
    return image if mask is None else image * mask[..., None]


def mean_of_kept(mean: Tensor, mask: Tensor | None) -> Tensor:
    """The mean over the pixels that count, from the mean over all pixels of something that is 0 elsewhere."""
    return mean if mask is None else mean * (mask.numel() / mask.sum())
