from __future__ import annotations

import gc
import time

import pytest
import torch

from nsvq_lightning.commands.benchmark import Scope, timing
from nsvq_lightning.commands.benchmark.timing import Case, Timing, measure


@pytest.fixture(autouse=True)
def small_product(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 16)


def test_cases_take_turns_in_a_rotating_order_after_one_call_that_is_not_counted() -> None:
    calls: list[str] = []
    cases = [Case(name, lambda name=name: calls.append(name)) for name in "ab"]  # type: ignore[misc]
    timings = measure(cases, Scope((1,), repeats=3), 1)
    # The product goes first in the first round; then the order is turned by one place a round.
    assert "".join(calls) == "ab" + "ab" + "ab" + "ba"
    assert {name: len(result.samples) for name, result in timings.items()} == {"a": 3, "b": 3}
    assert len(timings["a"].sgemm) == 3
    assert timings["a"].sgemm == timings["b"].sgemm


def test_gpu_is_timed_by_events_around_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self) -> None:
            said.append("record")

        def synchronize(self) -> None:
            said.append("synchronize")

        def elapsed_time(self, end: Event) -> float:
            return 7.0 if end is not self else 0.0

    monkeypatch.setattr(torch.cuda, "Event", Event)
    case = Case("a", lambda: said.append("run"), lambda: said.append("prepare"))
    assert timing.milliseconds(case, "cuda:0") == 7.0
    assert said == ["prepare", "record", "run", "record", "synchronize"]


def test_slow_case_sits_out_once_its_time_is_used_up() -> None:
    cases = [Case("slow", lambda: time.sleep(0.03), lambda: time.sleep(0.1)), Case("fast", lambda: None)]
    timings = measure(cases, Scope((1,), repeats=6, seconds=0.05), 1)
    assert len(timings["slow"].samples) == 2
    assert 30 <= min(timings["slow"].samples) < 100  # ms, without the preparation
    assert len(timings["fast"].samples) == len(timings["fast"].sgemm) == 6


def test_threads_and_collector_are_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    counts: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", counts.append)
    seen: list[bool] = []

    def fail() -> None:
        seen.append(gc.isenabled())
        raise RuntimeError("broken case")

    with pytest.raises(RuntimeError, match="broken case"):
        measure([Case("a", fail)], Scope((1,)), 3)
    assert counts == [3, 7]
    assert seen == [False]
    assert gc.isenabled()


def test_summary_of_known_samples() -> None:
    known = Timing((5.0, 1.0, 2.0, 4.0, 3.0), (10.0, 30.0, 20.0))
    assert (known.median, known.quartiles, known.ratio) == (3.0, (2.0, 4.0), 0.15)
    assert Timing((7.0,), (7.0,)).quartiles == (7.0, 7.0)
