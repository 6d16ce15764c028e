"""Runs that are stopped in any phase, in any way, and continued: every bit is that of the run not interrupted.

Most start from a checkpoint shortly before their trouble, which the run that nothing interrupts has left.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from checkpoints import assert_same, assert_same_end, iteration_of, read
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException
from runs import RECIPE_MODULE, Recipe, RunFactory, Whole, paper_phases, recipe_options

from nsvq_lightning.callbacks import MetricReport, PhaseSchedule, RunCheckpoint, SplatSelection
from nsvq_lightning.commands.fit import continuation
from nsvq_lightning.commands.main import main
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import run_folder
from nsvq_lightning.training.schedule import Schedule

PHASES = {"warmup": 13, "prune": 26, "quantize": 43, "finetune": 59}
"""An iteration of each phase, of the 60 of either run."""

FIRST_OF_PHASE = {"prune": 21, "quantize": 28, "finetune": 58}


class Broken(Exception):
    """What goes wrong in the tests."""


class Trouble(Callback):
    """Calls ``act`` at one hook of one iteration."""

    def __init__(self, iteration: int, act: Callable[[], object], hook: str = "on_after_backward") -> None:
        self.iteration, self.act, self.struck = iteration, act, False
        setattr(self, hook, self._strike)

    def _strike(self, trainer: Trainer, pl_module: LightningModule, *args: Any) -> None:
        iteration = trainer.global_step + (self.act is not fail_late)
        if iteration == self.iteration and not self.struck:
            self.struck = True
            self.act()


def fail() -> None:
    raise Broken


def fail_late() -> None:
    """In a hook after the update, where the trainer has already counted the iteration."""
    raise Broken


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def terminate() -> None:
    signal.raise_signal(signal.SIGTERM)


KINDS: dict[str, tuple[Callable[[], None], type[BaseException]]] = {
    "SIGINT": (interrupt, SystemExit),
    "SIGTERM": (terminate, SIGTERMException),
}
"""What happens between backward pass and update, and what it ends with."""


SETTINGS: dict[str, tuple[Callable[[], dict[str, Any]], dict[str, Any]]] = {
    "paper": (dict, {}),
    "fast": (recipe_options, RECIPE_MODULE),
}


class Runner:
    """Runs with one of the ``SETTINGS``."""

    def __init__(self, run: RunFactory, recipe: Recipe, name: str, **trainer: Any) -> None:
        self.run, self.recipe, self.trainer = run, recipe, trainer
        self.options, self.module = SETTINGS[name]

    def __call__(self, *more: Callback, checkpoint: RunCheckpoint, ckpt_path: Path | None = None) -> Path:
        callbacks = self.recipe(**self.options(), checkpoint=checkpoint).values()
        trainer, _ = self.run([*callbacks, *more], ckpt_path, self.module, **self.trainer)
        return run_folder(trainer)

    def stopped(
        self, ends_with: type[BaseException], trouble: Callback, every: int = 0, start: Path | None = None
    ) -> Path:
        """The checkpoint that a run leaves that gets into trouble, itself continued from ``start``."""
        checkpoint = RunCheckpoint(every=every)
        with pytest.raises(ends_with):
            self(trouble, checkpoint=checkpoint, ckpt_path=start)
        assert checkpoint.last_path is not None
        assert sorted(os.listdir(checkpoint.last_path.parent)) == ["last.ckpt"]
        return checkpoint.last_path

    def continued(self, path: Path) -> Path:
        return self(checkpoint=RunCheckpoint(every=0), ckpt_path=path)


@pytest.fixture(scope="session")
def whole(paper: Whole, fast: Whole) -> Callable[[str], Path]:
    """Folder of the run that nothing interrupts, by the name of its settings."""
    return {"paper": paper.folder, "fast": fast.folder}.__getitem__


def shortly_before(whole: Path, iteration: int) -> Path:
    """A checkpoint of the whole run, such that one more iteration at least is complete before this one."""
    return whole / "checkpoints" / f"step-{(iteration - 2) // 4 * 4}.ckpt"


def check(runner: Runner, whole: Path, kind: str, iteration: int) -> None:
    act, ends_with = KINDS[kind]
    path = runner.stopped(ends_with, Trouble(iteration, act), start=shortly_before(whole, iteration))
    assert iteration_of(path) == iteration
    assert_same_end(runner.continued(path), whole)


FAST = {("paper", "SIGINT", "warmup"), ("fast", "SIGINT", "quantize"), ("fast", "SIGTERM", "finetune")}
CASES = [
    pytest.param(*case, marks=[] if case in FAST else pytest.mark.slow)
    for case in ((name, kind, phase) for name in SETTINGS for kind in KINDS for phase in PHASES)
]


@pytest.mark.parametrize(("name", "kind", "phase"), CASES)
def test_a_stopped_run_continues_to_the_same_bits(
    name: str, kind: str, phase: str, run: RunFactory, recipe: Recipe, whole: Callable[[str], Path]
) -> None:
    check(Runner(run, recipe, name), whole(name), kind, PHASES[phase])


@pytest.mark.parametrize(
    "phase", [pytest.param(phase, marks=[] if phase == "prune" else pytest.mark.slow) for phase in FIRST_OF_PHASE]
)
def test_an_exception_in_the_first_iteration_of_a_phase_leaves_a_checkpoint_of_the_phase_before(
    phase: str, run: RunFactory, recipe: Recipe, whole: Callable[[str], Path]
) -> None:
    runner, iteration = Runner(run, recipe, "paper"), FIRST_OF_PHASE[phase]
    start = shortly_before(whole("paper"), iteration - 1)
    path = runner.stopped(Broken, Trouble(iteration, fail), every=100, start=start)
    # Once codebooks are placed or codes frozen there is no way back; the checkpoint is that of the end of the phase.
    assert iteration_of(path) == iteration - 1
    assert_same_end(runner.continued(path), whole("paper"))


def test_an_exception_after_the_update_leaves_the_periodic_checkpoint(
    run: RunFactory, recipe: Recipe, whole: Callable[[str], Path], caplog: pytest.LogCaptureFixture
) -> None:
    runner = Runner(run, recipe, "paper")
    start = shortly_before(whole("paper"), 40)
    path = runner.stopped(Broken, Trouble(47, fail_late, "on_train_batch_end"), every=20, start=start)
    assert iteration_of(path) == 40
    assert f"stopped; the last checkpoint is of iteration 40: {path}" in caplog.messages
    assert_same_end(runner.continued(path), whole("paper"))


def test_a_callback_that_fails_half_way_acts_again(
    run: RunFactory, recipe: Recipe, whole: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    # That it has acted is noted before it has; the checkpoint must not know of it.
    runner = Runner(run, recipe, "fast")
    with monkeypatch.context() as patch:
        patch.setattr(SplatSelection, "before_step", lambda *given: fail() if given[-1] == 25 else None)
        path = runner.stopped(Broken, Callback(), every=4, start=shortly_before(whole("fast"), 24))
    assert iteration_of(path) == 24
    assert_same_end(runner.continued(path), whole("fast"))


def test_signals_wait_for_the_last_micro_batch(run: RunFactory, recipe: Recipe) -> None:
    runner = Runner(run, recipe, "paper", accumulate_grad_batches=3, max_steps=15)
    reference = runner(checkpoint=RunCheckpoint(every=0))
    path = runner.stopped(SIGTERMException, Trouble(8, terminate))  # in the first of three
    assert iteration_of(path) == 8
    assert (runner.continued(path) / "scene.nsvq").read_bytes() == (reference / "scene.nsvq").read_bytes()


def test_handlers_of_signals_are_given_back(run: RunFactory, recipe: Recipe) -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    runner = Runner(run, recipe, "paper", max_steps=8)
    runner(checkpoint=RunCheckpoint(every=0))
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    runner.stopped(Broken, Trouble(3, fail), every=2)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_signal_in_the_last_evaluation_waits_for_the_last_checkpoint(
    run: RunFactory, recipe: Recipe, whole: Callable[[str], Path]
) -> None:
    start = shortly_before(whole("paper"), 60)
    path = Runner(run, recipe, "paper").stopped(SystemExit, Trouble(61, interrupt, "on_train_end"), start=start)
    last = whole("paper") / "checkpoints" / "last.ckpt"
    assert_same(read(path), read(last))


def test_a_run_that_broke_in_its_last_evaluation_makes_up_for_it(
    run: RunFactory, recipe: Recipe, whole: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, start = Runner(run, recipe, "paper"), shortly_before(whole("paper"), 60)
    with monkeypatch.context() as patch:
        patch.setattr(MetricReport, "on_train_epoch_end", lambda *_: fail())
        path = runner.stopped(Broken, Callback(), start=start)
    assert iteration_of(path) == 60
    folder = runner.continued(path)
    assert (folder / "scene.nsvq").read_bytes() == (whole("paper") / "scene.nsvq").read_bytes()
    assert [line.split(",")[0] for line in (folder / "curve.csv").read_text().splitlines()[1:]][-1] == "60"


def test_a_checkpoint_that_cannot_be_written_harms_no_other(
    run: RunFactory, recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    save, good = Trainer.save_checkpoint, []

    def full_disk(trainer: Trainer, path: Path, **kwargs: Any) -> None:
        if trainer.global_step > 5:
            Path(path).write_bytes(b"half of a chec")
            raise OSError("No space left on device")
        save(trainer, path, **kwargs)
        good.append(trainer.global_step)

    monkeypatch.setattr(Trainer, "save_checkpoint", full_disk)
    path = Runner(run, recipe, "paper").stopped(OSError, Callback(), every=5)
    assert (iteration_of(path), good) == (5, [5])


def test_a_run_goes_on_where_a_checkpoint_cannot_be_written(
    run: RunFactory, recipe: Recipe, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    save, refused = Trainer.save_checkpoint, {4}

    def sometimes(trainer: Trainer, path: Path, **kwargs: Any) -> None:
        if trainer.global_step in refused:
            raise PermissionError(13, "held by another program")
        save(trainer, path, **kwargs)

    monkeypatch.setattr(Trainer, "save_checkpoint", sometimes)
    trainer, _ = run(recipe(checkpoint=RunCheckpoint(every=2)).values(), max_steps=8)
    assert iteration_of(run_folder(trainer) / "checkpoints" / "last.ckpt") == 8
    assert "last.ckpt cannot be written (held by another program); the run goes on without it" in caplog.text
    refused.add(8)
    path = Runner(run, recipe, "paper", max_steps=8).stopped(OSError, Callback(), every=2)
    assert iteration_of(path) == 7  # the end of a phase
    assert (path.parents[1] / "scene.nsvq").is_file()  # nothing but the checkpoint is missing


def test_a_run_continued_with_another_length_says_what_follows_from_it(
    run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    path = Runner(run, recipe, "paper", max_steps=8).stopped(Broken, Trouble(3, fail), every=2)
    Runner(run, recipe, "paper", max_steps=9).continued(path)
    told = [message for message in caplog.messages if message.startswith("the checkpoint is of a run with other")]
    assert told == [
        "the checkpoint is of a run with other settings: pass --trainer.max_steps=8 to continue it as it was"
    ]


def test_a_run_that_goes_on_past_its_schedule_keeps_its_checkpoints(run: RunFactory, recipe: Recipe) -> None:
    def fit(checkpoint: RunCheckpoint, ckpt_path: Path | None = None) -> Path:
        callbacks = recipe(phases=paper_phases(total=20, min_finetune=1), checkpoint=checkpoint)
        trainer, _ = run(callbacks.values(), ckpt_path, max_steps=27)
        return run_folder(trainer)

    whole = fit(RunCheckpoint(every=6, keep=True))
    kept = {iteration_of(path) for path in (whole / "checkpoints").glob("step-*.ckpt")}
    assert kept == {6, 12, 18, 24, *Schedule(total=20, min_finetune=1).ends, 27}
    assert_same_end(fit(RunCheckpoint(every=0), whole / "checkpoints" / "step-24.ckpt"), whole)


class IdleGrowth(Callback):
    """Ends the warm-up after iteration 2."""

    def on_train_batch_end(self, trainer: Trainer, module: SplatModule, *_: Any) -> None:  # type: ignore[override]
        if trainer.global_step == 2:
            module.schedule = replace(module.schedule, saved=module.schedule.ends[0] - 2)


def test_a_run_whose_warm_up_ended_early_is_not_longer_when_it_is_continued(run: RunFactory, recipe: Recipe) -> None:
    def fit(ckpt_path: Path | None = None) -> Path:
        trainer, module = run([*recipe(checkpoint=RunCheckpoint(every=0)).values(), IdleGrowth()], ckpt_path)
        assert trainer.global_step == module.schedule.total - module.schedule.saved < module.schedule.total
        return run_folder(trainer)

    whole = fit()
    assert_same_end(fit(whole / "checkpoints" / "last.ckpt"), whole)


def arguments_of(scene: Path, folder: Path, *more: str) -> list[str]:
    return [
        *("fit", f"--data.root={scene}", "--data.factor=2", "--trainer.max_steps=12", "--model.sh_degree=1"),
        *(f"--trainer.default_root_dir={folder}", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"),
        *("--model.codebooks.scales=16", *more),
    ]


@pytest.fixture(scope="module")
def command_scene(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file that the command writes when nothing interrupts it."""
    folder = tmp_path_factory.mktemp("command")
    assert main(arguments_of(demo_scene, folder)) == 0
    return (folder / demo_scene.name / "version_0" / "scene.nsvq").read_bytes()


def test_the_command_says_how_to_continue(
    command_scene: bytes,
    demo_scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "with space"
    step = SplatModule.training_step

    def terminated(module: SplatModule, batch: Any, batch_idx: int) -> Any:
        if module.global_step + 1 == 4:
            terminate()
        return step(module, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(SplatModule, "training_step", terminated)
        assert main(arguments_of(demo_scene, folder)) == 128 + signal.SIGTERM
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("continue with: ")]
    program, *arguments = shlex.split(line.removeprefix("continue with: "))
    path = folder / demo_scene.name / "version_0" / "checkpoints" / "last.ckpt"
    config = path.parents[1] / "config.yaml"
    into = f"--trainer.run_folder={path.parents[1]}"
    assert (program, arguments) == ("nsvq", ["fit", f"--config={config}", f"--ckpt_path={path}", into])
    assert iteration_of(path) == 4
    assert main(arguments) == 0
    assert (folder / demo_scene.name / "version_0" / "scene.nsvq").read_bytes() == command_scene


def test_ctrl_c_is_the_status_130_of_every_command(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(module: SplatModule, batch: Any, batch_idx: int) -> Any:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(SplatModule, "training_step", interrupted)
        assert main(arguments_of(demo_scene, tmp_path)) == 128 + signal.SIGINT
    monkeypatch.setattr("nsvq_lightning.commands.info.describe", lambda path: interrupted(path, None, 0))
    assert main(["info", "scene.ply"]) == 128 + signal.SIGINT


def test_the_command_that_continues_is_that_of_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = Path("a b", "checkpoints", "last.ckpt")
    options = f"--config={Path('a b', 'config.yaml')}", f"--ckpt_path={checkpoint}", "--trainer.run_folder=a b"
    rest = ["fit", *options]
    assert shlex.split(continuation(checkpoint)) == ["nsvq", *rest]
    assert continuation(Path("last.ckpt")).endswith("--trainer.run_folder=..")
    monkeypatch.setattr(sys, "argv", ["/somewhere/nsvq_lightning/__main__.py"])
    assert shlex.split(continuation(checkpoint)) == ["python", "-m", "nsvq_lightning", *rest]


KILLED = """
import os, signal, sys
from nsvq_lightning.commands.main import main
from nsvq_lightning.commands.fit import continuation
from nsvq_lightning.training.module import SplatModule
step = SplatModule.training_step
def killed(module, batch, batch_idx):
    if module.global_step + 1 == {iteration}:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(module, batch, batch_idx)
SplatModule.training_step = killed
main(sys.argv[1:])
"""


def test_checkpoints_of_an_earlier_fit_hide_none_of_the_next(run: RunFactory, recipe: Recipe) -> None:
    checkpoint = RunCheckpoint(every=6)
    Runner(run, recipe, "paper", max_steps=12)(checkpoint=checkpoint)
    first = checkpoint.last_path
    with pytest.raises(Broken):
        Runner(run, recipe, "paper", max_steps=20)(Trouble(13, fail), checkpoint=checkpoint)
    assert checkpoint.last_path is not None
    assert checkpoint.last_path != first
    assert iteration_of(checkpoint.last_path) == 12


def test_a_killed_process_leaves_its_periodic_checkpoint(
    command_scene: bytes, demo_scene: Path, tmp_path: Path
) -> None:
    iteration = 9
    arguments = arguments_of(demo_scene, tmp_path, "--callbacks.checkpoint.every=2")
    script = [sys.executable, "-c", KILLED.format(iteration=iteration), *arguments]
    killed = subprocess.run(script, capture_output=True, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    path = tmp_path / demo_scene.name / "version_0" / "checkpoints" / "last.ckpt"
    assert os.listdir(path.parent) == ["last.ckpt"]
    ends = PhaseSchedule().schedule(12).ends
    assert iteration_of(path) == max(i for i in range(1, iteration) if i % 2 == 0 or i in ends)
    assert main([*arguments, f"--ckpt_path={path}"]) == 0
    assert (tmp_path / demo_scene.name / "version_1" / "scene.nsvq").read_bytes() == command_scene
