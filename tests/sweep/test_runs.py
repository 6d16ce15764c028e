"""A sweep over a tiny scene: shared trunks, the same bits as alone, failures, interruptions, the rerun."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from nsvq_lightning.commands.main import main
from nsvq_lightning.commands.sweep.cli import main as sweep_main
from nsvq_lightning.commands.sweep.plan import Request, Run, plan
from nsvq_lightning.commands.sweep.results import RunResult
from nsvq_lightning.commands.sweep.runs import Sweep
from nsvq_lightning.commands.sweep.training import Training, TrainingError, run_subprocess

OPTIONS = (
    "--data.factor=2",
    "--trainer.accelerator=cpu",
    "--model.sh_degree=1",
    "--callbacks.phases.min_density_interval=4",
    "--callbacks.phases.min_reset_interval=11",
    "--callbacks.phases.min_replacement_interval=5",
    "--callbacks.density.rules.grad_threshold=5e-6",
    "--callbacks.density.max_splats=1500",
    "--callbacks.report.every=20",
    "--callbacks.report.lpips=false",
)


class InProcess:
    """Runs ``nsvq`` here, and notes with what."""

    def __init__(self) -> None:
        self.calls: list[Sequence[str]] = []

    def __call__(self, arguments: Sequence[str], log: Path) -> int:
        self.calls.append(arguments)
        log.touch()
        return main(arguments)


@pytest.fixture(scope="module")
def configs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Two sizes (the larger with options that only matter once quantized), none, and a quantizer that cannot work."""
    folder = tmp_path_factory.mktemp("configs")
    codebooks = {"small": "{scales: 8, sh0: 8}", "large": "{scales: 32, quats: 24, sh0: 16, shN: 16}", "none": "null"}
    for name, sizes in codebooks.items():
        (folder / f"{name}.yaml").write_text(f"model: {{codebooks: {sizes}}}\n")
    with open(folder / "large.yaml", "a") as file:
        file.write("callbacks: {canonical: {mode: full}, phases: {quantize_end: 40000}}\n")
    (folder / "wrong.yaml").write_text("model: {codebooks: {sh1: 8}}\n")
    return tuple(str(folder / f"{name}.yaml") for name in (*codebooks, "wrong"))


@pytest.fixture(scope="module")
def runs(demo_scene: Path, configs: tuple[str, ...]) -> list[Run]:
    return plan(Request((demo_scene,), configs, max_steps=60, options=OPTIONS))


@pytest.fixture(scope="module")
def swept(runs: list[Run], tmp_path_factory: pytest.TempPathFactory) -> tuple[Sweep, InProcess, list[RunResult]]:
    """The sweep once it is through."""
    runner = InProcess()
    sweep = Sweep(tmp_path_factory.mktemp("sweep"), runner)
    return sweep, runner, sweep.train(runs)


def metrics_of(folder: Path) -> dict[str, object]:
    """The metrics without the times."""
    metrics = json.loads((folder / "metrics.json").read_text())
    del metrics["train_seconds"]
    for entry in (metrics["before_quantization"] or {}, *metrics["phases"]):
        entry.pop("seconds", None)
    return dict(metrics)


def test_a_run_of_a_sweep_is_the_run_alone(
    swept: tuple[Sweep, InProcess, list[RunResult]], demo_scene: Path, configs: tuple[str, ...], tmp_path: Path
) -> None:
    _, _, rows = swept
    alone = ["fit", f"--config={configs[1]}", f"--data.root={demo_scene}", "--trainer.max_steps=60", *OPTIONS]
    assert main([*alone, f"--trainer.run_folder={tmp_path / 'alone'}", "--trainer.logger=false"]) == 0
    folder = rows[1].folder
    assert (folder / "scene.nsvq").read_bytes() == (tmp_path / "alone" / "scene.nsvq").read_bytes()
    assert metrics_of(folder) == metrics_of(tmp_path / "alone")


def test_what_the_runs_share_is_trained_once(swept: tuple[Sweep, InProcess, list[RunResult]]) -> None:
    sweep, runner, rows = swept
    (trunk,) = (sweep.folder / "trunks").iterdir()
    checkpoint = f"--ckpt_path={trunk / 'checkpoints' / 'last.ckpt'}"
    assert [checkpoint in call for call in runner.calls] == [False, True, True, True, True]
    seconds = json.loads((trunk / "metrics.json").read_text())["train_seconds"]
    for row in rows[:3]:
        assert row.trunk_seconds == pytest.approx(seconds, abs=0.02)
        assert row.seconds is not None
        assert row.seconds > seconds


def test_a_run_that_fails_is_noted_and_stops_no_other(swept: tuple[Sweep, InProcess, list[RunResult]]) -> None:
    sweep, _, rows = swept
    assert [bool(row.error) for row in rows] == [False, False, False, True]
    with open(sweep.folder / "results.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [line["config"] for line in table] == ["small", "large", "none", "wrong"]
    for line, row in zip(table[:3], rows, strict=False):
        path = row.folder / "scene.nsvq"
        assert int(line["bytes"]) == path.stat().st_size < int(line["bytes_paper"])
        assert float(line["psnr"]) == metrics_of(row.folder)["psnr"]
        before = metrics_of(row.folder)["before_quantization"]
        assert (before is None) == (line["codebooks"] == "")
        assert line["psnr_before"] == (str(before["psnr"]) if isinstance(before, dict) else "")
    assert table[3]["psnr"] == ""
    assert table[3]["error"]
    assert (sweep.folder / "results.png").is_file()
    assert "Failed:" in (sweep.folder / "results.md").read_text()


def test_a_rerun_skips_what_is_finished(swept: tuple[Sweep, InProcess, list[RunResult]], runs: list[Run]) -> None:
    sweep, _, rows = swept
    runner = InProcess()
    assert Sweep(sweep.folder, runner).train(runs)[:3] == rows[:3]
    assert len(runner.calls) == 1  # what failed is tried again, from the trunk
    assert not list(sweep.folder.glob("runs/*none*/checkpoints"))


def test_settings_are_known_again_under_another_name(
    swept: tuple[Sweep, InProcess, list[RunResult]], runs: list[Run]
) -> None:
    sweep, _, rows = swept
    runner = InProcess()
    (row,) = Sweep(sweep.folder, runner).train([replace(runs[0], config="renamed")])
    assert runner.calls == []
    assert row == replace(rows[0], config="renamed")


def test_a_run_stopped_after_its_last_step_is_only_measured(
    swept: tuple[Sweep, InProcess, list[RunResult]], runs: list[Run], tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(swept[0].folder, copy)
    sweep = Sweep(copy, InProcess(), keep_checkpoints=True)
    folder = sweep.training(runs[0]).folder
    shutil.rmtree(folder)
    (first,) = sweep.train(runs[:1])
    for name in ("finished.json", "metrics.json", "scene.nsvq"):
        (folder / name).unlink()
    (second,) = sweep.train(runs[:1])
    assert second.seconds == pytest.approx(first.seconds, abs=0.05)
    assert replace(second, seconds=first.seconds) == first


def test_an_interrupted_run_goes_on_from_its_checkpoint(
    swept: tuple[Sweep, InProcess, list[RunResult]], runs: list[Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(arguments: Sequence[str], log: Path) -> int:
        """Stop at the first checkpoint after the trunk, as a killed process would."""
        from nsvq_lightning.callbacks import RunCheckpoint

        def save(self: RunCheckpoint, trainer: object, module: object) -> None:
            original(self, trainer, module)
            raise MemoryError

        original = RunCheckpoint._save
        with monkeypatch.context() as patch:
            if any("ckpt_path" in argument for argument in arguments):
                patch.setattr(RunCheckpoint, "_save", save)
            try:
                return main(arguments)
            except MemoryError:
                raise KeyboardInterrupt from None

    sweep = Sweep(tmp_path, interrupted)
    with pytest.raises(KeyboardInterrupt):
        sweep.train(runs[1:2])
    assert not (tmp_path / "results.csv").exists()
    runner = InProcess()
    (row,) = Sweep(tmp_path, runner).train(runs[1:2])
    ((*_, checkpoint),) = runner.calls  # neither the trunk nor the part that was done
    assert checkpoint == f"--ckpt_path={row.folder / 'checkpoints' / 'last.ckpt'}"
    whole = swept[2][1].folder
    assert (row.folder / "scene.nsvq").read_bytes() == (whole / "scene.nsvq").read_bytes()
    assert metrics_of(row.folder) == metrics_of(whole)


def test_a_trunk_that_fails_is_tried_once(runs: list[Run], tmp_path: Path) -> None:
    calls = []

    def fails(arguments: Sequence[str], log: Path) -> int:
        calls.append(arguments)
        log.write_text("begun\nerror: no photos here\n(NSVQ_TRACEBACK=1 shows where)\n")
        return 1

    rows = Sweep(tmp_path, fails).train(runs)
    assert len(calls) == 1
    assert all(row.error.startswith("trunk: no photos here (see ") for row in rows)


def test_a_process_that_fails_says_why(tmp_path: Path) -> None:
    training = Training(tmp_path / "run", {"a": 1})

    def info(arguments: Sequence[str], log: Path) -> int:
        return run_subprocess(["info", "missing.ply"], log)

    with pytest.raises(TrainingError, match=r"nsvq info: missing\.ply: No such file.*log\.txt"):
        training.run(info)
    with pytest.raises(TrainingError, match="killed by signal 9, perhaps for want of memory"):
        training.run(lambda arguments, log: -9)
    assert training.record is None


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a pipe with a name to hold a process up, and an alarm")
def test_an_interrupted_sweep_leaves_no_process_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *args: Any, **more: Any) -> None:
            super().__init__(*args, **more)
            started.append(self)

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    os.mkfifo(tmp_path / "never.ply")  # nobody writes into it, so reading it does not end
    monkeypatch.setattr(subprocess, "Popen", Noted)
    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.5)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_subprocess(["info", str(tmp_path / "never.ply")], tmp_path / "log.txt")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    (process,) = started
    assert process.returncode == -signal.SIGTERM


def test_the_command_says_what_it_would_do(
    demo_scene: Path, configs: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [f"--scenes={demo_scene}", f"--configs={configs[0]},plain", "--seeds=0,1", "--max-steps=60"]
    assert sweep_main(["--dry-run", "--output", str(tmp_path / "out"), *given, *OPTIONS[:3]]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert "60 iterations from trunks/scene-seed0-" in lines[0]
    assert lines[1].endswith("60 iterations from the start, new")
    assert sweep_main(["--output", str(tmp_path / "out"), "--scenes=missing"]) == 1
    assert (
        capsys.readouterr().err == "nsvq sweep: missing is no folder; --scenes takes COLMAP folders with commas "
        "between them\n"
    )
    with pytest.raises(SystemExit):
        sweep_main(["--output", str(tmp_path / "out"), "--scenes", "a", "b"])
