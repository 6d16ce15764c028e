"""Where a photo has edges: the positive part of a high-pass filter of its grey values."""

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.compute.devices import to_device


class Edges(NamedTuple):
    """Edges of a photo, a byte a pixel.

    Attributes:
        values: Strength ``[H, W]`` uint8, 0 where it is least.
        strongest: The largest of them, at least 1.
    """

    values: Tensor
    strongest: int

    def strength(self, device: torch.device | str = "cpu") -> Tensor:
        """Strength ``[H, W]`` float32 in [0, 1]: 1 for the strongest edge."""
        return to_device(self.values, device).float() / self.strongest


def edges_of(image: Tensor, mask: Tensor | None = None) -> Edges:
    """Edges of a photo; one without any is 0 everywhere.

    Args:
        image: ``[H, W, 3]`` uint8 RGB.
        mask: Which pixels count ``[H, W]`` bool; those beside one that does not have strength 0. None if all count.
    """
    values = torch.from_numpy(high_pass(image, mask, cv2.CV_8U))  # which also clips to 0..255
    values = values - values.min()
    return Edges(values, max(int(values.max()), 1))


def high_pass(image: Tensor, mask: Tensor | None, depth: int) -> NDArray[Any]:
    """Eight times the grey value of each pixel less those of its neighbours, 0 beside pixels that do not count.

    Args:
        image: ``[H, W, 3]`` uint8 RGB.
        mask: Which pixels count ``[H, W]`` bool; None if all do.
        depth: OpenCV's name of the type of the result.
    """
    grey = cv2.cvtColor(image.cpu().numpy(), cv2.COLOR_RGB2GRAY)
    kernel = np.full((3, 3), -1, np.float32)
    kernel[1, 1] = 8
    passed: NDArray[Any] = cv2.filter2D(grey, depth, kernel)
    if mask is not None:
        passed *= cv2.erode(mask.cpu().numpy().view(np.uint8), np.ones((3, 3), np.uint8))
    return passed
