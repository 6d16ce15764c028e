"""Suites shrunk to a second: their rows are complete, our errors are small, and planted errors are found."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nsvq_step
import pytest
import torch

from nsvq_lightning import save
from nsvq_lightning.commands.benchmark import codec, quantize, render, timing, train
from nsvq_lightning.commands.benchmark.emulation import makespan
from nsvq_lightning.commands.benchmark.timing import Measurement, Scope
from nsvq_lightning.commands.benchmark.workloads import synthetic_workload
from nsvq_lightning.skips import is_on
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

TINY = Scope(quick=True, repeats=2, seconds=0.01, workloads=("A20k",), steps=8)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with one splat in ten of the smallest workload."""
    path = tmp_path_factory.mktemp("scene") / "small.ply"
    save(RawSplats(*(tensor[::10] for tensor in synthetic_workload("A20k").splats)), path)
    return path


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "SGEMM_SIDE", 64)
    monkeypatch.setattr(render, "ORACLE_WORK", {True: 1e7})
    monkeypatch.setattr(render, "PHOTO", (40, 48, 3))
    monkeypatch.setattr(quantize, "CHECKED_ROWS", 500)
    monkeypatch.setattr(train, "QUICK_DEMO", ("--data.factor=8",))


def _checked(rows: list[Measurement]) -> dict[tuple[str, str], dict[str, float]]:
    """Values by operation and method; the last workload's, if there are several."""
    keys = [(row.workload, row.method, row.operation) for row in rows]
    assert len(set(keys)) == len(keys) >= 2
    for row in rows:
        assert row.values
        assert all(value >= 0 or name == "saves %" for name, value in row.values.items())
        assert row.ratio > 0
    return {(row.operation, row.method): dict(row.values) for row in rows}


def _tiny(**options: Any) -> Scope:
    return dataclasses.replace(TINY, **options)


def test_rasterizer_and_loss_are_as_exact_as_plain_torch(scene: Path) -> None:
    rows = list(render.run(_tiny(scene=scene)))
    values = _checked(rows)
    for method in ("cpu", "plain torch"):
        assert values["forward", method]["max error"] < 1e-5
        assert values["forward + backward", method]["gradient error"] < 1e-4
    assert values[render.LOSS, "fused, cpu"]["gradient error"] < 1e-4
    # Both sides of 800x533 are halved until 2000 splats times the pixels are at most 1e7.
    assert rows[0].values["error pixels"] == 50 * 33


def test_image_errors_leave_out_a_flipped_pixel_and_count_it() -> None:
    truth = torch.rand(8, 9, 3, generator=torch.Generator().manual_seed(0)).double()
    image = truth + 1e-6
    image[2, 3, 1] += 0.01
    values, usual = render.image_errors(image, truth)
    assert values["max error"] == pytest.approx(1e-6)
    assert values["mean error"] == pytest.approx(1e-6)
    assert values["pixels left out"] == values["pixels above 1e-3"] == int((~usual).sum()) == 1
    assert set(render.image_errors(truth, truth)[0].values()) == {0}


def test_searches_are_right(scene: Path) -> None:
    rows = list(quantize.run(_tiny(scene=scene)))
    _checked(rows)
    # Codes may differ between equals to rounding.
    ours = [row.values["added distance"] for row in rows if row.method == "nsvq_lightning"]
    assert len(ours) == 4
    assert max(ours) < 1e-6


def test_codes_are_judged_by_their_distances() -> None:
    x, codebook = torch.tensor([[0.0], [1.0], [2.1]]), torch.tensor([[0.5], [2.0], [2.0]])
    # Distances 0.5 + 0.5 + 0.1; the second code is 1 away from row 1; code 2 equals code 1.
    values = quantize.code_errors(x, codebook, torch.tensor([0, 1, 2]))
    assert values == {"wrong codes": 1, "added distance": pytest.approx(0.5 / 1.1)}


def test_wrong_quantize_step_is_found() -> None:
    splats = RawSplats(*(tensor[:2000] for tensor in synthetic_workload("A20k").splats))
    attributes = nsvq_step.prepare(splats, "0.5k")
    results = nsvq_step.step(attributes, 0)
    assert max(nsvq_step.step_errors(attributes, results).values()) < 1e-4
    quantized, gradient, codes = results["quats"]
    table, rows, upstream = attributes["quats"].x.detach(), attributes["quats"].rows, attributes["quats"].upstream
    x, straight_through = table[rows], torch.zeros_like(table).index_copy(0, rows, upstream)
    for broken, key in (
        ((x + 1.01 * (quantized - x), gradient, codes), "length error"),
        ((quantized, straight_through, codes), "gradient error"),
        ((quantized, gradient, codes.roll(1)), "wrong codes"),
    ):
        assert nsvq_step.step_errors(attributes, {**results, "quats": broken})[key] > 1e-3


def test_files_lose_what_their_levels_say(scene: Path, demo_scene: Path) -> None:
    rows = list(codec.run(_tiny(scene=demo_scene, init_from=scene)))
    values = _checked(rows)
    assert rows[0].workload == "scene small.ply, 1k codebooks"
    assert values["read", ".nsvq paper"]["image error"] == values["read", ".ply"]["image error"] == 0
    assert values["read", ".nsvq compact"]["image error"] > 0
    assert values["write", ".nsvq paper"]["bytes"] < values["write", ".ply"]["bytes"] == scene.stat().st_size


def test_runs_with_and_without_a_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, measured = set(), train._test_psnr

    def seeing_switches(module: SplatModule) -> float:
        seen.add(is_on("blocks"))
        return measured(module)

    monkeypatch.setattr(train, "_test_psnr", seeing_switches)
    shipped, exact = rows = list(train.run(_tiny(switches=("blocks",))))
    _checked(rows)
    assert [row.method for row in rows] == ["as shipped", "no skip of blocks"]
    assert seen == {True, False}
    assert shipped.values["PSNR dB"] == exact.values["PSNR dB"] > 5
    assert exact.values["saves %"] == pytest.approx(100 * (1 - 1 / exact.values["times as shipped"]))
    assert len(shipped.samples) == TINY.steps


EMULATION = """
import sys
import torch
from nsvq_lightning.commands.benchmark import timing, train
torch.set_num_threads(int(sys.argv[1]))
timing.SGEMM_SIDE, train.QUICK_DEMO = 64, ("--data.factor=4",)
scope = timing.Scope(quick=True, steps=40, emulate=(1, 2, 64))
for row in train.run(scope):
    print(row.method, row.values["PSNR dB"], row.values["splats"], row.values["seconds"], sep=":")
"""


def emulated(threads: int) -> subprocess.CompletedProcess[str]:
    # The first kernels of a process, whose threads it takes over.
    command = [sys.executable, "-c", EMULATION, str(threads)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_more_cores_are_emulated_with_the_same_bits() -> None:
    ran = emulated(2)
    assert ran.returncode == 0, ran.stderr
    rows = [line.split(":") for line in ran.stdout.splitlines() if line.count(":") == 3]
    assert [row[0] for row in rows] == [
        "as shipped",
        "between kernels",
        *(f"{cores}-core machine, expected" for cores in (1, 2, 64)),
    ]
    assert len({(psnr, splats) for _, psnr, splats, _ in rows}) == 1
    _, between, one, two, many = (float(row[3]) for row in rows)
    assert 0 < between < many < two
    assert two - between > (one - between) / 2


def test_a_step_on_so_many_cores_is_what_lies_between_and_the_longest_queues() -> None:
    regions = SimpleNamespace(wake=0.25, taken=list)
    clock = train.StepClock(regions)  # type: ignore[arg-type]
    clock.steps, clock.kernels = [(Phase.PRUNE, 9000.0)], [[([3.0, 1.0, 1.0], 5.5), ([0.5], 0.5)]]
    expected = {cores: clock.expected(cores).steps for cores in (0, 1, 2, 8)}
    between = 9 - 5.5 - 0.5
    assert expected[0] == [(Phase.PRUNE, 1000 * between)]
    assert expected[1] == [(Phase.PRUNE, 1000 * (between + 5 + 0.5))]
    assert expected[2] == expected[8] == [(Phase.PRUNE, 1000 * (between + 3 + 0.5 + 2 * 0.25))]


def test_cores_are_not_emulated_on_one_thread() -> None:
    assert "allow two (OMP_NUM_THREADS=2)" in emulated(1).stderr


def test_cores_take_parts_as_they_are_done() -> None:
    assert makespan([3.0, 1.0, 1.0, 1.0], 2) == 3
    assert makespan([1.0, 1.0, 1.0, 3.0], 2) == 4
    assert makespan([1.0, 2.0], 1) == 3
    assert makespan([1.0, 2.0], 8) == 2


def test_what_is_between_steps_is_not_in_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]

    def later(seconds: float) -> float:
        now[0] += seconds
        return seconds

    monkeypatch.setattr(train.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(timing, "finish", lambda: later(1))  # a GPU is waited for
    monkeypatch.setattr(timing, "milliseconds", lambda product: later(50))
    clock, trainer = train.StepClock(), SimpleNamespace(global_step=9, max_steps=10)
    clock.on_train_start(trainer, SplatModule())  # type: ignore[arg-type]
    for _ in range(2):
        later(2)
        clock.on_train_batch_end(trainer, SplatModule(), None, None, 0)  # type: ignore[arg-type]
    assert [took for _, took in clock.steps] == [3000.0, 3000.0]
    assert clock.products == [50.0, 50.0]
    assert clock.relative == 60
