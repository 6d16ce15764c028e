"""Photos that stay on a GPU once they have been there."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nsvq_lightning.data.images import Picture
from nsvq_lightning.data.scene import View

__all__ = ["DevicePhotos"]

_SHARE = 4
"""Photos take at most one part in so many of a GPU's memory that is free at the first of them: splats grow."""


class DevicePhotos:
    """Moves views to a device and keeps their photos there, the first ones while a budget lasts.

    A photo is 5 MB that would cross the bus at every step. As in :class:`~nsvq_lightning.data.images.ImageStore`, what
    is kept stays: under a random order that is as good as anything.

    Args:
        most_bytes: Memory for photos on the device in bytes; on a GPU, a quarter of what is free if that is less.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most, self._free = most_bytes, 0
        self._device = torch.device("cpu")
        self._kept: dict[int, tuple[Tensor, View]] = {}

    def move(self, view: View, device: torch.device) -> View:
        """The view with its photo and mask on the device."""
        if device.type == "cpu":
            return view.to(device)
        if device != self._device:
            self._device, self._kept, self._free = device, {}, min(self._most, _spare(device))
        host, there = self._kept.get(view.index, (None, None))
        if there is not None and host is view.image:
            return replace(view, image=there.image, mask=there.mask)
        moved = view.to(device)
        if there is None and (taken := Picture(moved.image, moved.mask).nbytes) <= self._free:
            self._kept[view.index] = view.image, moved
            self._free -= taken
        return moved

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_device": torch.device("cpu"), "_kept": {}}


def _spare(device: torch.device) -> int:
    """Bytes of a device's memory that photos may take."""
    return torch.cuda.mem_get_info(device)[0] // _SHARE if device.type == "cuda" else 1 << 62
