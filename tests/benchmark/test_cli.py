from __future__ import annotations

import json
import logging
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nsvq_lightning.commands.benchmark import cli, timing
from nsvq_lightning.commands.benchmark.suites import loss
from nsvq_lightning.commands.main import main as nsvq
from nsvq_lightning.commands.registry import COMMANDS

SMALL = ["loss", "--quick", "--repeats", "1", "--threads", "1"]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 16)
    monkeypatch.setattr(loss, "SIZE", (40, 48))


def test_tables_go_to_the_output(capsys: pytest.CaptureFixture[str]) -> None:
    assert nsvq(["benchmark", *SMALL]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("# nsvq benchmark\n")
    assert "### forward + backward, 48x40, 1 thread\n" in printed


def test_json_goes_to_the_output_and_everything_to_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new" / "folder"
    assert cli.main([*SMALL, "--json", "--output", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {"benchmark.json", "benchmark.md", "loss.png"}
    assert (folder / "benchmark.json").read_text() == printed
    results = json.loads(printed)
    assert [row["method"] for row in results["rows"]] == ["fused", "plain torch"]
    assert results["settings"]["repeats"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lose"], "unknown benchmark suite 'lose'; choose from render"),
        (["loss", "--switches", "blocks,blokcs"], "got blokcs"),
        (["loss", "--init-from", "scene.ply"], "needs a COLMAP folder"),
        (["loss", "--threads", "1,two"], "got '1,two'"),
        (["loss", "--threads", "4096"], "at most"),
        (["loss", "--repeats", "0"], "repeats must be at least 1, got 0"),
        (["render", "--workloads", "A20k,Z"], "got Z"),
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
    assert cli.main([*SMALL, "--scene", str(tmp_path / name)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_both_scripts_know_the_word() -> None:
    assert COMMANDS["benchmark"].module == cli.__name__


def test_help_does_not_load_torch() -> None:
    code = (
        "import sys\nfrom nsvq_lightning.commands.main import main\n"
        "try:\n    main(['benchmark', '--help'])\n"
        "finally:\n    assert not {'torch', 'numba', 'lightning'} & set(sys.modules)\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert "--quick" in done.stdout


def test_suite_that_cannot_run_here_is_left_out_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with caplog.at_level(logging.INFO, logger=cli.__name__):
        assert cli.main(["gpu", "--quick", "--output", str(tmp_path)]) == 0
    assert "skipped, torch finds no CUDA device" in caplog.messages[-1]
    assert "## gpu" not in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"benchmark.json", "benchmark.md"}
