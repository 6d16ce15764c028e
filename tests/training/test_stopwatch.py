"""What counts as training time, on a clock that stands still."""

from __future__ import annotations

import pytest
import torch

from nsvq_lightning.training.stopwatch import Stopwatch


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds on the clock, and of them those in which kernels were compiled."""
    now = [0.0, 0.0]
    monkeypatch.setattr("nsvq_lightning.training.stopwatch.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("nsvq_lightning.training.stopwatch.compile_seconds", lambda: now[1])
    return now


def test_training_time_leaves_compilation_out(now: list[float]) -> None:
    watch = Stopwatch()
    watch.start()
    now[:] = [100.0, 93.0]
    watch.lap()
    assert watch.seconds == 7.0
    with watch.paused(torch.device("cpu")):
        now[:] = [120.0, 103.0]
    now[:] = [121.0, 103.0]
    watch.stop()
    assert watch.seconds == 8.0


def test_a_watch_that_does_not_run_counts_nothing(now: list[float]) -> None:
    watch = Stopwatch()
    now[0] = 5.0
    watch.lap()
    with watch.paused(torch.device("cpu")):
        now[0] = 6.0
    watch.stop()
    assert watch.seconds == 0.0


def test_a_pause_ends_where_its_body_fails(now: list[float]) -> None:
    watch = Stopwatch()
    watch.start()

    def fail() -> None:
        with watch.paused(torch.device("cpu")):
            now[0] = 3.0
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    now[0] = 5.0
    watch.stop()
    assert watch.seconds == 2.0
