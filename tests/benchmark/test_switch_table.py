from __future__ import annotations

from pathlib import Path

import pytest

from nsvq_lightning.commands.benchmark.row import Row, Timing
from nsvq_lightning.commands.benchmark.settings import Settings
from nsvq_lightning.commands.benchmark.switch_table import fill_switches, scene_name, shares_saved

EMPTY = "before\n<!-- switches -->\n<!-- end -->\nafter\n"
DOCUMENTATION = Path(__file__).resolve().parents[2] / "docs" / "skips.md"


def _row(method: str, ratio: float) -> Row:
    return Row("train", "W", method, "run", 1, Timing((1.0,), (1.0,)), {"times as shipped": ratio})


def _cells(document: str, name: str) -> list[str]:
    (line,) = (line for line in document.splitlines() if line.startswith(f"| `{name}` "))
    return [cell.strip() for cell in line.split("|")[5:-1]]


def test_what_is_on_saves_what_its_absence_costs_and_what_is_off_what_it_would() -> None:
    render = Row("train", "W", "render", "warmup step", 1, Timing((1.0,), (1.0,)), {"times its render": 1.0})
    rows = [_row("as shipped", 1.0), _row("no skip of blocks", 1.25), _row("skip adam_rows", 0.9), render]
    assert shares_saved(rows) == pytest.approx({"blocks": 0.2, "adam_rows": 0.1})


def test_every_scene_gets_a_column_and_keeps_it() -> None:
    first = fill_switches(EMPTY, "fox", {"blocks": 0.2, "metrics": 0.01})
    second = fill_switches(first, "horns", {"blocks": -0.054})
    third = fill_switches(second, "fox", {"metrics": 0.03})
    assert third.startswith("before\n<!-- switches -->\n\n| switch | skips | when | result | saves on fox | saves on h")
    assert third.endswith("|\n\n<!-- end -->\nafter\n")
    assert _cells(third, "blocks") == ["20.0 %", "-5.4 %"]
    assert _cells(third, "metrics") == ["3.0 %", "–"]
    assert _cells(third, "adam_rows") == ["–", "–"]


def test_a_document_without_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="it needs the lines '<!-- switches -->'"):
        fill_switches("nothing")


def test_the_scene_is_named_after_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "fox"
    folder.mkdir()
    assert scene_name(Settings((1,), scene=folder)) == "fox"
    assert scene_name(Settings((1,), scene=tmp_path / "scene.ply")) == "demo"


def test_the_documentation_says_what_the_switches_are_now() -> None:
    page = DOCUMENTATION.read_text()
    assert fill_switches(page) == page
