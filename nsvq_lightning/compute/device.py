"""What every back-end of a GPU asks of the tensors."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["not_on_cuda"]


def not_on_cuda(like: Tensor) -> str | None:
    """Why CUDA kernels cannot take tensors such as ``like``, with a way out; None for float32 on a CUDA device."""
    if like.is_cuda and like.dtype == torch.float32:
        return None
    help_ = "move the splats (nsvq fit --trainer.accelerator=cuda)"
    if not torch.cuda.is_available():
        help_ = "torch finds no CUDA device here, nsvq doctor says why"
    return f"it renders float32 tensors on a CUDA device, got {like.dtype} on {like.device}; {help_}"
