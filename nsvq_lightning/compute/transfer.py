"""Copies between the host and a device that wait for nothing but themselves."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["LateNumber", "upload"]


def upload(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on a device, or itself if it is there already; the copy to a GPU runs beside what is queued there."""
    device = torch.device(device)
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()  # from other memory, the driver copies before the call returns
    return tensor.to(device, non_blocking=True)


class LateNumber:
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
