"""Which compiled kernels take a tensor. All fast paths ask here; the answer for a dtype and device never changes."""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from typing import Literal

import torch
from torch import Tensor

__all__ = ["kernels_for", "not_on_cuda", "triton_obstacle"]


def kernels_for(like: Tensor) -> Literal["cpu", "cuda"] | None:
    """``cpu`` (Numba) or ``cuda`` (Triton) for float32 tensors on that device; None where only plain torch works.

    None is for any other dtype or device, and for CUDA without Triton. Under Triton's interpreter, tensors on the CPU
    still go to Numba: the interpreter is for tests, which call the Triton kernels directly.
    """
    return _kernels_for(like.dtype, like.device.type)


@cache
def _kernels_for(dtype: torch.dtype, device: str) -> Literal["cpu", "cuda"] | None:
    if dtype != torch.float32:
        return None
    if device == "cpu":
        return "cpu"
    return "cuda" if device == "cuda" and _has_triton() else None


def triton_obstacle(like: Tensor) -> str | None:
    """Why Triton's kernels cannot take tensors such as ``like``, with a remedy; None where they can."""
    problem = None if _interpreted() and like.dtype == torch.float32 else not_on_cuda(like)
    if problem is None and not _has_triton():
        return "it needs Triton, which comes with CUDA builds of PyTorch for Linux (pip install triton)"
    return problem


def not_on_cuda(like: Tensor) -> str | None:
    """Why GPU kernels cannot take tensors such as ``like``, with a remedy; None for float32 on a CUDA device."""
    if like.is_cuda and like.dtype == torch.float32:
        return None
    help_ = "move the splats (nsvq fit --trainer.accelerator=cuda)"
    if not torch.cuda.is_available():
        help_ = "torch finds no CUDA device here (nsvq doctor says why)"
    return f"it renders float32 tensors on a CUDA device, got {like.dtype} on {like.device}; {help_}"


def _interpreted() -> bool:
    """Whether Triton's interpreter runs the kernels on the CPU: slow, for tests."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


@cache
def _has_triton() -> bool:
    """Whether Triton is installed; a render with ``backend="cuda"`` asks each time."""
    return importlib.util.find_spec("triton") is not None
