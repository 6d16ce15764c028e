from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from nsvq_lightning.commands.benchmark import cli, render, timing, train
from nsvq_lightning.commands.benchmark.cli import SUITES
from nsvq_lightning.commands.main import main as nsvq
from nsvq_lightning.skips import SKIPS

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 16)
    monkeypatch.setattr(render, "PHOTO", (40, 48, 3))
    monkeypatch.setattr(render, "workloads", lambda _: [])


def test_results_go_to_the_output_and_everything_to_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["benchmark", "render", "--quick", "--repeats", "1", "--threads", "1"]
    assert nsvq(arguments) == 0
    assert f"### {render.LOSS}, 48x40, 1 thread\n" in capsys.readouterr().out
    folder = tmp_path / "new" / "folder"
    assert nsvq([*arguments, "--json", "--output", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {"benchmark.json", "benchmark.md", "render.png"}
    assert (folder / "benchmark.json").read_text() == printed
    assert [row["method"] for row in json.loads(printed)["rows"]] == ["fused, cpu", "plain torch, cpu"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["train,rendre"],
            "unknown benchmark suite 'train,rendre'; choose from render, quantize, codec, train, or all",
        ),
        (["train", "--switches", "blocks,blokcs"], "got blokcs"),
        (["render", "--init-from", "scene.ply"], "needs a COLMAP folder"),
        (["render", "--threads", "1,two"], "got '1,two'"),
        (["render", "--threads", "4096"], "at most"),
        (["render", "--repeats", "0"], "repeats must be at least 1, got 0"),
        (["render", "--steps", "3"], "steps must be at least 4, one for each phase, got 3"),
        (["render", "--workloads", "A20k,Z"], "some of A20k, B100k, C500k, D1M, E3M, got Z"),
    ],
)
def test_wrong_arguments_are_explained(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main(arguments)
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("name", "message"), [("none.ply", "No such file"), ("bad.ply", "bad.ply"), ("x.md", ".md")])
def test_unreadable_scene_is_one_line(
    name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat nothing\n")
    assert cli.main(["render", "--quick", "--scene", str(tmp_path / name)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_help_does_not_load_torch() -> None:
    code = (
        "import sys\nfrom nsvq_lightning.commands.main import main\n"
        "try:\n    main(['benchmark', '--help'])\n"
        "finally:\n    assert not {'torch', 'numba', 'lightning'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=DOCS.parent)
    assert "--quick" in done.stdout


def test_every_suite_and_switch_has_measured_tables() -> None:
    index, explained = (DOCS / "benchmark.md").read_text(), (DOCS / "skips.md").read_text()
    assert {page.stem for page in (DOCS / "measured").glob("*.md")} == set(SUITES)
    assert all(f"[measured](measured/{name}.md)" in index for name in SUITES)
    for name, skip in SKIPS.items():
        assert f"| `{name}` | {skip.work} | {skip.when} |\n" in explained
        assert f"| `{name}` " in (DOCS / "measured" / "train.md").read_text()


@pytest.mark.slow
def test_quick_run_of_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert cli.main(["all", "--quick", "--output", str(tmp_path)]) == 0
    assert {path.stem for path in tmp_path.glob("*.png")} == set(SUITES)
    rows = json.loads((tmp_path / "benchmark.json").read_text())["rows"]
    (peak,) = (row["values"]["peak MB"] for row in rows if row["operation"] == train.ALONE)
    assert 100 < peak < 3000 or sys.platform != "linux"
