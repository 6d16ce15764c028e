"""What torch and OpenMP read from the environment when they are loaded."""

from __future__ import annotations

import os
import sys

__all__ = ["set_defaults", "threads_spin"]

DEFAULTS = {
    # Waiting OpenMP threads otherwise spin: as soon as anything else runs on the machine, the threads that have work
    # wait for those that only spin, and a step takes several times as long.
    "OMP_WAIT_POLICY": "passive",
    # Large tensors in large pages: a step of 100k splats takes 3 % less time, one of 500k splats 4 %.
    "THP_MEM_ALLOC_ENABLE": "1",
}

_came_late = False


def set_defaults() -> None:
    """Set what the user has not; too late for a process that has loaded torch already."""
    global _came_late
    _came_late = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ
    for name, value in DEFAULTS.items():
        os.environ.setdefault(name, value)


def threads_spin() -> bool:
    """Whether waiting threads keep the cores busy, as torch was loaded before :func:`set_defaults`."""
    return _came_late
