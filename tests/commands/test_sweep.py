"""A sweep over a tiny scene: which runs it has, the same bits as alone, failures, interruptions, the rerun, tables."""

from __future__ import annotations

import argparse
import csv
import json
import os
import shlex
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml
from filelock import FileLock

from nsvq_lightning.commands import sweep as module
from nsvq_lightning.commands.main import main
from nsvq_lightning.commands.sweep import (
    NAMES,
    Row,
    Run,
    commands,
    plan,
    prepare,
    resolve,
    run_subprocess,
    sweep,
    train,
    write_results,
)
from nsvq_lightning.training.run_folder import LOCK


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Two folders: what is planned reads none of their files."""
    folder = tmp_path_factory.mktemp("scenes")
    for name in ("fox", "horns"):
        (folder / name).mkdir()
    return str(folder / "fox"), str(folder / "horns")


def planned(*arguments: str, output: Path = Path("out")) -> list[Run]:
    """The runs of ``nsvq sweep ARGUMENTS``."""
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    options, options.further = parser.parse_known_args([f"--output={output}", *arguments])
    return plan(options)


def names(runs: list[Run]) -> list[tuple[str | int, ...]]:
    return [tuple(run.names.values()) for run in runs]


def test_everything_is_combined_with_everything(scenes: tuple[str, str]) -> None:
    lists = ("--quantizers=NSVQ", "--codebooks=1k,4k", "--seeds=0,3")
    runs = planned(f"--scenes={','.join(scenes)}", *lists, "--max-steps=60")
    assert names(runs) == list(product(("fox", "horns"), ("default",), ("NSVQ",), ("1k", "4k"), (0, 3)))
    last = yaml.safe_load(runs[-1].config)
    assert last["data"]["init_args"]["root"] == scenes[1]
    assert (last["model"]["seed"], last["data"]["init_args"]["seed"]) == (3, 3)
    assert (last["model"]["codebooks"], last["trainer"]["max_steps"]) == ("4k", 60)
    assert last["model"]["quantizer"]["class_path"].endswith(".NSVQ")
    assert last["model"]["init_from"] is None
    assert runs[-1].folder.parent == Path("out/runs").resolve()
    assert runs[-1].folder.name.startswith("horns-default-NSVQ-4k-3-")


def test_a_run_starts_from_the_same_file_in_any_folder(scenes: tuple[str, str]) -> None:
    (run,) = planned(f"--scenes={scenes[0]}", "--model.init_from=a/scene.ply")
    assert yaml.safe_load(run.config)["model"]["init_from"] == str(Path("a/scene.ply").absolute())
    (run,) = planned("--data.root=~/fox")
    assert yaml.safe_load(run.config)["data"]["init_args"]["root"] == str(Path.home() / "fox")


def test_without_codebooks_there_is_one_run(scenes: tuple[str, str]) -> None:
    runs = planned(f"--scenes={scenes[0]}", "--configs=paper,plain", "--quantizers=NSVQ", "--codebooks=1k,2k,4k")
    quantized = [("fox", "paper", "NSVQ", size, "") for size in ("1k", "2k", "4k")]
    assert names(runs) == [*quantized, ("fox", "plain", "", "", "")]


def test_a_configuration_may_bring_everything(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(f"model: {{codebooks: {{scales: 8}}, seed: 5}}\ndata: {{init_args: {{root: {tmp_path}}}}}\n")
    (run,) = planned(f"--configs={own}", "--trainer.max_steps", "9")
    assert names([run]) == [(tmp_path.name, "own", "", "", "")]
    settings = yaml.safe_load(run.config)
    assert (settings["model"]["seed"], settings["model"]["codebooks"]) == (5, {"scales": 8})
    assert settings["trainer"]["max_steps"] == 9
    assert planned(f"--configs={own}", "--scenes=", "--codebooks=", "--trainer.max_steps", "9") == [run]


def test_the_short_options_of_fit_hold_for_every_run(scenes: tuple[str, str]) -> None:
    (run,) = planned(f"--scenes={scenes[0]}", "--splats", "3000")
    budget = yaml.safe_load(run.config)["callbacks"]["budget"]["init_args"]
    assert budget == {"quality": 0.9, "splats": 3000, "bytes": None, "start": 0.8}
    with pytest.raises(ValueError, match="--splats and --bytes both say"):
        planned(f"--scenes={scenes[0]}", "--splats=3000", "--bytes=100000")


def test_iterations_are_those_asked_for_however_few_photos_there_are(scenes: tuple[str, str]) -> None:
    for more, expected in (((), (4500, 20)), (("--max-steps=4400",), (4400, None))):
        (run,) = planned(f"--scenes={scenes[0]}", *more)
        config = yaml.safe_load(run.config)
        phases = config["callbacks"]["phases"]["init_args"]
        assert (config["trainer"]["max_steps"], phases["iterations_per_photo"]) == expected


def test_what_cannot_be_is_said_at_once(scenes: tuple[str, str], tmp_path: Path) -> None:
    fox = f"--scenes={scenes[0]}"
    with pytest.raises(ValueError, match="choose one of 16k"):
        planned(fox, "--codebooks=3k")
    with pytest.raises(ValueError, match="is no folder"):
        planned(f"--scenes={tmp_path / 'missing'}")
    (tmp_path / "b" / "fox").mkdir(parents=True)
    with pytest.raises(ValueError, match="two runs are called fox-default:"):
        planned(f"{fox},{tmp_path / 'b' / 'fox'}")
    for wrong in (
        "--model.no_such=1",
        "--quantizers=NoSuch",
        "--data=lightning.pytorch.demos.boring_classes.BoringDataModule",
    ):
        with pytest.raises(SystemExit):
            planned(fox, wrong)
    with pytest.raises(ValueError, match="which scenes"):
        planned("--codebooks=1k")
    with pytest.raises(SystemExit):
        planned(fox, "--max-steps=0")
    with pytest.raises(ValueError, match=r"ckpt_path=a\.ckpt"):
        planned(fox, "--ckpt_path=a.ckpt")
    with pytest.raises(ValueError, match=r"--seeds of its own; leave seed_everything=3 out"):
        planned("--seeds=0,3", "--seed_everything=3")
    with pytest.raises(ValueError, match=r"--seeds of its own; leave trainer\.run_folder=a out"):
        planned(fox, "--trainer.run_folder=a")


def test_settings_as_a_file_are_the_same_settings(tmp_path: Path) -> None:
    # 1e-07 is a string to plain YAML.
    options = ["--config=paper", "--model.rates.codebook_factor=1e-07", "--model.quantizer=NSVQ"]
    config = resolve(["--data.root=scene", "--trainer.max_steps=60", *options])
    assert yaml.safe_load(config)["model"]["rates"]["codebook_factor"] == 1e-7
    path = tmp_path / "config.yaml"
    path.write_text(config)
    assert yaml.safe_load(resolve(["--config", str(path)])) == yaml.safe_load(config)


def test_a_folder_tells_settings_and_versions_apart(scenes: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    fox = f"--scenes={scenes[0]}"
    folders = [planned(fox, *more)[0].folder for more in ((), (), ("--model.seed=1",))]
    monkeypatch.setattr(module, "__version__", "0.0.1")
    folders.append(planned(fox)[0].folder)
    assert folders[0] == folders[1]
    assert len(set(folders)) == 3


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
def runs(demo_scene: Path, configs: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    lists = f"--scenes={demo_scene}", f"--configs={','.join(configs)}"
    return planned(*lists, *OPTIONS, output=tmp_path_factory.mktemp("sweep"))


def moved(run: Run, output: Path) -> Run:
    """The run in a sweep on another folder."""
    return run._replace(folder=output / "runs" / run.folder.name)


@pytest.fixture(scope="module")
def swept(runs: list[Run]) -> Swept:
    """The sweep once it is through."""
    output = runs[0].folder.parents[1]
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
    for folder in (swept[2][0]["folder"], tmp_path / "alone"):
        assert f"<h1>{demo_scene.name}</h1>" in Path(folder, "viewer.html").read_text(encoding="utf-8")


def test_what_its_command_has_trained_is_collected(
    swept: Swept, demo_scene: Path, configs: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lists = f"--scenes={demo_scene}", f"--configs={configs[0]}", *OPTIONS
    monkeypatch.chdir(tmp_path)
    (line,) = commands(planned(*lists, output=Path("a folder")))
    monkeypatch.chdir("/")
    assert main(shlex.split(line)[1:]) == 0
    runs = planned(*lists, output=tmp_path / "a folder")
    assert list(commands(runs)) == []
    with in_process() as calls:
        (row,) = sweep(tmp_path / "a folder", runs)
    assert calls == []
    assert same(row["folder"], swept[2][0]["folder"])
    assert not (row["folder"] / "checkpoints").exists()


def test_a_failure_stops_no_other_and_a_rerun_tries_it_again(swept: Swept, runs: list[Run]) -> None:
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
        assert line["psnr_before"] == ("" if line["config"] == "none" else str(before["psnr"]))
    assert table[2]["psnr"] == ""
    assert table[2]["error"]
    assert "Failed:" in (output / "results.md").read_text()
    with in_process() as calls:
        again = sweep(output, runs)
    assert again[:2] == rows[:2]
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

    original, first = RunCheckpoint._save, moved(runs[0], tmp_path)
    with in_process(), monkeypatch.context() as patch:
        patch.setattr(RunCheckpoint, "_save", save)
        with pytest.raises(Killed):
            sweep(tmp_path, [first])
    assert not (tmp_path / "results.csv").exists()
    own = f"--ckpt_path={first.folder / 'checkpoints' / 'last.ckpt'}"
    config = first.folder / "config.yaml"
    config.write_text(begun := config.read_text() + "# iterations of its minutes\n")
    (line,) = commands([first])
    assert shlex.split(line)[-1] == own
    assert config.read_text() == begun
    with in_process() as calls:
        (row,) = sweep(tmp_path, [first], keep_checkpoints=True)
    assert [call[-1] for call in calls] == [own]
    assert same(row["folder"], swept[2][0]["folder"])
    for name in ("metrics.json", "scene.nsvq"):  # as if stopped after its last step: it is only measured
        (row["folder"] / name).unlink()
    with in_process():
        (second,) = sweep(tmp_path, [first])
    assert second["seconds"] == pytest.approx(row["seconds"], abs=0.05)
    assert second | {"seconds": row["seconds"]} == row


def test_a_process_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def info(arguments: Sequence[str], log: Path) -> int:
        return run_subprocess(["info", "missing.ply"], log)

    run = Run({}, "a: 1\n", tmp_path / "run")
    monkeypatch.setattr(module, "run_subprocess", info)
    reason = train(run)
    assert reason.startswith("nsvq info: missing.ply: No such file")
    assert reason.endswith("log.txt)")
    monkeypatch.setattr(module, "run_subprocess", lambda arguments, log: -9)
    assert train(run).startswith("killed by signal 9, perhaps for want of memory")
    monkeypatch.setattr(module, "run_subprocess", lambda arguments, log: 0)
    assert train(run).startswith("the run has left no metrics.json")


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
    run = moved(runs[0], tmp_path)
    with held(run.folder):
        (run.folder / "metrics.csv").touch()
        assert list(commands([run])) == []
        assert train(run).startswith(f"another run is writing to {run.folder} now")
        assert (run.folder / "metrics.csv").exists()
    prepare(run)  # nobody trains there any more
    assert not (run.folder / "metrics.csv").exists()


def row(seed: int = 0, psnr: float | None = 30.0, **other: object) -> Row:
    """The row of a run that was made up."""
    values = {"scene": "fox", "config": "nsvq", "quantizer": "NSVQ", "codebooks": "1k", "splats": 7}
    values |= {"ssim": 0.9, "bytes": 2_000_000, "seconds": 50.0, "psnr_before": 31.0}
    return values | {"seed": seed, "psnr": psnr, "folder": Path("none"), "error": ""} | other


def table_of(output: Path, rows: list[Row]) -> list[list[str]]:
    """The cells of ``results.md``, without those of its head."""
    write_results(output, rows)
    lines = [line for line in (output / "results.md").read_text().splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_mean_and_spread_are_over_the_seeds(tmp_path: Path) -> None:
    fox = [row(0, 30.0), row(1, 31.0), row(2, 35.0)]
    (line,) = table_of(tmp_path, fox)
    assert line[len(NAMES) + 1] == "32.00 ± 2.65"  # ((2² + 1² + 3²) / 2)^½
    (line,) = table_of(tmp_path, fox[:1])
    assert line[len(NAMES) + 1] == "30.00"


def test_an_infinite_psnr_is_no_number_and_a_failed_run_no_member(tmp_path: Path) -> None:
    (line,) = table_of(tmp_path, [row(0, None), row(1, 31.0), row(2, error="out of luck", psnr=None)])
    assert line[len(NAMES) :][:2] == ["2", "31.00"]
    (line,) = table_of(tmp_path, [row(0, None)])
    assert line[len(NAMES) :][:2] == ["1", "–"]


def test_the_table_has_a_line_a_group_and_names_failures(tmp_path: Path) -> None:
    rows = [row(0, 30.0), row(1, 31.0), row(0, 20.0, scene="horns"), row(0, codebooks="4k", error="killed by signal 9")]
    fox, horns = table_of(tmp_path, rows)
    assert fox == [
        *("fox", "nsvq", "NSVQ", "1k", "2", "30.50 ± 0.71", "0.9000 ± 0.0000"),
        *("2,000,000 ± 0", "7 ± 0", "31.00 ± 0.00", "50 ± 0", "–"),
    ]
    assert horns[:6] == ["horns", "nsvq", "NSVQ", "1k", "1", "20.00"]
    assert "* fox, nsvq, 4k, seed 0: killed by signal 9" in (tmp_path / "results.md").read_text()


def test_differences_are_paired_by_seed(tmp_path: Path) -> None:
    first = [row(seed, 30.0 + seed) for seed in range(5)]
    better = [row(seed, 30.1 + seed + 0.01 * (seed % 2), config="better") for seed in (1, 4, 3, 2, 7)]
    chance = [row(seed, 30.0 + seed + change, config="chance") for seed, change in enumerate((0.2, -0.1, 0.1))]
    alone = [row(9, 31.0, config="alone"), row(0, 30.5, config="one"), row(1, None, config="none")]
    lines = table_of(tmp_path, [*first, *better, *chance, *alone, row(scene="horns")])
    # Of 0.11, 0.10, 0.11, 0.10: the deviation is 0.01 / √3, over √4 of them.
    assert [line[-1] for line in lines] == [
        "–", "+0.105 ± 0.003", "+0.067 ± 0.088, noise", "–", "+0.50, one seed", "–", "–",
    ]  # fmt: skip


def test_equal_runs_differ_by_noise(tmp_path: Path) -> None:
    runs = [row(seed, 30.0 + seed, config=config) for config in ("a", "b") for seed in range(3)]
    assert [line[-1] for line in table_of(tmp_path, runs)] == ["–", "+0.000 ± 0.000, noise"]
