from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from nsvq_lightning.commands.benchmark.hardware import describe_machine
from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.suite_list import Suite
from nsvq_lightning.commands.benchmark.suite_picture import draw_suite
from nsvq_lightning.commands.benchmark.tables import as_json, as_markdown, number

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


def _row(
    method: str, ms: float, error: float, operation: str = "search", note: str = "", **values: float
) -> Measurement:
    timing = Timing((ms, 2 * ms, 3 * ms), (10.0,))
    return Measurement("nearest", "W", method, operation, 1, timing, {"wrong": error, **values}, note)


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
    text = as_markdown(MACHINE, Scope((1, 2), quick=True), ROWS)
    assert "Abacus 1 (wood), 2 of 4 cores, 256-bit vectors (avx2, fma), Linux x86_64, load average 0.2 at" in text
    assert "python 3.11.0, torch 2.0" in text
    assert "Rounds: 15; threads: 1, 2; quick." in text
    assert text.count("## nearest\n") == 1
    assert text.count("### search, W, 1 thread\n") == text.count("### other, W, 1 thread\n") == 1
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0] == ["method", "ms", "quartiles", "min", "n", "sgemm", "wrong"]
    assert lines[2] == ["fast", "2", "1.5–2.5", "1", "3", "0.2", "0"]
    assert lines[3] == ["slow", "600", "450–750", "300", "3", "60", "1e-06"]
    assert lines[4][-2:] == ["wrong", "extra"]
    assert text.endswith("\n\nOnly half.\n")


def test_workload_and_threads_are_columns_where_they_differ() -> None:
    other = [dataclasses.replace(ROWS[0], workload="V"), dataclasses.replace(ROWS[0], threads=2), ROWS[0]]
    assert "### search\n\n| workload | method | threads |" in as_markdown(MACHINE, Scope((1, 2)), other)
    assert "### search, W\n\n| method | threads |" in as_markdown(MACHINE, Scope((1, 2)), other[1:])


def test_lines_of_a_table_are_equally_long() -> None:
    lines = [line for line in as_markdown(MACHINE, Scope((1,)), ROWS[:2]).splitlines() if line[:1] == "|"]
    assert len({len(line) for line in lines}) == 1


def test_json_has_the_samples_and_nothing_but_plain_values() -> None:
    scope = Scope((1,), scene=Path("a/b.ply"), beside=(Path("a/b.spz"),))
    results = json.loads(json.dumps(as_json(MACHINE, scope, ROWS), allow_nan=False))
    assert results["machine"] == MACHINE
    assert results["settings"]["scene"] == "a/b.ply"
    assert results["settings"]["beside"] == ["a/b.spz"]
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


ERRORS = Suite("", drawn=("wrong", "extra"))


def _size(path: Path) -> tuple[int, int]:
    picture = cv2.imread(str(path))
    assert (picture != 255).any()
    return picture.shape[1], picture.shape[0]


@pytest.mark.parametrize("rows", [ROWS[:2], ROWS[:1], ROWS[1:2]], ids=["all", "only zero errors", "no zero error"])
def test_picture_has_a_panel_for_each_operation_and_value(tmp_path: Path, rows: list[Measurement]) -> None:
    draw_suite(tmp_path / "one.png", rows, ERRORS)
    draw_suite(tmp_path / "three.png", [*rows, ROWS[2]], ERRORS)
    one, three = _size(tmp_path / "one.png"), _size(tmp_path / "three.png")
    # Panels stand in two columns.
    assert 1.8 < three[0] / one[0] < 2.2
    assert 1.6 < three[1] / one[1] < 2.2


def test_first_value_is_drawn_where_the_suite_names_none(tmp_path: Path) -> None:
    draw_suite(tmp_path / "named.png", ROWS[2:], Suite("", drawn=("wrong",)))
    draw_suite(tmp_path / "first.png", ROWS[2:], Suite(""))
    assert (tmp_path / "named.png").read_bytes() == (tmp_path / "first.png").read_bytes()


def test_courses_are_drawn_alone_and_differ_from_points(tmp_path: Path) -> None:
    run = dataclasses.replace(ROWS[0], course=((0.1, 12.0), (1.0, 20.0), (2.0, 21.0)))
    draw_suite(tmp_path / "run.png", [run], ERRORS)
    draw_suite(
        tmp_path / "both.png", [run, dataclasses.replace(ROWS[0], operation="step", values={"other": 1})], ERRORS
    )
    draw_suite(tmp_path / "point.png", [ROWS[0]], ERRORS)
    assert (tmp_path / "run.png").read_bytes() == (tmp_path / "both.png").read_bytes()
    assert (tmp_path / "run.png").read_bytes() != (tmp_path / "point.png").read_bytes()


def test_shares_are_bars_as_long_as_they_are_large(tmp_path: Path) -> None:
    rows = [_row(name, ms, 0.0, **{"share %": ms}) for name, ms in (("whole", 100.0), ("a", 80.0), ("b", 20.0))]
    draw_suite(tmp_path / "bars.png", rows, Suite("", picture="shares"))
    picture = cv2.imread(str(tmp_path / "bars.png")).astype(int)
    blue = (picture[..., 0] > 150) & (picture[..., 2] < 60)
    lengths = sorted(set(blue.sum(1)) - {0})
    assert lengths[-1] / lengths[0] == pytest.approx(4, rel=0.05)


def test_picture_needs_something_to_draw(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no row has a value"):
        draw_suite(tmp_path / "x.png", [Measurement("s", "w", "m", "o", 1, Timing((1.0,), (1.0,)))], ERRORS)
