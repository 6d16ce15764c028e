"""Tensors as the kernels of a GPU take them: a kernel looks at no length, so whoever launches one checks here first."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["check_tensor"]


def check_tensor(
    name: str, tensor: Tensor, shape: tuple[int, ...], device: torch.device, dtype: torch.dtype = torch.float32
) -> None:
    """Refuse memory that a kernel would take for something else, or pass the end of; asks nothing of the device.

    Args:
        name: What the caller calls it, for the error.
        tensor: What a kernel is to read or write.
        shape: The shape it must have.
        device: Where it must be.
        dtype: The type that its numbers must have.

    Raises:
        TypeError: Its numbers have another type.
        ValueError: It has another shape, is elsewhere, or its numbers do not lie one behind the other.
    """
    if tensor.dtype != dtype:
        raise TypeError(f"{name} must be {dtype}, got {tensor.dtype}; convert it")
    if tensor.shape != shape or tensor.device != device:
        raise ValueError(
            f"{name} must have shape {list(shape)} on {device}, got {list(tensor.shape)} on {tensor.device}"
        )
    if not tensor.is_contiguous():
        raise ValueError(f"{name} must lie in memory without gaps, got strides {tensor.stride()}; pass a copy")
