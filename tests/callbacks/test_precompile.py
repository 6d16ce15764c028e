"""Kernels of the later phases compiled in a second process: what it is sent works there, and it ends with the fit."""

from __future__ import annotations

import io
import pickle
from typing import Any

import numba
import pytest
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import Recipe, RunFactory

from nsvq_lightning.callbacks import CompileAhead, precompile
from nsvq_lightning.quantize import NSVQ, CodebookQuantizer, DiVeQ, PostHoc, StraightThrough, TrainedStraightThrough
from nsvq_lightning.training.module import SplatModule

CODES = {"scales": 24, "quats": 24, "sh0": 16, "shN": 16}


@pytest.mark.parametrize(
    ("quantizer", "degree", "codebooks"),
    [
        (NSVQ, 0, {"scales": 700}),
        *((kind, 1, CODES) for kind in (DiVeQ, PostHoc, StraightThrough, TrainedStraightThrough)),
    ],
)
def test_every_quantizer_can_be_rehearsed(quantizer: type[CodebookQuantizer], degree: int, codebooks: Any) -> None:
    settings = precompile.settings_of(SplatModule(degree, quantizer, codebooks))
    assert settings is not None
    precompile.compile_kernels(pickle.loads(settings))


def test_a_module_of_the_command_line_is_made_from_its_configuration() -> None:
    precompile.compile_kernels({  # as LightningCLI stores it
        "sh_degree": 1,
        "codebooks": {"sh0": 16},
        "quantizer": {"class_path": "nsvq_lightning.quantize.StraightThrough", "init_args": {"kmeans_steps": 3}},
        "storage": {"level": "compact"},
        "_instantiator": "lightning.pytorch.cli.instantiate_module",
    })  # fmt: skip


def test_what_cannot_be_sent_is_not_rehearsed() -> None:
    assert precompile.settings_of(SplatModule(0, lambda codes, dim: NSVQ(codes, dim), {"sh0": 16})) is None


class Compiles(Callback):
    """Compiles a function at the second step, as a fit on a new machine does."""

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if batch_idx == 1:
            numba.njit(lambda x: x + 1)(1)


class Process:
    """Instead of a process: keeps what it was sent."""

    def __init__(self, command: list[str], **options: Any) -> None:
        self.command, self.options, self.calls = command, options, list[str]()
        self.stdin = io.BytesIO()
        self.stdin.close = lambda: self.calls.append("sent")  # type: ignore[method-assign]

    def terminate(self) -> None:
        self.calls.append("terminate")

    def wait(self) -> None:
        self.calls.append("wait")


@pytest.fixture
def processes(monkeypatch: pytest.MonkeyPatch) -> list[Process]:
    """The processes that were started, on a machine of several cores."""
    started: list[Process] = []

    def start(*args: Any, **options: Any) -> Process:
        started.append(Process(*args, **options))
        return started[-1]

    monkeypatch.setattr(precompile.subprocess, "Popen", start)
    monkeypatch.setattr(precompile, "usable_cores", lambda: 2)
    return started


def test_the_first_compilation_starts_one_process_that_ends_with_the_fit(
    recipe: Recipe, run: RunFactory, processes: list[Process]
) -> None:
    run([*recipe(kernels=CompileAhead()).values(), Compiles()], max_steps=3)
    (process,) = processes
    assert process.command[1] == "-c"
    compile(process.command[2], "what it runs", "exec")
    assert "compile_what_is_sent()" in process.command[2]
    assert process.options["env"]["OMP_NUM_THREADS"] == "1"
    assert process.calls == ["sent", "terminate", "wait"]
    precompile.compile_kernels(pickle.loads(process.stdin.getvalue()))


def test_an_error_ends_the_process(recipe: Recipe, run: RunFactory, processes: list[Process]) -> None:
    class Fails(Callback):
        def on_train_batch_end(self, *_: Any) -> None:
            if processes:
                raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError, match="on purpose"):
        run([*recipe(kernels=CompileAhead()).values(), Compiles(), Fails()], max_steps=3)
    assert processes[0].calls == ["sent", "terminate", "wait"]


def refuse(*_: Any, **__: Any) -> None:
    raise OSError("no more processes")


@pytest.mark.parametrize(("cores", "module"), [(1, {}), (2, {"codebooks": None})], ids=["one core", "no codebooks"])
def test_nothing_is_started_where_it_is_of_no_use(
    cores: int,
    module: dict[str, Any],
    recipe: Recipe,
    run: RunFactory,
    processes: list[Process],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(precompile, "usable_cores", lambda: cores)
    run([*recipe(kernels=CompileAhead()).values(), Compiles()], max_steps=3, module=module)
    assert not processes


def test_a_process_that_cannot_start_does_not_stop_the_fit(
    recipe: Recipe, run: RunFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile.subprocess, "Popen", refuse)
    monkeypatch.setattr(precompile, "usable_cores", lambda: 2)
    trainer, _ = run([*recipe(kernels=CompileAhead()).values(), Compiles()], max_steps=3)
    assert trainer.global_step == 3
