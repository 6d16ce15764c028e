"""Tensors and arrays as kernels take them: a kernel checks no lengths, so whoever calls one checks here first."""

import ctypes
import gc
import math
import re
import threading
import weakref
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

Array = np.ndarray[Any, np.dtype[Any]]

# Memory that is free.
_FREE: list[Array] = []
_IDLE: list["Workspace"] = []


def flat(tensor: Tensor) -> Array:
    """The elements of a CPU tensor in row-major order: its own memory, or a copy where that is not contiguous."""
    return tensor.detach().ravel().numpy()


def check_inside(name: str, numbers: Array | Tensor, count: int, least: int = 0) -> None:
    """Refuse numbers that are not rows of a table of ``count`` rows.

    Args:
        name: What the error calls them.
        numbers: Numbers ``[N, ...]``.
        count: Number of rows.
        least: -1 where that stands for no row.

    Raises:
        ValueError: One is not.
    """
    if len(numbers) and (numbers.min() < least or numbers.max() >= count):
        raise ValueError(f"{name} must be in [{least}, {count}), got {numbers.min()} to {numbers.max()}")


class Workspace:
    """Named scratch arrays that only grow. Their content is whatever the last user left.

    A workspace is borrowed for as long as its forward pass may still be differentiated, so two renders that are alive
    at the same time never share one.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, Array] = {}

    @staticmethod
    def borrow() -> "Workspace":
        """An idle workspace, or a new one."""
        with suppress(IndexError):
            return _IDLE.pop()
        return Workspace()

    def give_back(self) -> None:
        """Offer the workspace to the next render."""
        _IDLE.append(self)

    def array(self, name: str, size: int, dtype: type[np.generic] = np.float32) -> Array:
        """One-dimensional array of ``size`` elements, aligned to a cache line."""
        held = self._arrays.get(name)
        if held is None or held.size < size:
            # torch aligns to 64 bytes, NumPy only to 16.
            memory = torch.empty(max(1, size + size // 4) * np.dtype(dtype).itemsize, dtype=torch.uint8).numpy()
            held = self._arrays[name] = memory.view(dtype)
        return held[:size]

    def rows(self, name: str, rows: int, columns: int, dtype: type[np.generic] = np.float32) -> Array:
        """Two-dimensional array, see :meth:`array`."""
        return self.array(name, rows * columns, dtype).reshape(rows, columns)


_LOCK = threading.Lock()
# A buffer of up to this many times the requested size is reused.
_SLACK = 4
# Floats in a memory page.
_PAGE = 1024


def recycled(shape: tuple[int, ...]) -> Tensor:
    """A float32 tensor with unspecified content, in memory whose previous tensor is gone.

    Images and the gradients of large scenes come and go at every step; allocating them afresh each time would cost
    more in page faults than computing them.
    """
    size = math.prod(shape)
    with _LOCK:
        # Tensors that end meanwhile, in whatever thread, append their memory. The smallest that is large enough, and of
        # equal ones that which is still in the caches:
        sizes = [(len(buffer), -place) for place, buffer in enumerate(_FREE)]
        length, place = min((each for each in sizes if each[0] >= size), default=(-1, 0))
        if size <= length <= _SLACK * size + _PAGE:
            buffer = _FREE.pop(-place)
        else:
            # The number of splats grows: a buffer that is a little too small now will not be requested again.
            _FREE[:] = [buffer for buffer in _FREE if not size / 2 <= len(buffer) < size]
            buffer = aligned_empty((size + size // 8 + _PAGE,))
    view = buffer[:size].reshape(shape)  # which the tensor keeps alive
    weakref.finalize(view, _FREE.append, buffer)
    return torch.from_numpy(view)


# Dimensions that are given as numbers.
_NUMBERS = {str(number): number for number in range(32)}


@cache
def _forms(text: str) -> list[tuple[str, list[str], str, set[Any]]]:
    """Name, dimensions and dtype of each array in a text as :func:`check_fit` takes it."""
    forms = []
    for name, dims, dtype in re.findall(r"([^,]+?) \[(.*?)\](?: (\w+))?(?:, |$)", text):
        kind = dtype or "float32"
        forms.append((name, re.findall(r"\w+", dims), kind, {getattr(torch, kind), np.dtype(kind)}))
    return forms


def check_fit(text: str, first: Array | Tensor, *others: Array | Tensor | None, **sizes: int) -> None:
    """Refuse memory that a kernel would misread or run past the end of; asks nothing of the device.

    Args:
        text: What arrays or tensors have to be, such as ``x [N, D], codes [N] int64``: their names for the error, their
            dimensions, of which equal ones have the same name, and the dtype if it is not float32.
        first: The first of them.
        others: The others in this order, of which the last ones may be left out. Those that are None fit.
        sizes: Dimensions that are known, by name.

    Raises:
        TypeError: One has another dtype.
        ValueError: One has another shape, is on another device than the first, or is not contiguous.
    """
    known: dict[str, int] = _NUMBERS | sizes
    for (name, dims, kind, dtypes), each in zip(_forms(text), (first, *others), strict=False):
        if each is None:
            continue
        if each.dtype not in dtypes:
            raise TypeError(f"{name} must be {kind}, got {each.dtype}; convert it")
        shape = tuple(map(known.setdefault, dims, each.shape))
        if len(dims) != each.ndim or shape != each.shape or each.device != first.device:
            told = [f"{dim} = {known[dim]}" for dim in dims if dim in known and dim not in _NUMBERS]
            expected = f"[{', '.join(dims)}] on {first.device} ({', '.join(told)})"
            raise ValueError(f"{name} must have shape {expected}, got {list(each.shape)} on {each.device}")
        if not (each.is_contiguous() if isinstance(each, Tensor) else each.flags.c_contiguous):
            raise ValueError(f"{name} must be contiguous; pass a copy")


def aligned_empty(shape: tuple[int, ...]) -> Array:
    """An uninitialised float32 array that starts on a cache line, so that no vector in it straddles two."""
    return torch.empty(shape, dtype=torch.float32).numpy()  # NumPy aligns to 16 bytes


def trim() -> None:
    """Give free memory back to the system, also what the C library of Linux keeps: 0.6 GB after a dense start."""
    gc.collect()
    _FREE.clear()
    _IDLE.clear()
    with suppress(OSError, AttributeError):  # another library
        ctypes.CDLL("libc.so.6").malloc_trim(0)
