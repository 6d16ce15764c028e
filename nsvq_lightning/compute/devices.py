"""Which compiled kernels take a tensor: all fast paths ask here, so a device has one answer."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from nsvq_lightning.compute.support import obstacle

__all__ = ["kernels_for"]


def kernels_for(like: Tensor) -> Literal["cpu", "cuda"] | None:
    """``cpu`` (Numba) or ``cuda`` (Triton) for float32 tensors there; None where plain torch must do.

    None is any other dtype or device, and a CUDA device without Triton. Under Triton's interpreter tensors on the CPU
    still go to Numba: it is for tests, which call the kernels by name.
    """
    if like.dtype != torch.float32:
        return None
    if like.device.type == "cpu":
        return "cpu"
    return "cuda" if obstacle(like) is None else None
