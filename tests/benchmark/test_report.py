from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from nsvq_lightning.benchmark.machine import describe_machine
from nsvq_lightning.benchmark.plot import draw_suite
from nsvq_lightning.benchmark.report import as_json, as_markdown, number
from nsvq_lightning.benchmark.row import Row, Timing
from nsvq_lightning.benchmark.settings import Settings

MACHINE: dict[str, Any] = {
    "cpu": "Abacus 1",
    "llvm_cpu": "wood",
    "cores": 4,
    "usable_cores": 2,
    "simd_bits": 256,
    "simd": ["avx2", "fma"],
    "gpu": None,
    "system": "Linux x86_64",
    "load_average": 0.25,
    "versions": {"python": "3.11.0", "torch": "2.0"},
}


def _row(method: str, ms: float, error: float, operation: str = "search", note: str = "", **values: float) -> Row:
    timing = Timing((ms, 2 * ms, 3 * ms), (10.0,))
    return Row("nearest", "W", method, operation, 1, timing, {"wrong": error, **values}, note)


ROWS = [_row("fast", 1.0, 0.0), _row("slow", 300.0, 1e-6), _row("slow", 5.0, 12.0, "other", note="only half", extra=1)]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (80000.0, "80,000"),
        (0.01234, "0.0123"),
        (4.123e-7, "4.1e-07"),
        (12.345, "12.3"),
        (1234.5, "1,234"),
        (3.0, "3"),
    ],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_tables_name_the_machine_and_every_operation() -> None:
    text = as_markdown(MACHINE, Settings((1, 2), quick=True), ROWS)
    assert "Abacus 1 (wood), 2 of 4 cores, 256-bit vectors (avx2, fma), Linux x86_64, load average 0.2 at" in text
    assert "python 3.11.0, torch 2.0" in text
    assert "Rounds: 15; threads: 1, 2; quick." in text
    assert text.count("## nearest\n") == 1
    assert text.count("### search\n") == text.count("### other\n") == 1
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0] == ["workload", "method", "threads", "ms", "quartiles", "min", "n", "sgemm", "wrong"]
    assert lines[2] == ["W", "fast", "1", "2", "1.5–2.5", "1", "3", "0.2", "0"]
    assert lines[3] == ["W", "slow", "1", "600", "450–750", "300", "3", "60", "1e-06"]
    assert lines[4][-2:] == ["wrong", "extra"]
    assert text.endswith("\n\nOnly half.\n")


def test_lines_of_a_table_are_equally_long() -> None:
    lines = [line for line in as_markdown(MACHINE, Settings((1,)), ROWS[:2]).splitlines() if line[:1] == "|"]
    assert len({len(line) for line in lines}) == 1


def test_json_has_the_samples_and_nothing_but_plain_values() -> None:
    results = json.loads(json.dumps(as_json(MACHINE, Settings((1,), scene=Path("a/b.ply")), ROWS), allow_nan=False))
    assert results["machine"] == MACHINE
    assert results["settings"]["scene"] == "a/b.ply"
    assert results["settings"]["threads"] == [1]
    assert [row["samples_ms"] for row in results["rows"]][:2] == [[1, 2, 3], [300, 600, 900]]
    assert results["rows"][0]["median_ms"] == 2
    assert results["rows"][0]["sgemm_ratio"] == pytest.approx(0.2)
    assert results["rows"][2]["values"] == {"wrong": 12, "extra": 1}


def test_this_machine_can_be_described() -> None:
    machine = describe_machine()
    json.dumps(machine, allow_nan=False)
    assert machine.keys() == MACHINE.keys()
    assert machine["cpu"]
    assert 1 <= machine["usable_cores"] <= machine["cores"]
    assert machine["simd_bits"] in (32, 128, 256, 512)
    assert machine["versions"].keys() == {"nsvq-lightning", "python", "numpy", "torch", "numba", "llvmlite"}


@pytest.mark.parametrize("rows", [ROWS, ROWS[:1], ROWS[1:2]], ids=["all", "only zero errors", "no zero error"])
def test_picture_shows_one_panel_an_operation(tmp_path: Path, rows: list[Row]) -> None:
    path = tmp_path / "nearest.png"
    draw_suite(path, rows)
    picture = cv2.imread(str(path))
    panels = len({row.operation for row in rows})
    assert picture.shape[1] / picture.shape[0] > 1.1 * panels
    assert (picture != 255).any()


def test_picture_needs_something_to_draw(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no row has a value"):
        draw_suite(tmp_path / "x.png", [Row("s", "w", "m", "o", 1, Timing((1.0,), (1.0,)))])
