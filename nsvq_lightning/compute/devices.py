"""Which compiled kernels take a tensor, how Triton's are launched, and copies that wait for nothing but themselves.

Triton itself is not imported. It compiles a kernel anew for integers that are 1 or multiples of 16. Numbers that change
from step to step, such as that of the splats in view, are named in ``do_not_specialize``, or kernels would compile in
the middle of a run.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from typing import Literal

import torch
from torch import Tensor

__all__ = ["COMPILE", "AsyncScalar", "kernels_for", "to_device", "triton_obstacle"]


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
    problem = None if _interpreted() and like.dtype == torch.float32 else _not_on_cuda(like)
    if problem is None and not _has_triton():
        return "it needs Triton, which comes with CUDA builds of PyTorch for Linux (pip install triton)"
    return problem


def _not_on_cuda(like: Tensor) -> str | None:
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


def to_device(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on a device, or itself if it is there already; the copy to a GPU runs beside what is queued there."""
    device = torch.device(device)
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()  # from other memory, the driver copies before the call returns
    return tensor.to(device, non_blocking=True)


class AsyncScalar:
    """A number from a device, which can be read without waiting for what has been queued since.

    ``tensor.item()`` waits until a GPU has done all its work, and the GPU then waits for the next launch. Here the copy
    starts at once, and :meth:`read` waits for that copy alone.

    Args:
        value: Scalar tensor on any device.
    """

    def __init__(self, value: Tensor) -> None:
        self._host, self._copied = value.detach(), None
        if value.is_cuda:
            self._host = torch.empty((), dtype=value.dtype, pin_memory=True)
            self._host.copy_(value.detach(), non_blocking=True)
            self._copied = torch.cuda.Event()
            self._copied.record(torch.cuda.current_stream(value.device))

    @property
    def is_here(self) -> bool:
        """Whether the number was on the host from the start, so that nobody ever waits for it."""
        return self._copied is None

    def read(self) -> float:
        """The number."""
        if self._copied is not None:
            self._copied.synchronize()
        return float(self._host)


COMPILE = {"enable_fp_fusion": True}
"""Options of every launch. Triton's default is about to change; values on which the forward and backward pass must
agree to the bit are computed with an explicit ``fma``."""
