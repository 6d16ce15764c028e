"""How long this process has spent compiling kernels, and a log line when compilation begins.

A kernel is compiled at its first call on a machine and read from the disk cache from then on. Compiling is not
training, so clocks leave it out, and it can look like a hang, so the progress display says what is going on.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

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
