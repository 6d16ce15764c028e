"""Runs that are stopped in any phase, in any way, and continued: every bit is that of the run not interrupted."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor

from nsvq_lightning.callbacks import (
    CanonicalCovariance,
    CodebookInit,
    CodebookRefit,
    CodebookReplacement,
    ContributionPruning,
    RunCheckpoint,
)
from nsvq_lightning.cli import main
from nsvq_lightning.module import SplatModule
from nsvq_lightning.quantize import StraightThrough

RunFactory = Callable[..., tuple[Trainer, SplatModule]]
Recipe = Callable[..., dict[str, Callback]]

PHASES = {"warmup": 13, "prune": 24, "quantize": 41, "finetune": 58}
"""An iteration of each phase, of the recipe's 60; none of them has a periodic checkpoint."""

FIRST_OF_PHASE = {"prune": 21, "quantize": 28, "finetune": 58}


class Broken(Exception):
    """What goes wrong in the tests."""


class Trouble(Callback):
    """Calls ``act`` at one hook of one iteration."""

    def __init__(self, iteration: int, act: Callable[[], object], hook: str = "on_after_backward") -> None:
        self.iteration, self.act = iteration, act
        setattr(self, hook, self._strike)

    def _strike(self, trainer: Trainer, pl_module: LightningModule, *args: Any) -> None:
        done = trainer.global_step + (self.act is not fail_late)
        if done == self.iteration:
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


KINDS: dict[str, tuple[Callable[[], None], type[BaseException], int]] = {
    "exception": (fail, Broken, -1),
    "SIGINT": (interrupt, SystemExit, 0),
    "SIGTERM": (terminate, SIGTERMException, 0),
}
"""What happens between backward pass and update, what it ends with, and how many more iterations are complete then."""


def every_option() -> dict[str, Callback]:
    return {
        "canonical": CanonicalCovariance("full"),
        "contribution": ContributionPruning(share=0.02),
        "codebook_init": CodebookInit(weights="contribution"),
        "codebook_refit": CodebookRefit(),
        "codebook_replacement": CodebookReplacement(jitter=0.5, reset_moments=True),
    }


SETTINGS: dict[str, tuple[Callable[[], dict[str, Callback]], dict[str, Any]]] = {
    "defaults": (dict, {}),
    "options": (every_option, {"quantizer": StraightThrough}),
}


class Runner:
    """Runs with one of the ``SETTINGS``."""

    def __init__(self, run: RunFactory, recipe: Recipe, name: str, **trainer: Any) -> None:
        self.run, self.recipe, self.trainer = run, recipe, trainer
        self.options, self.module = SETTINGS[name]

    def __call__(self, *more: Callback, checkpoint: RunCheckpoint, ckpt_path: Path | None = None) -> Path:
        callbacks = self.recipe(**self.options(), checkpoint=checkpoint).values()
        trainer, _ = self.run([*callbacks, *more], ckpt_path, self.module, **self.trainer)
        return Path(trainer.default_root_dir)

    def whole(self) -> Path:
        return self(checkpoint=RunCheckpoint(every=0))

    def stopped(self, ends_with: type[BaseException], trouble: Callback, every: int = 0) -> Path:
        """The checkpoint that a run leaves that gets into trouble."""
        checkpoint = RunCheckpoint(every=every)
        with pytest.raises(ends_with):
            self(trouble, checkpoint=checkpoint)
        assert checkpoint.last_path is not None
        assert sorted(os.listdir(checkpoint.last_path.parent)) == ["last.ckpt"]
        return checkpoint.last_path

    def continued(self, path: Path) -> Path:
        return self(checkpoint=RunCheckpoint(every=0), ckpt_path=path)


@pytest.fixture(scope="module")
def whole(run: RunFactory, recipe: Recipe) -> Callable[[str], Path]:
    """Folder of the run that nothing interrupts, by the name of its settings."""
    folders: dict[str, Path] = {}

    def get(name: str) -> Path:
        if name not in folders:
            folders[name] = Runner(run, recipe, name).whole()
        return folders[name]

    return get


def assert_same(first: Any, second: Any, where: str = "") -> None:
    """Every tensor and number of two nested structures is the same, to the bit, but for the time they took."""
    assert type(first) is type(second), where
    if isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            if key not in ("seconds", "state._train_seconds"):
                assert_same(first[key], second[key], f"{where}/{key}")
    elif isinstance(first, list | tuple):
        assert len(first) == len(second), where
        for number, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{where}/{number}")
    elif isinstance(first, Tensor):
        assert torch.equal(first, second), where
    else:
        assert first == second, where


def assert_same_end(first: Path, second: Path) -> None:
    """Two runs have stored the same bytes, and their last checkpoints hold the same state in every part."""
    assert (first / "scene.nsvq").read_bytes() == (second / "scene.nsvq").read_bytes()
    ends = [torch.load(f / "checkpoints" / "last.ckpt", weights_only=True) for f in (first, second)]
    assert ends[0]["global_step"] == 60
    assert_same(*ends)


def iteration_of(path: Path) -> int:
    return int(torch.load(path, weights_only=True)["global_step"])


def check(runner: Runner, whole: Path, kind: str, iteration: int) -> None:
    act, ends_with, complete = KINDS[kind]
    path = runner.stopped(ends_with, Trouble(iteration, act))
    assert iteration_of(path) == iteration + complete
    assert_same_end(runner.continued(path), whole)


FAST = {("defaults", "SIGINT", "warmup"), ("options", "exception", "quantize"), ("options", "SIGTERM", "finetune")}
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
    runner, iteration = Runner(run, recipe, "defaults"), FIRST_OF_PHASE[phase]
    path = runner.stopped(Broken, Trouble(iteration, fail), every=10)
    # Where codebooks were placed or codes frozen before it, the periodic checkpoint is the last one.
    assert iteration_of(path) == (iteration - 1 if phase == "prune" else (iteration - 1) // 10 * 10)
    assert_same_end(runner.continued(path), whole("defaults"))
