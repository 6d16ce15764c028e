"""How long a run trains, without pauses and the compilation of kernels."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from nsvq_lightning.compute.jit import compile_seconds


class Stopwatch:
    """Adds the time between two laps to :attr:`seconds`, without pauses and the compilation of kernels.

    Attributes:
        seconds: Seconds spent training, over all resumed parts of the run.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
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
