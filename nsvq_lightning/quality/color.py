"""Colour correction of a rendered picture to its photo, for metrics that disregard exposure."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["color_corrected"]

ROUNDS = 5
DARK, BRIGHT = 0.5 / 255, 1 - 0.5 / 255
"""Values beyond which a pixel is clipped, so that it says nothing about the map of colours."""


def color_corrected(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """The image with the quadratic map of its colours that brings it nearest to the photo.

    This is the usual correction before metrics where photos differ in exposure (Mildenhall et al. 2022; NerfBaselines
    and gsplat report it as ``cc_psnr``): each channel becomes a polynomial of degree two in all three, by least squares
    over the pixels that are not clipped, five times over, each time clamped to [0, 1].

    Args:
        image: ``[H, W, 3]`` in [0, 1].
        photo: ``[H, W, 3]`` in [0, 1].
        mask: Which pixels count ``[H, W]`` bool; None if all do. The others are corrected, too.

    Returns:
        ``[H, W, 3]`` in [0, 1], of the image's dtype.
    """
    colors, target = image.reshape(-1, 3).double(), photo.reshape(-1, 3).double()
    counting = torch.ones_like(colors[:, 0], dtype=torch.bool) if mask is None else mask.reshape(-1)
    seen = counting[:, None] & (target >= DARK) & (target <= BRIGHT)
    for _ in range(ROUNDS):
        red, green, blue = colors.unbind(1)
        terms = torch.stack(
            [red * red, red * green, red * blue, green * green, green * blue, blue * blue, red, green, blue], 1
        )
        terms = torch.cat([terms, torch.ones_like(terms[:, :1])], 1)
        unclipped = seen & (colors >= DARK) & (colors <= BRIGHT)
        corrected = []
        for channel in range(3):
            rows = unclipped[:, channel]
            normal = terms[rows].T @ terms[rows]
            # A picture of few colours leaves coefficients open; the pseudo-inverse takes the smallest.
            weights = torch.linalg.pinv(normal, hermitian=True) @ (terms[rows].T @ target[rows, channel])
            corrected.append(terms @ weights if bool(rows.any()) else colors[:, channel])
        colors = torch.stack(corrected, 1).clamp(0, 1)
    return colors.reshape(image.shape).to(image.dtype)
