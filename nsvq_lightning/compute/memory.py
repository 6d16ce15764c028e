"""Tensors and arrays as kernels take them: a kernel looks at no length, so whoever calls one checks here first."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

__all__ = [
    "FLOAT32",
    "FLOAT64",
    "INT32",
    "INT64",
    "UINT8",
    "UINT64",
    "Array",
    "check_array",
    "check_table",
    "flat",
    "flat_checked",
    "outside",
]

Array = np.ndarray[Any, np.dtype[Any]]

FLOAT32, FLOAT64, INT32, INT64, UINT8, UINT64 = (
    np.dtype(kind) for kind in (np.float32, np.float64, np.int32, np.int64, np.uint8, np.uint64)
)


def flat(tensor: Tensor) -> Array:
    """The numbers of a tensor on the CPU, row by row: its own memory, or a copy where that is not contiguous."""
    return tensor.detach().contiguous().numpy().reshape(-1)


def check_array(name: str, array: Array, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Refuse memory that a kernel would take for something else, or pass the end of.

    Args:
        name: What the caller calls it, for the error.
        array: What a kernel is to read or write.
        shape: The shape it must have.
        dtype: The type that its numbers must have.

    Raises:
        TypeError: It is no array, or its numbers have another type.
        ValueError: It has another shape, or its numbers do not lie one behind the other.
    """
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        raise TypeError(f"{name} must be {dtype}, got {getattr(array, 'dtype', type(array).__name__)}; convert it")
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")
    if not array.flags.c_contiguous:
        raise ValueError(f"{name} must lie in memory without gaps, got strides {array.strides}; pass a copy")


def check_table(name: str, table: Array) -> None:
    """Refuse what is no float32 table ``[N, D]`` with D above 0 (:func:`check_array`).

    Raises:
        TypeError: Its numbers are not float32.
        ValueError: It has another shape, or gaps.
    """
    check_array(name, table, table.shape, FLOAT32)
    if table.ndim != 2 or table.shape[1] == 0:
        raise ValueError(f"{name} must have shape [N, D] with D > 0, got {list(table.shape)}")


def flat_checked(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: np.dtype[Any] = FLOAT32) -> Array:
    """The memory of a tensor on the CPU, row by row, after :func:`check_array`."""
    array = tensor.detach().numpy()
    check_array(name, array, shape, dtype)
    return array.reshape(-1)


def outside(name: str, numbers: Array, count: int) -> ValueError:
    """The error for row numbers of which a kernel has found some outside a table of ``count`` rows."""
    return ValueError(f"{name} must be in [0, {count}), got {numbers.min()} to {numbers.max()}")
