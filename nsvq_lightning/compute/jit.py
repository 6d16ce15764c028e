"""How kernels are compiled, cached and run in parallel, and how long compiling has taken.

A kernel is compiled at its first call on a machine and read from the disk cache from then on. Compiling is not
training, so clocks leave it out, and it can look like a hang, so the progress display says what is going on.
"""

import contextlib
import functools
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
import torch
from numba.core import event

from nsvq_lightning.compute.kernel_cache import KernelCache

log = logging.getLogger(__name__)

# Called when a compilation begins, with a line that says how many kernels there are and how many are ready.
Watcher = Callable[[str], None]


class _Compilations(event.Listener):
    """Times Numba's compilations, tells watchers when they begin, and has LLVM optimise helpers at a low level.

    LLVM optimises helpers again, with the kernel they are inlined into, whose level decides about speed. Helpers are
    most of what is compiled: at this level, and without a wrapper for Python, all takes half of the time.
    """

    def __init__(self) -> None:
        self.watchers: list[Watcher] = []
        self.announced = False
        self.seconds = self.since = 0.0
        # LLVM's level before each compilation in progress, of a kernel and its helpers.
        self.levels: list[int] = []

    def on_start(self, compilation: Any) -> None:
        if not self.levels:
            self.since = time.perf_counter()
            if not self.announced:
                self.announced = True
                log.info("compiling kernels as they are needed, once on this machine: half a minute to two in all")
            ready = sum(bool(dispatcher.overloads) for dispatcher in _kernels)  # compiled, or read from the disk
            for watcher in self.watchers:
                watcher(f"compiling kernels {ready + 1}/{len(_kernels)}, once on this machine")
        level = numba.config.OPT
        self.levels.append(level)
        if compilation.data["dispatcher"].targetoptions.get("forceinline"):
            numba.config.OPT = type(level)(min(level, 1))

    def on_end(self, _: Any) -> None:
        numba.config.OPT = self.levels.pop()
        if not self.levels:
            self.seconds += time.perf_counter() - self.since


# Every kernel of the modules that are loaded.
_kernels: list[Any] = []
_compilations = _Compilations()
event.register("numba:compile", _compilations)


def compile_seconds() -> float:
    """Seconds spent compiling CPU kernels in this process so far; cached kernels take none."""
    in_progress = time.perf_counter() - _compilations.since if _compilations.levels else 0.0
    return _compilations.seconds + in_progress


@contextlib.contextmanager
def compile_watcher(watcher: Watcher) -> Iterator[None]:
    """Call ``watcher`` whenever a compilation begins within the block."""
    _compilations.watchers.append(watcher)
    try:
        yield
    finally:
        _compilations.watchers.remove(watcher)


class _Cache(KernelCache):
    """Its first question to the disk is the first that happens when a kernel is called."""

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        start_threads()
        return super()._load_overload(sig, target_context)


@functools.cache
def start_threads() -> None:
    """Start Numba's threads, which tells OpenMP to use all cores, and give torch its own setting back."""
    count = torch.get_num_threads()
    numba.set_num_threads(numba.get_num_threads())
    torch.set_num_threads(count)


# Type of the numeric literals in kernels; Python floats would promote their operands to float64.
F = np.float32

_OPTIONS: dict[str, Any] = {
    # Products and sums may fuse; NaN and infinity keep their meaning because this package's guards rely on them.
    "fastmath": {"contract", "nsz"},
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
    "no_cfunc_wrapper": True,
}


def inline(function: Callable[..., Any]) -> Any:
    """Compile a helper that only other kernels call."""
    return numba.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)(function)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that threads call (:mod:`nsvq_lightning.compute.parallel`)."""
    return numba.njit(no_cpython_wrapper=True, **_OPTIONS)(function)


def kernel(function: Callable[..., Any], allocates: bool = True) -> Any:
    """Compile a kernel once per machine, and keep it on the disk (:mod:`nsvq_lightning.compute.kernel_cache`).

    A kernel that allocates no arrays may pass ``allocates=False``: the arrays that it passes to inlined helpers are
    then not reference-counted, with atomic operations, at every call, and a loop of few instructions becomes seven
    times as fast.

    It is compiled again when its module, or one that this imports, has changed.
    """
    dispatcher = numba.njit(_nrt=allocates, **_OPTIONS)(function)
    with contextlib.suppress(RuntimeError):  # nowhere to keep it
        dispatcher._cache = _Cache(function)
    _kernels.append(dispatcher)
    return dispatcher


# What Numba was told last; it keeps the number of threads by calling thread.
_told = threading.local()


def thread_count() -> int:
    """Number of threads that kernels use: torch's setting, so that one setting controls both."""
    asked = torch.get_num_threads()
    if asked != getattr(_told, "torch", 0):
        start_threads()
        _told.torch, _told.count = asked, max(1, min(asked, int(numba.config.NUMBA_NUM_THREADS)))
        numba.set_num_threads(_told.count)
    return int(_told.count)
