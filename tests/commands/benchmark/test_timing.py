from __future__ import annotations

import dataclasses
import gc
import json
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from nsvq_lightning.commands.benchmark import Scope, timing
from nsvq_lightning.commands.benchmark.timing import Measurement, Timing, as_json, as_markdown, measure, number


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


FACTS: dict[str, dict[str, Any]] = {
    "machine": {"cpu": "Abacus 1", "gpu": None, "load": 0.2},
    "versions": {"torch": "9"},
}


def _row(method: str, ms: float, operation: str, note: str = "", **values: float) -> Measurement:
    return Measurement(operation, "W", method, 1, Timing((ms, 2 * ms, 3 * ms), (10.0,)), values, note)


ROWS = [
    _row("fast", 1.0, "search", wrong=0.0),
    _row("slow", 300.0, "search", wrong=1e-6),
    _row("slow", 5.0, "other", "only half", wrong=12.0, extra=1.0),
]


def test_numbers_have_three_digits() -> None:
    texts = {0.0: "0", 8e4: "80,000", 0.01234: "0.0123", 4.123e-7: "4.1e-07", 12.345: "12.3", 1234.5: "1,234"}
    assert {value: number(value) for value in texts} == texts


def test_tables_name_the_machine_and_every_operation() -> None:
    text = as_markdown(FACTS, Scope((1, 2), quick=True), {"quantize": ROWS})
    for said in ("\n\ncpu Abacus 1, load 0.2\n\ntorch 9\n\n", "Rounds: 15; threads: 1, 2; quick."):
        assert said in text
    assert text.count("### search, W, 1 thread\n") == text.count("### other, W, 1 thread\n") == 1
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0] == ["method", "ms", "quartiles", "min", "n", "sgemm", "wrong"]
    assert lines[2] == ["fast", "2", "1.5–2.5", "1", "3", "0.2", "0"]
    assert lines[3] == ["slow", "600", "450–750", "300", "3", "60", "1e-06"]
    assert lines[4][-2:] == ["wrong", "extra"]
    assert text.endswith("\n\nOnly half.\n")
    other = [dataclasses.replace(ROWS[0], workload="V"), dataclasses.replace(ROWS[0], threads=2), ROWS[0]]
    assert "### search\n\n| workload | method | threads |" in as_markdown(FACTS, Scope((1, 2)), {"quantize": other})


def test_json_has_the_samples_and_nothing_but_plain_values() -> None:
    results = json.loads(as_json(timing.describe_machine(), Scope((1,), scene=Path("a/b.ply")), {"quantize": ROWS}))
    assert results["versions"]["torch"] == torch.__version__
    assert results["settings"]["scene"] == "a/b.ply"
    first, _, last = results["rows"]
    assert first["suite"] == "quantize"
    assert first["timing"] == {"samples": [1, 2, 3], "sgemm": [10]}
    assert (first["median_ms"], first["sgemm_ratio"]) == (2, pytest.approx(0.2))
    assert last["values"] == {"wrong": 12, "extra": 1}
