from __future__ import annotations

import gc
import time
from importlib.util import find_spec
from unittest.mock import Mock

import pytest
import torch

from nsvq_lightning.commands.benchmark import timing
from nsvq_lightning.commands.benchmark.timing import Call, Measurement, Scope, as_markdown, compare, number


@pytest.fixture(autouse=True)
def small_product(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 16)


def measure(cases: dict[str, Call], scope: Scope) -> dict[str, Measurement]:
    values: dict[str, dict[str, float]] = {name: {} for name in cases}
    return {row.method: row for row in compare("search", "W", cases, values, scope)}


def test_cases_take_turns_in_a_rotating_order_after_one_call_that_is_not_counted() -> None:
    calls: list[str] = []
    cases: dict[str, Call] = {name: lambda name=name: calls.append(name) for name in "ab"}
    timings = measure(cases, Scope(repeats=3))
    # The product goes first in the first round; the order turns by one place a round, every other one backwards.
    assert "".join(calls) == "ba" + "ab" + "ba" + "ba"
    assert [len(timings[name].samples) for name in "ab"] == [3, 3]
    assert timings["a"].sgemm == timings["b"].sgemm


def test_the_work_of_a_gpu_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = Mock()
    monkeypatch.setattr(timing, "finish", gpu.finish)
    assert timing.milliseconds(gpu.run) >= 0
    assert [call[0] for call in gpu.method_calls] == ["finish", "run", "finish"]


def test_slow_case_sits_out_once_its_time_is_used_up() -> None:
    cases: dict[str, Call] = {"slow": lambda: time.sleep(0.03), "fast": lambda: None}
    timings = measure(cases, Scope(repeats=6, seconds=0.05))
    assert len(timings["slow"].samples) == 2
    assert 30 <= min(timings["slow"].samples) < 100  # ms
    assert len(timings["fast"].samples) == len(timings["fast"].sgemm) == 6


def test_the_collector_is_put_back() -> None:
    def fail() -> None:
        raise RuntimeError(f"collector: {gc.isenabled()}")

    with pytest.raises(RuntimeError, match="collector: False"):
        measure({"a": fail}, Scope())
    assert gc.isenabled()


def test_summary_of_known_samples() -> None:
    known = Measurement("search", "W", "fast", (5.0, 1.0, 2.0, 4.0, 3.0), (10.0, 30.0, 20.0), {})
    assert (known.median, known.ratio) == (3.0, 0.15)


ABOUT = ["cpu Abacus 1, load 0.2", "torch 9"]


def _row(method: str, ms: float, operation: str, **values: float) -> Measurement:
    return Measurement(operation, "W", method, (ms, 2 * ms, 3 * ms), (10.0,), values)


ROWS = [
    _row("fast", 1.0, "search", wrong=0.0),
    _row("slow", 300.0, "search", wrong=1e-6),
    _row("slow", 5.0, "other", wrong=12.0, extra=1.0),
]


def test_numbers_have_three_digits() -> None:
    texts = {0.0: "0", 8e4: "80,000", 0.01234: "0.0123", 4.123e-7: "4.1e-07", 12.345: "12.3", 1234.5: "1,234"}
    assert {value: number(value) for value in texts} == texts


def test_tables_name_the_machine_and_every_operation() -> None:
    text = as_markdown(ABOUT, Scope(quick=True), {"quantize": ROWS})
    for said in (
        "\n\ncpu Abacus 1, load 0.2\n\ntorch 9\n\n",
        f"Rounds: 15; threads: {torch.get_num_threads()}; quick.",
    ):
        assert said in text
    assert text.count("### search\n") == text.count("### other\n") == 1
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0] == ["workload", "method", "ms", "min", "n", "sgemm", "wrong"]
    assert lines[2] == ["W", "fast", "2", "1", "3", "0.2", "0"]
    assert lines[3] == ["W", "slow", "600", "300", "3", "60", "1e-06"]
    assert lines[4][-2:] == ["wrong", "extra"]


def test_the_machine_is_described() -> None:
    machine, versions = timing.describe_machine()
    assert f", torch {torch.__version__.partition('+')[0]}" in versions
    assert machine.startswith("cpu ")
    assert "None" not in machine


def test_a_package_that_is_not_installed_has_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """As pycolmap on Linux on ARM64."""
    monkeypatch.setattr(timing, "find_spec", lambda name: None if name == "pycolmap" else find_spec(name))
    _, versions = timing.describe_machine()
    assert "pycolmap" not in versions
    assert "scipy" in versions
