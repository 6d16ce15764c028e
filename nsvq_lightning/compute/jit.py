"""How kernels are compiled, cached and run in parallel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch

from nsvq_lightning.compute.stamp import KernelStore

__all__ = ["F", "inline", "kernel", "thread_count"]

F = np.float32
"""Numbers written in kernels have its type: Python's own would widen what they meet to float64."""

_OPTIONS: dict[str, Any] = {
    # Products and sums may fuse; NaN and infinity keep their meaning because the guards of this package rely on them.
    "fastmath": {"contract", "nsz"},
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}


def inline(function: Callable[..., Any]) -> Any:
    """Compile a helper that only other kernels call."""
    return numba.njit(forceinline=True, **_OPTIONS)(function)


def kernel(function: Callable[..., Any], parallel: bool = True, allocates: bool = True) -> Any:
    """Compile a kernel once a machine and keep it on disk. To wake the threads costs more than some need in all.

    One that makes no arrays of its own may say so: arrays that it passes to inlined helpers are then not counted up and
    down, by atomic operations, at every call. A loop of few instructions becomes seven times as fast.

    A stored one is compiled again when what it is made of has changed (:mod:`nsvq_lightning.compute.stamp`).
    """
    dispatcher = numba.njit(parallel=parallel, _nrt=allocates, **_OPTIONS)(function)
    dispatcher._cache = KernelStore(function)
    return dispatcher


def thread_count() -> int:
    """Threads that kernels use: torch's setting, so that one knob rules both."""
    count = max(1, min(torch.get_num_threads(), int(numba.config.NUMBA_NUM_THREADS)))
    numba.set_num_threads(count)
    return count
