"""Whether the kernels of this folder can run here; answers without importing Triton."""

from __future__ import annotations

import importlib.util
import os
from functools import cache

import torch
from torch import Tensor

from nsvq_lightning.compute.device import not_on_cuda

__all__ = ["has_triton", "interpreted", "obstacle"]


def interpreted() -> bool:
    """Whether Triton's interpreter runs the kernels on the CPU: slow, for tests."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


@cache
def has_triton() -> bool:
    """Whether Triton is installed; every render asks."""
    return importlib.util.find_spec("triton") is not None


def obstacle(like: Tensor) -> str | None:
    """Why the kernels cannot take tensors such as ``like``, with a way out; None where they can."""
    problem = None if interpreted() and like.dtype == torch.float32 else not_on_cuda(like)
    if problem is not None:
        return problem
    if not has_triton():
        return "it needs Triton, which a CUDA build of PyTorch for Linux brings along (pip install triton)"
    return None
