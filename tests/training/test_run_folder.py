"""A run has a folder of its own, whatever the logger, and overwrites no other."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import CSVLogger, Logger
from runs import RunFactory

from nsvq_lightning.callbacks import ExportScene, MetricReport, PhaseSchedule, RenderWriter, RunCheckpoint
from nsvq_lightning.commands.main import main
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.training.run_folder import _HELD, LOCK, MARKER, claim_version, hold, let_go, run_folder, take


class Elsewhere(Logger):
    """A logger that keeps its records somewhere else, as that of Weights & Biases does."""

    name, version, save_dir = "elsewhere", "abc", "."

    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None: ...

    def log_metrics(self, *args: Any, **kwargs: Any) -> None: ...


def callbacks() -> list[Callback]:
    return [PhaseSchedule(), ExportScene(), MetricReport(every=0), RunCheckpoint(every=2)]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("logger", [False, [Elsewhere(), Elsewhere()]], ids=["none", "two with a place of their own"])
def test_every_run_gets_the_next_version_whatever_the_logger(
    run: RunFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logger: Any, demo_scene: Path
) -> None:
    monkeypatch.chdir(tmp_path)  # where loggers that know no better write
    found = []
    for version in range(2):
        trainer, _ = run(
            callbacks(),
            max_steps=3,
            default_root_dir=tmp_path / "runs",
            logger=logger,
            module={"seed": version, "codebooks": None},
        )
        folder = run_folder(trainer)
        assert folder == tmp_path / "runs" / demo_scene.name / f"version_{version}"
        assert {"scene.nsvq", "curve.csv", "checkpoints/last.ckpt"} <= contents(folder).keys()
        assert not {MARKER, LOCK} & contents(folder).keys()
        found.append(contents(folder))
    assert contents(tmp_path / "runs" / demo_scene.name / "version_0") == found[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["runs"]


def test_a_folder_that_holds_a_run_is_refused(run: RunFactory, tmp_path: Path) -> None:
    def fit(**more: Any) -> Trainer:
        logger = CSVLogger(tmp_path, name="a", version="b", flush_logs_every_n_steps=1)
        options: dict[str, Any] = {"logger": logger, "log_every_n_steps": 1, "max_steps": 4} | more
        return run(callbacks(), module={"codebooks": None}, **options)[0]

    folder = run_folder(fit())
    assert folder == tmp_path / "a" / "b"
    before = contents(folder)
    with pytest.raises(FileExistsError, match=r"b already holds a run, and no run is overwritten: name another"):
        fit()
    assert {k: v for k, v in contents(folder).items() if k != "metrics.csv"}.items() <= before.items()
    # Only to go on from its own checkpoint is no other run.
    again = fit(ckpt_path=folder / "checkpoints" / "last.ckpt", max_steps=4)
    assert run_folder(again) == folder


def test_a_trial_leaves_no_folder(run: RunFactory, tmp_path: Path, demo_scene: Path) -> None:
    everything = [*callbacks(), RenderWriter()]
    trainer, module = run(everything, default_root_dir=tmp_path / "runs", fast_dev_run=True)
    data = ColmapDataModule(str(demo_scene), factor=2)
    (scores,) = trainer.test(module, datamodule=data, verbose=False)
    assert scores["test/psnr"] > 5
    trainer.predict(module, datamodule=data)
    assert not (tmp_path / "runs").exists()


def test_runs_that_start_together_get_different_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [claim_version(tmp_path).name for _ in range(3)] == ["version_0", "version_1", "version_2"]
    (tmp_path / "version_notes").mkdir()
    monkeypatch.setattr(Path, "glob", lambda *_: iter(()))  # another run was faster between the look and the claim
    assert claim_version(tmp_path).name == "version_3"


def taken_by(
    folder: Path, processes: int, then: Callable[[], object] = lambda: None, checkpoint: Path | None = None
) -> list[str]:
    """What each of some processes is told that take a folder at once, and live until the last one has tried."""
    if not hasattr(os, "fork"):
        pytest.skip("this system has no fork")
    fork = multiprocessing.get_context("fork")
    told, barrier = fork.SimpleQueue(), fork.Barrier(processes)

    def one() -> None:
        _HELD.clear()  # what the forked one holds is not theirs
        barrier.wait()
        try:
            take(folder, checkpoint)
            message = "taken"
        except FileExistsError as error:
            message = str(error)
        barrier.wait()
        told.put(message)
        then()

    started = [fork.Process(target=one) for _ in range(processes)]
    for process in started:
        process.start()
    messages = [told.get() for _ in started]
    for process in started:
        process.join()
    return messages


def test_of_runs_that_take_one_folder_at_once_one_gets_it(tmp_path: Path) -> None:
    for number in range(2):
        folder = tmp_path / str(number)
        won, *lost = sorted(taken_by(folder, 6), key=lambda message: message != "taken")
        assert won == "taken"
        assert len(lost) == 5
        assert all(f"another run is writing to {folder} now, process " in message for message in lost)


def test_a_killed_run_holds_no_folder_and_what_it_left_unfinished_goes(tmp_path: Path) -> None:
    def unfinished() -> None:
        with atomic_write(tmp_path / "renders" / "a.png"):
            os.kill(os.getpid(), signal.SIGKILL)

    (tmp_path / "renders").mkdir()
    last = tmp_path / "renders" / "last.ckpt"
    foreign = tmp_path / f".{os.getpid()}-0123.tmp"
    foreign.touch()  # of a process that still runs
    assert taken_by(tmp_path, 1, unfinished, last) == ["taken"]
    assert (tmp_path / MARKER).exists()
    assert len(list(tmp_path.rglob("*.tmp"))) == 2
    take(tmp_path, last)
    assert list(tmp_path.rglob("*.tmp")) == [foreign]
    assert taken_by(tmp_path, 1, checkpoint=last) == [
        f"another run is writing to {tmp_path} now, process {os.getpid()} on {os.uname().nodename}: wait until it has "
        "ended, or name another folder"
    ]
    let_go(tmp_path)
    assert not (tmp_path / MARKER).exists()
    assert not (tmp_path / LOCK).exists()


def test_a_folder_that_cannot_be_locked_is_used_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("fcntl", reason="this system has other locks")

    def no_locks(*_: object) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    hold(tmp_path)
    assert f"{tmp_path} cannot be locked (No locks available)" in caplog.text
    assert (tmp_path / MARKER).exists()
    let_go(tmp_path)
    assert not (tmp_path / MARKER).exists()


def test_nobody_continues_a_run_in_its_folder_while_it_trains(tmp_path: Path) -> None:
    (tmp_path / "scene.nsvq").touch()
    hold(tmp_path)
    (message,) = taken_by(tmp_path, 1, checkpoint=tmp_path / "checkpoints" / "last.ckpt")
    assert "another run is writing" in message
    let_go(tmp_path)
    assert taken_by(tmp_path, 1, checkpoint=tmp_path / "checkpoints" / "last.ckpt") == ["taken"]


def test_the_command_neither_overwrites_nor_loses_a_log(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mine"
    arguments = [
        *("fit", f"--data.root={demo_scene}", "--data.factor=2", "--trainer.accelerator=cpu", "--model.sh_degree=0"),
        *(f"--trainer.run_folder={folder}", "--trainer.log_every_n_steps=1"),
        *("--model.codebooks=null", "--callbacks.progress=null"),
    ]
    assert main([*arguments, "--trainer.max_steps=3"]) == 0
    before = contents(folder)
    assert {"config.yaml", "metrics.csv", "scene.nsvq"} <= before.keys()
    assert main([*arguments, "--trainer.max_steps=3"]) == 1
    assert "already holds a run" in capsys.readouterr().err
    assert contents(folder) == before
    going_on = [f"--ckpt_path={folder / 'checkpoints' / 'last.ckpt'}", "--callbacks.phases.total=3"]
    assert main([*arguments, "--trainer.max_steps=5", *going_on]) == 0
    after = contents(folder)
    assert after["scene.nsvq"] != before["scene.nsvq"]
    assert after["metrics_1.csv"] == before["metrics.csv"]


def test_the_command_refuses_processes_that_would_be_its_copies(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ["--trainer.devices=2", "--trainer.accelerator=cpu", "--trainer.strategy=view_parallel_spawn"]
    assert main(["fit", f"--data.root={demo_scene}", *given]) == 1
    assert "use --trainer.strategy=view_parallel" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
