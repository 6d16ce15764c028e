"""Two processes with a view each are one process with two views, to the bit, from the first clone to the last code.

Some views are spoilt on the way: whatever one process meets, both take the same decision. And a run that is stopped in
one of its processes continues to the bits of the run not interrupted.
"""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed
from checkpoints import assert_same_end, iteration_of, read

from nsvq_lightning.commands.main import main
from nsvq_lightning.training.schedule import Phase

pytestmark = pytest.mark.skipif(
    not (torch.distributed.is_available() and torch.distributed.is_gloo_available()),
    reason="this torch has no gloo, which several processes on the CPU need",
)

TESTS = Path(__file__).resolve().parents[2]
IN_QUANTIZE = 42
"""Iteration of a checkpoint between two replacements of codes."""

LOSSES, GRADIENTS = (7, 43), (13, 46)
"""Iterations in which the second view has a loss or a gradient that is not finite: in warm-up and quantize phase, where
nothing else changes the splats."""

RESETS = {"reset_every": 9, "reset_last": 9, "reset_photos": 0, "recovery": 3}
GROWTH = {"start": 0, "full": 20, "every": 4, "grad_threshold": 1e-6, **RESETS}
RECIPE = [
    *("--callbacks.phases.reference_total=60", "--callbacks.phases.min_reset_interval=1", "--splats=500"),
    *("--callbacks.phases.warmup_end=24", "--callbacks.phases.prune_end=40", "--callbacks.phases.quantize_end=50"),
    *(f"--callbacks.density.{name}={value}" for name, value in {**GROWTH, "first_prune": 3}.items()),
    *("--callbacks.rate_decay.start=50", "--callbacks.sh_degree.every=10"),
    *("--callbacks.codebook_replacement.start=45", "--callbacks.codebook_replacement.early_end=45"),
    "--callbacks.codebook_init.weighted=false",  # contributions are sums over views, whose order differs
    *("--callbacks.codebook_replacement.end=47", "--callbacks.codebook_replacement.late_every=2"),
]
PAPER = [
    *("--config=paper", "--callbacks.phases.min_reset_interval=11", "--callbacks.density.grad_threshold=5e-5"),
    *("--callbacks.density.min_opacity=0.009", "--callbacks.density.max_splats=1500"),
]


@dataclass
class Finished:
    """What a run from the command line left behind."""

    folder: Path
    notes: Path
    printed: str = ""

    def lines(self, rank: int = 0) -> list[str]:
        return (self.notes / f"{rank}.txt").read_text().splitlines()

    def metrics(self) -> dict[str, Any]:
        read: dict[str, Any] = json.loads((self.folder / "metrics.json").read_text())
        return read

    def checkpoint(self) -> dict[str, Any]:
        return read(self.folder / "checkpoints" / f"step-{IN_QUANTIZE}.ckpt")


def arguments(scene: Path, root: Path, *more: str) -> list[str]:
    """A fit of 60 steps through all phases, with 3 test views, which two processes cannot share evenly."""
    return [
        *("fit", f"--data.root={scene}", "--data.factor=2", "--data.test_every=3"),
        *(more if more[0].startswith("--config") else [*RECIPE, *more]),
        *("--trainer.max_steps=60", "--trainer.accelerator=cpu", f"--trainer.default_root_dir={root}"),
        *("--trainer.enable_progress_bar=false", "--model.sh_degree=1", "--model.background=random"),
        *("--model.codebooks.scales=24", "--model.codebooks.quats=2000"),
        *("--model.codebooks.sh0=16", "--model.codebooks.shN=16", "--callbacks.report.every=20"),
        *("--callbacks.phases.min_density_interval=4", "--callbacks.phases.min_finetune=1"),
        *("--callbacks.phases.min_replacement_interval=5", "--callbacks.density.finite_every=7"),
        *("--trainer.callbacks+=replica_witness.ReplicaWitness", f"--trainer.callbacks.folder={root / 'notes'}"),
        *("--trainer.callbacks+=replica_trouble.SpoiltViews", f"--trainer.callbacks.losses={list(LOSSES)}"),
        f"--trainer.callbacks.gradients={list(GRADIENTS)}",
    ]


ONE = ("--trainer.devices=1", "--trainer.accumulate_grad_batches=2")
TWO = ("--trainer.devices=2", "--trainer.strategy=view_parallel")


def run_command(arguments: list[str]) -> tuple[int, str]:
    """Run the command in a group of processes of its own; its exit status and what it printed."""
    package = TESTS.parent
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(TESTS / "support"), str(package)]),
        "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "nsvq_lightning", *arguments]
    with subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            printed, _ = process.communicate(timeout=300)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # the processes it started, too
            raise
    return process.returncode, printed


CHECKPOINTS = (f"--callbacks.checkpoint.every={IN_QUANTIZE}", "--callbacks.checkpoint.keep=true")


def run_one(scene: Path, root: Path, *more: str) -> Finished:
    """One process, two views a step."""
    assert main(arguments(scene, root, *more, *CHECKPOINTS, *ONE)) == 0
    return Finished(root / scene.name / "version_0", root / "notes")


def run_two(scene: Path, root: Path, *more: str) -> Finished:
    """Two processes, a view each."""
    status, printed = run_command(arguments(scene, root, *more, *CHECKPOINTS, *TWO))
    assert status == 0, printed
    return Finished(root / scene.name / "version_0", root / "notes", printed)


@pytest.fixture(scope="module")
def one(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run_one(demo_scene, tmp_path_factory.mktemp("one"))


@pytest.fixture(scope="module")
def two(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run_two(demo_scene, tmp_path_factory.mktemp("two"))


def test_two_processes_train_what_one_process_with_two_views_trains(one: Finished, two: Finished) -> None:
    lines = two.lines()
    assert len(lines) == len(set(lines)) == 61
    assert two.lines(1) == lines == one.lines()
    phases, counts = zip(*(line.split()[1:3] for line in lines), strict=True)
    assert set(phases) == {phase.name for phase in Phase}
    changes = [int(after) - int(before) for before, after in pairwise(counts)]
    assert min(changes) < 0 < max(changes)
    assert max(map(int, counts)) > 500 == int(counts[41])
    assert int(counts[-1]) == 499  # one has met a gradient that was not finite
    assert (two.folder / "scene.nsvq").read_bytes() == (one.folder / "scene.nsvq").read_bytes()
    assert two.printed.count("rendered from the decoded file") == 1  # the first process speaks for both
    assert two.printed.count("codebooks for") == 1


@pytest.mark.slow
def test_the_papers_density_control_is_the_same_on_two_processes(demo_scene: Path, tmp_path: Path) -> None:
    one, two = run_one(demo_scene, tmp_path / "one", *PAPER), run_two(demo_scene, tmp_path / "two", *PAPER)
    assert two.lines() == two.lines(1) == one.lines()
    assert len({line.split()[2] for line in one.lines()}) > 5
    assert (two.folder / "scene.nsvq").read_bytes() == (one.folder / "scene.nsvq").read_bytes()


def test_test_views_that_cannot_be_shared_evenly_score_the_same(one: Finished, two: Finished) -> None:
    assert (two.folder / "views.csv").read_text() == (one.folder / "views.csv").read_text()
    ours, theirs = two.metrics(), one.metrics()
    assert ours["views"] == 3
    for name in ("psnr", "ssim", "file_bytes", "num_splats"):
        assert ours[name] == theirs[name]
    for end, other in zip(ours["phases"], theirs["phases"], strict=True):
        assert (end["psnr"], end["ssim"]) == pytest.approx((other["psnr"], other["ssim"]), rel=1e-6)
    assert len(list((two.folder / "renders").iterdir())) == 3
    for each in (one, two):  # what loggers get, which Lightning averages
        *_, last = csv.DictReader((each.folder / "metrics.csv").open())
        assert float(last["test/psnr"]) == pytest.approx(theirs["psnr"], rel=1e-5)


def test_a_checkpoint_of_two_processes_is_that_of_one(one: Finished, two: Finished) -> None:
    # So a run can go on with another number of processes; usage counters are local between two replacements.
    ours, theirs = two.checkpoint(), one.checkpoint()
    state = ours["state_dict"]
    assert int(state["codebooks.scales.window"]) > 0
    assert len(state["codebooks.quats.codebook"]) == len(state["codebooks.quats.usage"]) < 2000  # fewer rows than codes
    assert state.keys() == theirs["state_dict"].keys()
    different = [name for name, tensor in state.items() if not torch.equal(tensor, theirs["state_dict"][name])]
    sums = {"splats.gradient_sum", "splats.edge_sum"}  # in another order
    assert set(different) <= {"_extra_state", *sums}
    for name in sums:
        torch.testing.assert_close(state[name], theirs["state_dict"][name])
    (adam,), (other,) = ours["optimizer_states"], theirs["optimizer_states"]
    assert adam["param_groups"] == other["param_groups"]
    torch.testing.assert_close(adam["state"], other["state"], rtol=0, atol=0)


def test_what_one_process_meets_both_decide_alike(two: Finished) -> None:
    for iteration in LOSSES:
        assert two.printed.count(f"step {iteration}: the loss of ") == 1  # where it was, with the name of the view
        before, after = (two.lines()[number].split()[-1] for number in (iteration - 1, iteration))
        assert before == after  # no process has updated
    assert two.printed.count("the loss of 1 of 2 processes is not finite, no update") == len(LOSSES)
    # A gradient reaches all replicas; every seventh iteration and before codes are replaced they search, and drop the
    # same splat.
    dropped = re.findall(r"step (\d+): dropped 1 of (\d+) splats with non-finite values: means in 1 rows", two.printed)
    assert sorted(int(step) for step, _ in dropped) == [14, 14, 47, 47]
    assert len(set(dropped)) == 2
    state = read(two.folder / "checkpoints" / "last.ckpt")["state_dict"]
    assert all(bool(value.isfinite().all()) for value in state.values())


@pytest.mark.parametrize(
    ("by", "iteration", "left"),
    [
        pytest.param("exception", 16, 15, marks=pytest.mark.slow),
        pytest.param("SIGTERM", 41, 41, marks=pytest.mark.long),
        pytest.param("SIGKILL", 59, 50, marks=pytest.mark.long),
    ],
)
def test_a_run_stopped_in_one_process_continues_to_the_same_bits(
    by: str, iteration: int, left: int, two: Finished, demo_scene: Path, tmp_path: Path
) -> None:
    # 15 is periodic, 50 the end of a phase. After SIGTERM all processes have stopped after the same iteration.
    common = arguments(demo_scene, tmp_path, *TWO, "--callbacks.checkpoint.every=15")
    trouble = ["--trainer.callbacks+=replica_trouble.Stopped", f"--trainer.callbacks.iteration={iteration}"]
    status, printed = run_command([*common, *trouble, f"--trainer.callbacks.by={by}"])
    assert status == 128 + signal.SIGTERM if by == "SIGTERM" else status not in (0, 128 + signal.SIGTERM), printed
    path = tmp_path / demo_scene.name / "version_0" / "checkpoints" / "last.ckpt"
    assert iteration_of(path) == left
    status, printed = run_command([*common, f"--ckpt_path={path}"])
    assert status == 0, printed
    assert_same_end(tmp_path / demo_scene.name / "version_1", two.folder)
