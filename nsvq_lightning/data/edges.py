"""Where photos have detail: the strength of their edges, and how many pixels have one."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.data.scene import Scene

__all__ = ["detailed_pixels", "edge_strength"]

HIGH_PASS = np.array([[-1, -1, -1], [-1, 8, -1], [-1, -1, -1]], np.float32)
"""Eight times a pixel less its neighbours."""
DETAIL = 20
"""High-pass value, of grey values up to 255, from which a pixel counts as detailed: well above the noise of a photo."""
SAMPLE = 32
"""Photos that are looked at for the detail of a scene."""


def _high_pass(image: Tensor, depth: int, mask: Tensor | None) -> NDArray[Any]:
    grey = cv2.cvtColor(image.cpu().numpy(), cv2.COLOR_RGB2GRAY)
    passed = np.asarray(cv2.filter2D(grey, depth, HIGH_PASS))
    if mask is not None:
        passed *= cv2.erode(mask.cpu().numpy().view(np.uint8), np.ones((3, 3), np.uint8))
    return passed


def edge_strength(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Edge strength ``[H, W]`` of a photo, in [0, 1]: the positive part of a high-pass filter of its grey values.

    The strongest edge has strength 1; a photo without any edge is 0 everywhere.

    Args:
        image: ``[H, W, 3]`` uint8 RGB.
        mask: Which pixels count ``[H, W]`` bool; those beside one that does not have strength 0. None if all count.
    """
    edges = torch.from_numpy(_high_pass(image, cv2.CV_8U, mask))  # which also clips to 0..255
    low, high = int(edges.min()), int(edges.max())
    return ((edges.float() - low) / max(high - low, 1)).to(image.device)


def detailed_pixels(scene: Scene) -> float:
    """Pixels of a train photo that differ clearly from their neighbours, on average over the photos.

    Args:
        scene: At most 32 of its photos, evenly spaced, are decoded.

    Raises:
        SceneError: An image cannot be decoded.
    """
    pictures = (scene.images[index] for index in scene.some_train(SAMPLE))
    counts = [int((np.abs(_high_pass(image, cv2.CV_16S, mask)) > DETAIL).sum()) for image, mask in pictures]
    return sum(counts) / len(counts)
