from __future__ import annotations

import gc
import time
from unittest.mock import Mock

import pytest
import torch

from nsvq_lightning.commands.benchmark import Scope, timing
from nsvq_lightning.commands.benchmark.timing import Timing, measure


@pytest.fixture(autouse=True)
def small_product(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 16)


def test_cases_take_turns_in_a_rotating_order_after_one_call_that_is_not_counted() -> None:
    calls: list[str] = []
    cases = {name: lambda name=name: calls.append(name) for name in "ab"}
    timings = measure(cases, Scope((1,), repeats=3), 1)
    # The product goes first in the first round; then the order is turned by one place a round.
    assert "".join(calls) == "ab" + "ab" + "ab" + "ba"
    assert [len(timings[name].samples) for name in "ab"] == [3, 3]
    assert timings["a"].sgemm == timings["b"].sgemm


def test_gpu_is_timed_by_events_around_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = Mock()
    gpu.elapsed_time.return_value = 7.0
    monkeypatch.setattr(torch.cuda, "Event", lambda enable_timing: gpu)
    assert timing.milliseconds(gpu.run, "cuda:0") == 7.0
    said = [call[0] for call in gpu.method_calls]
    assert said == ["record", "run", "record", "synchronize", "elapsed_time"]


def test_slow_case_sits_out_once_its_time_is_used_up() -> None:
    cases = {"slow": lambda: time.sleep(0.03), "fast": lambda: None}
    timings = measure(cases, Scope((1,), repeats=6, seconds=0.05), 1, prepare=lambda: time.sleep(0.1))
    assert len(timings["slow"].samples) == 2
    assert 30 <= min(timings["slow"].samples) < 100  # ms, without the preparation
    assert len(timings["fast"].samples) == len(timings["fast"].sgemm) == 6


def test_threads_and_collector_are_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[int] = []
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    monkeypatch.setattr(torch, "set_num_threads", counts.append)

    def fail() -> None:
        raise RuntimeError(f"collector: {gc.isenabled()}")

    with pytest.raises(RuntimeError, match="collector: False"):
        measure({"a": fail}, Scope((1,)), 3)
    assert counts == [3, 7]
    assert gc.isenabled()


def test_summary_of_known_samples() -> None:
    known = Timing((5.0, 1.0, 2.0, 4.0, 3.0), (10.0, 30.0, 20.0))
    assert (known.median, known.quartiles, known.ratio) == (3.0, (2.0, 4.0), 0.15)
    assert Timing((7.0,), (7.0,)).quartiles == (7.0, 7.0)
