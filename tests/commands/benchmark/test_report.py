from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.commands.benchmark.report import as_json, as_markdown, describe_machine, draw_suite, number
from nsvq_lightning.commands.benchmark.timing import Measurement, Timing

MACHINE: dict[str, Any] = {**describe_machine(), "cpu": "Abacus 1", "usable_cores": 2, "cores": 4, "load_average": 0.25}


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
    text = as_markdown(MACHINE, Scope((1, 2), quick=True), {"quantize": ROWS})
    for said in ("Abacus 1 (", "), 2 of 4 cores, ", ", load average 0.2 at", "Rounds: 15; threads: 1, 2; quick."):
        assert said in text
    assert text.count("### search, W, 1 thread\n") == text.count("### other, W, 1 thread\n") == 1
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0] == ["method", "ms", "quartiles", "min", "n", "sgemm", "wrong"]
    assert lines[2] == ["fast", "2", "1.5–2.5", "1", "3", "0.2", "0"]
    assert lines[3] == ["slow", "600", "450–750", "300", "3", "60", "1e-06"]
    assert lines[4][-2:] == ["wrong", "extra"]
    assert text.endswith("\n\nOnly half.\n")
    other = [dataclasses.replace(ROWS[0], workload="V"), dataclasses.replace(ROWS[0], threads=2), ROWS[0]]
    assert "### search\n\n| workload | method | threads |" in as_markdown(MACHINE, Scope((1, 2)), {"quantize": other})


def test_json_has_the_samples_and_nothing_but_plain_values() -> None:
    scope = Scope((1,), scene=Path("a/b.ply"), beside=(Path("a/b.spz"),))
    results = json.loads(as_json(MACHINE, scope, {"quantize": ROWS}))
    assert results["machine"] == MACHINE
    assert (results["settings"]["scene"], results["settings"]["beside"]) == ("a/b.ply", ["a/b.spz"])
    first, _, last = results["rows"]
    assert first["suite"] == "quantize"
    assert first["timing"] == {"samples": [1, 2, 3], "sgemm": [10]}
    assert (first["median_ms"], first["sgemm_ratio"]) == (2, pytest.approx(0.2))
    assert last["values"] == {"wrong": 12, "extra": 1}


def test_picture_has_a_panel_for_each_operation(tmp_path: Path) -> None:
    run, part = (dataclasses.replace(ROWS[0], operation=name) for name in ("run", "parts of a step"))
    sizes = []
    for rows in (ROWS[:2], [*ROWS, dataclasses.replace(part, values={"share %": 9.0})], [*ROWS, run]):
        draw_suite(tmp_path / "drawn.png", rows)
        sizes.append(cv2.imread(str(tmp_path / "drawn.png")).shape)
    # Panels stand in two columns.
    assert 1.8 < sizes[1][1] / sizes[0][1] < 2.2
    assert 1.6 < sizes[2][0] / sizes[1][0] < 2.2
