"""Buffers that outlive a render, so that a training step does not pay for fresh memory pages."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["Workspace", "recycled"]

Array = np.ndarray[Any, np.dtype[Any]]

_IDLE: list[Workspace] = []


class Workspace:
    """Named scratch arrays that only grow. Their content is whatever the last user left.

    A workspace is borrowed for as long as its forward pass may still be differentiated, so two renders that are alive
    at the same time never share one.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, Array] = {}

    @staticmethod
    def borrow() -> Workspace:
        """An idle workspace, or a new one."""
        return _IDLE.pop() if _IDLE else Workspace()

    def give_back(self) -> None:
        """Offer the workspace to the next render."""
        _IDLE.append(self)

    def array(self, name: str, size: int, dtype: type[np.generic] = np.float32) -> Array:
        """One-dimensional array of ``size`` elements, aligned to a cache line."""
        held = self._arrays.get(name)
        if held is None or held.size < size:
            room = size + size // 4
            # torch aligns to 64 bytes, NumPy only to 16.
            memory = torch.empty(max(1, room) * np.dtype(dtype).itemsize, dtype=torch.uint8).numpy()
            held = self._arrays[name] = memory.view(dtype)
        return held[:size]

    def rows(self, name: str, rows: int, columns: int, dtype: type[np.generic] = np.float32) -> Array:
        """Two-dimensional array, see :meth:`array`."""
        return self.array(name, rows * columns, dtype).reshape(rows, columns)


_RECYCLED: dict[tuple[int, ...], list[Array]] = {}
_SPARE = 4
"""Buffers of one shape that are kept when nobody holds them."""
_REFERENCES_OF_IDLE = 3
"""References to an idle buffer while it is looked at: the list's, the loop's and getrefcount's own."""


def recycled(shape: tuple[int, ...]) -> Tensor:
    """A float32 tensor with unspecified content, in memory whose former tensor is gone.

    Images and the gradients of large scenes come and go at every step; taking them from the system each time would cost
    more in page faults than computing them.
    """
    if shape not in _RECYCLED:
        # The number of splats changes at densification: the buffers of old shapes are of no more use.
        for old in [old for old in _RECYCLED if old[1:] == shape[1:]]:
            del _RECYCLED[old]
        _RECYCLED[shape] = []
    buffers = _RECYCLED[shape]
    for buffer in buffers:
        if sys.getrefcount(buffer) == _REFERENCES_OF_IDLE:
            return torch.from_numpy(buffer)
    fresh = torch.empty(max(1, math.prod(shape)), dtype=torch.float32).numpy()[: math.prod(shape)].reshape(shape)
    if len(buffers) < _SPARE:
        buffers.append(fresh)
    return torch.from_numpy(fresh)
