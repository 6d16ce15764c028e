"""Buffers that outlive a render, so that a training step does not pay for fresh memory pages."""

from __future__ import annotations

import math
import sys
import threading

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.compute.memory import Array

__all__ = ["Workspace", "recycled"]

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
        try:
            return _IDLE.pop()
        except IndexError:
            return Workspace()

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


_BUFFERS: list[Array] = []
_LOCK = threading.Lock()
_SLACK = 4
"""A buffer up to this many times as large as asked for is good enough."""
_PAGE = 1024
"""Elements of a memory page."""


def _is_idle(index: int) -> bool:
    """Whether nobody but the list and this question refers to a buffer."""
    return sys.getrefcount(_BUFFERS[index]) == 2


def recycled(shape: tuple[int, ...]) -> Tensor:
    """A float32 tensor with unspecified content, in memory whose former tensor is gone.

    Images and the gradients of large scenes come and go at every step; taking them from the system each time would cost
    more in page faults than computing them.
    """
    size = math.prod(shape)
    with _LOCK:
        best = -1
        for i in range(len(_BUFFERS)):
            if size <= _BUFFERS[i].size <= _SLACK * size + _PAGE and _is_idle(i):
                best = i if best < 0 or _BUFFERS[i].size < _BUFFERS[best].size else best
        if best < 0:
            # The number of splats grows: what is a little too small now will not be asked for again.
            outgrown = [i for i in range(len(_BUFFERS)) if size / 2 <= _BUFFERS[i].size < size and _is_idle(i)]
            for i in reversed(outgrown):
                del _BUFFERS[i]
            _BUFFERS.append(torch.empty(size + size // 8 + _PAGE, dtype=torch.float32).numpy())
        # The tensor keeps the view alive, the view its buffer.
        return torch.from_numpy(_BUFFERS[best][:size].reshape(shape))
