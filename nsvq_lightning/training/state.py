"""What a run must remember besides splats and codebooks: phase, SH degree, extent, time spent training."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from nsvq_lightning.compute.compilation import compile_seconds
from nsvq_lightning.training.schedule import Phase

__all__ = ["RunState", "Stopwatch"]


class RunState(nn.Module):
    """Scalars that checkpoints carry as buffers and code reads as plain numbers.

    Each buffer has a mirror in Python, so that reading the phase every step never waits for the device. Write through
    the properties; loading a state dict refreshes the mirrors.
    """

    _phase: Tensor
    _sh_degree: Tensor
    _extent: Tensor
    _train_seconds: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("_phase", torch.tensor(int(Phase.WARMUP)))
        self.register_buffer("_sh_degree", torch.tensor(0))
        self.register_buffer("_extent", torch.tensor(0.0, dtype=torch.float64))
        self.register_buffer("_train_seconds", torch.tensor(0.0, dtype=torch.float64))
        self.register_load_state_dict_post_hook(_refresh)  # type: ignore[no-untyped-call]
        self.refresh()

    def refresh(self) -> None:
        """Read the mirrors from the buffers again, for example after a broadcast."""
        self._mirror_phase = Phase(int(self._phase))
        self._mirror_sh_degree = int(self._sh_degree)
        self._mirror_extent = float(self._extent)
        self._mirror_train_seconds = float(self._train_seconds)

    @property
    def phase(self) -> Phase:
        """Phase of the current iteration."""
        return self._mirror_phase

    @phase.setter
    def phase(self, value: Phase) -> None:
        if value != self._mirror_phase:
            self._mirror_phase = Phase(value)
            self._phase.fill_(int(value))

    @property
    def sh_degree(self) -> int:
        """SH degree in use; higher coefficients are ignored."""
        return self._mirror_sh_degree

    @sh_degree.setter
    def sh_degree(self, value: int) -> None:
        if value != self._mirror_sh_degree:
            self._mirror_sh_degree = value
            self._sh_degree.fill_(value)

    @property
    def extent(self) -> float:
        """1.1 × the largest distance of a train camera from the mean of all, scene units; 0 while unknown."""
        return self._mirror_extent

    @extent.setter
    def extent(self, value: float) -> None:
        self._mirror_extent = float(value)
        self._extent.fill_(value)

    @property
    def train_seconds(self) -> float:
        """Seconds spent training, evaluations left out, over all resumed parts of the run."""
        return self._mirror_train_seconds

    @train_seconds.setter
    def train_seconds(self, value: float) -> None:
        self._mirror_train_seconds = float(value)
        self._train_seconds.fill_(value)


def _refresh(state: RunState, _: Any) -> None:
    state.refresh()


class Stopwatch:
    """Adds the time between two laps to ``state.train_seconds``, without pauses and the compilation of kernels.

    Args:
        state: Where the seconds go.
    """

    def __init__(self, state: RunState) -> None:
        self._state = state
        self._since: float | None = None

    def start(self) -> None:
        """Start counting now; earlier time is forgotten."""
        self._since = _working_time()

    def lap(self) -> None:
        """Add the time since the last lap; does nothing if the watch is not running."""
        if self._since is not None:
            now = _working_time()
            self._state.train_seconds += now - self._since
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
