"""How long this process has spent compiling kernels, and a log line when compilation begins.

A kernel is compiled at its first call on a machine and read from the disk cache from then on. Compiling is not
training, so clocks leave it out, and it can look like a hang, so the progress display says what is going on.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from numba.core import event

from nsvq_lightning.compute.jit import kernels_ready

log = logging.getLogger(__name__)

# Called when a compilation begins, with a line that says how many kernels there are and how many are ready.
Watcher = Callable[[str], None]


class _Clock(event.Listener):
    """Adds up the time of Numba's compilations; compiling a kernel includes compiling its helpers."""

    def __init__(self) -> None:
        self.watchers: list[Watcher] = []
        self._seconds = 0.0
        self._depth = 0
        self._since = 0.0
        self._announced = False

    @property
    def seconds(self) -> float:
        """Seconds so far, including the compilation in progress."""
        return self._seconds + (time.perf_counter() - self._since if self._depth else 0.0)

    def on_start(self, _: Any) -> None:
        self._depth += 1
        if self._depth > 1:
            return
        self._since = time.perf_counter()
        if not self._announced:
            self._announced = True
            log.info("compiling kernels as they are needed, once on this machine: half a minute to two in all")
        ready, known = kernels_ready()
        for watcher in self.watchers:
            watcher(f"compiling kernels {ready + 1}/{known}, once on this machine")

    def on_end(self, _: Any) -> None:
        self._depth -= 1
        if self._depth:
            return
        self._seconds += time.perf_counter() - self._since


_clock = _Clock()
event.register("numba:compile", _clock)


def compile_seconds() -> float:
    """Seconds spent compiling CPU kernels in this process so far; cached kernels take none."""
    return _clock.seconds


@contextmanager
def compile_watcher(watcher: Watcher) -> Iterator[None]:
    """Call ``watcher`` whenever a compilation begins within the block."""
    _clock.watchers.append(watcher)
    try:
        yield
    finally:
        _clock.watchers.remove(watcher)


class Stopwatch:
    """Adds the time between two laps to :attr:`seconds`, without pauses and the compilation of kernels."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """Seconds spent training, over all resumed parts of the run."""
        self._since: float | None = None

    def start(self) -> None:
        """Start counting now; earlier time is forgotten."""
        self._since = _working_time()

    def lap(self) -> None:
        """Add the time since the last lap; does nothing if the watch is not running."""
        if self._since is not None:
            now = _working_time()
            self.seconds += now - self._since
            self._since = now

    def stop(self) -> None:
        """Add the time since the last lap and stop."""
        self.lap()
        self._since = None

    @contextmanager
    def paused(self, device: torch.device) -> Iterator[None]:
        """Leave out the time of the body. Work already queued on ``device`` still counts as training."""
        running = self._since is not None
        if running:
            torch.get_device_module(device).synchronize()
            self.stop()
        try:
            yield
        finally:
            if running:
                torch.get_device_module(device).synchronize()
                self.start()


def _working_time() -> float:
    """Seconds on a clock that stops while kernels are compiled."""
    return time.perf_counter() - compile_seconds()
