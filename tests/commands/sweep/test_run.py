"""A sweep over a tiny scene: the same bits as alone, failures, interruptions, the rerun."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from nsvq_lightning.commands.main import main
from nsvq_lightning.commands.sweep import run as module
from nsvq_lightning.commands.sweep.plan import Run, plan
from nsvq_lightning.commands.sweep.results import Row
from nsvq_lightning.commands.sweep.run import commands, folder_of, prepare, run_subprocess, sweep, train
from nsvq_lightning.training.run_folder import LOCK

Calls = list[Sequence[str]]

Swept = tuple[Path, Calls, list[Row]]
"""Folder, what was run, and the rows."""

OPTIONS = [
    *("--data.factor=4", "--trainer.accelerator=cpu", "--trainer.max_steps=16", "--model.sh_degree=0", "--splats=400"),
    *("--callbacks.report.pictures=false", "--callbacks.report.every=0", "--callbacks.report.lpips=false"),
]


@contextmanager
def in_process() -> Iterator[Calls]:
    """Runs ``nsvq`` here, and notes with what."""
    calls: Calls = []

    def run(arguments: Sequence[str], log: Path) -> int:
        calls.append(arguments)
        log.touch()
        return main(arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "run_subprocess", run)
        yield calls


@pytest.fixture(scope="module")
def configs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """A size, no codebooks, and a quantizer that cannot work."""
    folder = tmp_path_factory.mktemp("configs")
    codebooks = {"small": "{scales: 8, sh0: 8}", "none": "null", "wrong": "{sh1: 8}"}
    for name, sizes in codebooks.items():
        (folder / f"{name}.yaml").write_text(f"model: {{codebooks: {sizes}}}\n")
    return tuple(str(folder / f"{name}.yaml") for name in codebooks)


@pytest.fixture(scope="module")
def runs(demo_scene: Path, configs: tuple[str, ...]) -> list[Run]:
    return plan([demo_scene], configs, options=OPTIONS)


@pytest.fixture(scope="module")
def swept(runs: list[Run], tmp_path_factory: pytest.TempPathFactory) -> Swept:
    """The sweep once it is through."""
    output = tmp_path_factory.mktemp("sweep")
    with in_process() as calls:
        return output, calls, sweep(output, runs)


def metrics_of(folder: Path) -> dict[str, Any]:
    """The metrics without the times."""
    metrics = json.loads((folder / "metrics.json").read_text())
    del metrics["train_seconds"]
    for entry in (metrics["before_quantization"] or {}, *metrics["phases"]):
        entry.pop("seconds", None)
    return dict(metrics)


def same(folder: Path, other: Path) -> bool:
    bytes_alike = (folder / "scene.nsvq").read_bytes() == (other / "scene.nsvq").read_bytes()
    return bytes_alike and metrics_of(folder) == metrics_of(other)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """As if another process wrote to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / LOCK):
        yield


def test_a_run_of_a_sweep_is_the_run_alone(
    swept: Swept, demo_scene: Path, configs: tuple[str, ...], tmp_path: Path
) -> None:
    alone = ["fit", f"--config={configs[0]}", f"--data.root={demo_scene}", *OPTIONS]
    assert main([*alone, f"--trainer.run_folder={tmp_path / 'alone'}", "--trainer.logger=false"]) == 0
    assert same(swept[2][0]["folder"], tmp_path / "alone")


def test_what_its_command_has_trained_is_collected(
    swept: Swept, runs: list[Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "a folder"
    monkeypatch.chdir(tmp_path)
    (line,) = commands(Path("a folder"), runs[:1])
    monkeypatch.chdir("/")
    assert main(shlex.split(line)[1:]) == 0
    assert list(commands(output, runs[:1])) == []
    with in_process() as calls:
        (row,) = sweep(output, runs[:1])
    assert calls == []
    assert same(row["folder"], swept[2][0]["folder"])
    assert not (row["folder"] / "checkpoints").exists()


def test_a_failure_stops_no_other_and_a_rerun_tries_it_again_under_any_name(swept: Swept, runs: list[Run]) -> None:
    output, calls, rows = swept
    assert len(calls) == 3
    assert [bool(row["error"]) for row in rows] == [False, False, True]
    with open(output / "results.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [line["config"] for line in table] == ["small", "none", "wrong"]
    for line, row in zip(table[:2], rows, strict=False):
        size = (row["folder"] / "scene.nsvq").stat().st_size
        assert int(line["bytes"]) == size < int(line["bytes_paper"])
        assert float(line["psnr"]) == metrics_of(row["folder"])["psnr"]
        before = metrics_of(row["folder"])["before_quantization"]
        assert line["psnr_before"] == ("" if line["codebooks"] == "" else str(before["psnr"]))
    assert table[2]["psnr"] == ""
    assert table[2]["error"]
    assert (output / "results.png").is_file()
    assert "Failed:" in (output / "results.md").read_text()
    renamed = replace(runs[0], names=runs[0].names | {"config": "renamed"})
    with in_process() as calls:
        again = sweep(output, [renamed, *runs[1:]])
    assert again[:2] == [rows[0] | {"config": "renamed"}, rows[1]]
    assert len(calls) == 1
    assert not list(output.glob("runs/*none*/checkpoints"))


def test_an_interrupted_run_goes_on_from_its_checkpoint(
    swept: Swept, runs: list[Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nsvq_lightning.callbacks import RunCheckpoint

    class Killed(BaseException):
        """No error that the command turns into a line."""

    def save(self: RunCheckpoint, trainer: Any, module: Any) -> None:
        original(self, trainer, module)
        raise Killed

    original = RunCheckpoint._save
    with in_process(), monkeypatch.context() as patch:
        patch.setattr(RunCheckpoint, "_save", save)
        with pytest.raises(Killed):
            sweep(tmp_path, runs[:1])
    assert not (tmp_path / "results.csv").exists()
    own = f"--ckpt_path={folder_of(tmp_path, runs[0]) / 'checkpoints' / 'last.ckpt'}"
    (line,) = commands(tmp_path, runs[:1])
    assert shlex.split(line)[-1] == own
    with in_process() as calls:
        (row,) = sweep(tmp_path, runs[:1], keep_checkpoints=True)
    assert [call[-1] for call in calls] == [own]
    assert same(row["folder"], swept[2][0]["folder"])
    for name in ("metrics.json", "scene.nsvq"):  # as if stopped after its last step: it is only measured
        (row["folder"] / name).unlink()
    with in_process():
        (second,) = sweep(tmp_path, runs[:1])
    assert second["seconds"] == pytest.approx(row["seconds"], abs=0.05)
    assert second | {"seconds": row["seconds"]} == row


def test_a_process_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def info(arguments: Sequence[str], log: Path) -> int:
        return run_subprocess(["info", "missing.ply"], log)

    monkeypatch.setattr(module, "run_subprocess", info)
    reason = train(tmp_path / "run", {"a": 1})
    assert reason.startswith("nsvq info: missing.ply: No such file")
    assert reason.endswith("log.txt)")
    monkeypatch.setattr(module, "run_subprocess", lambda arguments, log: -9)
    assert train(tmp_path / "run", {}).startswith("killed by signal 9, perhaps for want of memory")
    monkeypatch.setattr(module, "run_subprocess", lambda arguments, log: 0)
    assert train(tmp_path / "run", {}).startswith("the run has left no metrics.json")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a pipe with a name to hold a process up, and an alarm")
def test_an_interrupted_sweep_leaves_no_process_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *args: Any, **more: Any) -> None:
            super().__init__(*args, **more)
            started.append(self)

    os.mkfifo(tmp_path / "never.ply")  # nobody writes into it, so reading it does not end
    monkeypatch.setattr(subprocess, "Popen", Noted)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.5)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_subprocess(["info", str(tmp_path / "never.ply")], tmp_path / "log.txt")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    (process,) = started
    assert process.returncode == -signal.SIGTERM


def test_the_command_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", f"--output={tmp_path}", "--scenes=missing"]) == 1
    problem = "missing is no folder; --scenes takes COLMAP folders with commas between them"
    assert capsys.readouterr().err == f"nsvq sweep: {problem}\n"


def test_what_another_process_writes_is_left_alone(
    demo_scene: Path, runs: list[Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with held(tmp_path):
        assert main(["sweep", f"--output={tmp_path}", f"--scenes={demo_scene}"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"nsvq sweep: another run is writing to {tmp_path} now")
    folder = folder_of(tmp_path, runs[0])
    with held(folder):
        (folder / "metrics.csv").touch()
        assert list(commands(tmp_path, runs[:1])) == []
        assert train(folder, {}).startswith(f"another run is writing to {folder} now")
        assert (folder / "metrics.csv").exists()
    prepare(folder, {})  # nobody trains there any more
    assert not (folder / "metrics.csv").exists()
