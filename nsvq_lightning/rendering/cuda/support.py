"""Whether the kernels of this folder can run here; answers without importing Triton."""

from __future__ import annotations

import importlib.util
import os
from functools import cache

import torch
from torch import Tensor

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
    if like.dtype != torch.float32 or not (like.is_cuda or interpreted()):
        return f"it renders float32 tensors on a CUDA device, got {like.dtype} on {like.device}; move the splats"
    if not has_triton():
        return "it needs Triton, which a CUDA build of PyTorch for Linux brings along (pip install triton)"
    return None
