from __future__ import annotations

from pathlib import Path

import pytest

from nsvq_lightning.commands.benchmark import SUITES, render, timing
from nsvq_lightning.commands.main import main
from nsvq_lightning.skips import SKIPS

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_results_are_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 16)
    monkeypatch.setattr(render, "PHOTO", (40, 48, 3))
    monkeypatch.setattr(render, "workloads", lambda _: [])
    assert main(["benchmark", "render", "--quick", "--repeats", "1"]) == 0
    _, _, table = capsys.readouterr().out.partition(f"### {render.LOSS}\n\n")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    assert [row[:2] for row in rows] == [["48x40", "fused, cpu"], ["48x40", "plain torch, cpu"]]


@pytest.mark.parametrize(("name", "message"), [("none.ply", "No such file"), ("bad.ply", "bad.ply"), ("x.md", ".md")])
def test_unreadable_scene_is_one_line(
    name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat nothing\n")
    assert main(["benchmark", "render", "--quick", "--scene", str(tmp_path / name)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_every_suite_and_switch_has_measured_tables() -> None:
    index, explained = (DOCS / "benchmark.md").read_text(), (DOCS / "skips.md").read_text()
    assert {page.stem for page in (DOCS / "measured").glob("*.md")} == set(SUITES)
    assert all(f"[measured](measured/{name}.md)" in index for name in SUITES)
    for name, about in SKIPS.items():
        work, when = about.removeprefix("skip ").split(": ")
        assert f"| `{name}` | {work} | {when} |\n" in explained
        assert f"| `{name}` " in (DOCS / "measured" / "train.md").read_text()
