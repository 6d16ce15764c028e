"""Whole runs, PSNR against seconds, and one step beside the render it contains.

Runs are those of ``nsvq fit`` with a config: its module, data, callbacks, loggers and trainer. What only watches a run
(reports, checkpoints, the progress bar) is left out, and test views are compared while the clock is stopped. Every run
has the same number of steps. Variants differ from the first one in one thing. Where one promises the same bits, the
column ``other numbers`` checks it: it counts the trained numbers that are not those of the first row.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.cores import core_rows
from nsvq_lightning.commands.benchmark.fitting import Step
from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.recipe_run import recipe_name, recipe_run
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, milliseconds, sgemm, use_threads
from nsvq_lightning.commands.benchmark.trainees import Trainee, trainee
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import View
from nsvq_lightning.io.nsvq.file import write_nsvq
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.report.evaluation import evaluate
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

__all__ = ["Trained", "Variant", "different_numbers", "run", "variants"]

ROUNDS = {True: 1, False: 2}
"""Runs of every variant; their order turns, their steps are counted together."""
EVALUATIONS = 16
"""Points during a run at which its test views are compared, besides the ends of the phases."""
PRODUCT_EVERY = {True: 8, False: 10}
"""Steps between two matrix products."""
WARM_STEPS, STEPS = {True: 4, False: 10}, {True: 10, False: 60}
"""Steps that are not counted, and those that are, where a step is compared with its render."""
FIRST_STEPS = 8
"""Steps of a first run that is not counted, through all phases."""
SHIPPED = "as shipped"


class Variant(NamedTuple):
    """One way to run: threads, further options of ``nsvq fit``, and the switch that is off, if one is."""

    name: str
    threads: int
    options: tuple[str, ...] = ()
    off: str | None = None


class Trained(NamedTuple):
    """The result of one run.

    Attributes:
        steps: All steps.
        course: Seconds and test PSNR in dB, during the run and at its end.
        numbers: Everything that was trained, by name.
        file_bytes: Size of the compressed file.
        sgemm: Matrix products in between, ms.
    """

    steps: list[Step]
    course: list[tuple[float, float]]
    numbers: dict[str, Tensor]
    file_bytes: int
    sgemm: list[float]


def run(scope: Scope) -> list[Measurement]:
    """Train with every variant, then time single steps with every number of threads."""
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
        rows = [*_run_rows(scope, Path(folder)), *_step_rows(scope, Path(folder))]
    return [*rows, *core_rows(scope)] if len(set(scope.threads)) > 1 else rows


# Whole runs


def variants(scope: Scope) -> list[Variant]:
    """What is compared: threads, the run without codebooks, and each switch that is asked for, inverted."""
    most = max(scope.threads)
    chosen = [Variant(SHIPPED, most)]
    chosen += [Variant(f"{n} thread{'s' * (n > 1)}", n) for n in scope.threads if n != most]
    if not scope.switches:
        chosen.append(Variant("without codebooks", most, ("--model.codebooks=null",)))
    for name in scope.switches:
        chosen.append(Variant(f"no skip of {name}", most, (f"--skips.{name}=false",), off=name))
    return chosen


def _run_rows(scope: Scope, folder: Path) -> list[Measurement]:
    chosen = variants(scope)
    # Not counted: kernels are loaded, and compiled where they never were.
    _train(chosen[0], replace(scope, steps=FIRST_STEPS), folder)
    trained: dict[str, list[Trained]] = {variant.name: [] for variant in chosen}
    for turn in range(ROUNDS[scope.quick]):
        for variant in chosen[turn:] + chosen[:turn]:
            trained[variant.name].append(_train(variant, scope, folder))
    shipped = trained[SHIPPED]
    return [_run_row(recipe_name(scope), variant, trained[variant.name], shipped) for variant in chosen]


def _train(variant: Variant, scope: Scope, folder: Path) -> Trained:
    steps: list[Step] = []
    course: list[tuple[float, float]] = []
    products: list[float] = []
    product, every = sgemm(), max(1, scope.steps // EVALUATIONS)
    product_every = min(PRODUCT_EVERY[scope.quick], scope.steps)

    def between(module: SplatModule, _: View, step: Step) -> None:
        steps.append(step)
        # Between the round numbers: opacities are reset at those, and just then a picture says nothing.
        if step.iteration in module.schedule.ends or step.iteration % every == every // 2:
            course.append((_seconds(steps), _test_psnr(module)))
        if step.iteration % product_every == 0:
            products.append(milliseconds(product))

    module = recipe_run(scope, variant.threads, between, variant.options)
    file_bytes = write_nsvq(folder / "scene.nsvq", module.compressed())
    numbers = {name: tensor.detach() for name, tensor in module.named_parameters()}
    return Trained(steps, course, numbers, file_bytes, products)


def _seconds(steps: Sequence[Step]) -> float:
    return sum(step.milliseconds for step in steps) / 1000


def _test_psnr(module: SplatModule) -> float:
    data: ColmapDataModule = module.trainer.datamodule  # type: ignore[attr-defined]  # Lightning does not type it
    with torch.no_grad():
        splats = module.hard_splats(module.phase)
        return evaluate(
            lambda camera: module.render_splats(splats, camera).image, data.test_dataloader(), module.device
        ).psnr


def _run_row(workload: str, variant: Variant, runs: Sequence[Trained], shipped: Sequence[Trained]) -> Measurement:
    timing, first = _timing(runs), runs[0]
    ratio = _relative_mean(timing) / _relative_mean(_timing(shipped))
    by_phase: dict[Phase, list[float]] = {}
    for step in (step for trained in runs for step in trained.steps):
        by_phase.setdefault(step.phase, []).append(step.milliseconds)
    values = {
        "PSNR dB": first.course[-1][1],
        "seconds": fmean(_seconds(trained.steps) for trained in runs),
        "times as shipped": ratio,
        "steps a second": 1000 / fmean(timing.samples),
        **{f"{phase.name.lower()} ms": median(times) for phase, times in by_phase.items()},
        "splats": float(len(first.numbers["splats.means"])),
        "file bytes": float(first.file_bytes),
        "other numbers": float(different_numbers(first.numbers, shipped[0].numbers)),
    }
    if variant.off is not None:
        values["saves %"] = 100 * (1 - 1 / ratio)
    note = "times are of whole steps, those that start a phase included; PSNR is that of the test views"
    return Measurement(
        "train", workload, variant.name, "run", variant.threads, timing, values, note, tuple(first.course)
    )


def _timing(runs: Sequence[Trained]) -> Timing:
    steps = tuple(step.milliseconds for trained in runs for step in trained.steps)
    return Timing(steps, tuple(time for trained in runs for time in trained.sgemm))


def _relative_mean(timing: Timing) -> float:
    """Mean step in matrix products, so that a busy machine is not mistaken for a slow variant."""
    return fmean(timing.samples) / median(timing.sgemm)


def different_numbers(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> int:
    """Numbers of ``found`` that are not bit for bit those of ``expected``; all of a tensor of another shape."""
    different = 0
    for name, tensor in found.items():
        other = expected.get(name)
        if other is None or other.shape != tensor.shape:
            different += tensor.numel()
        else:
            different += int((tensor.view(torch.int32) != other.view(torch.int32)).sum())
    return different


# One step beside its render


def _step_rows(scope: Scope, folder: Path) -> list[Measurement]:
    subject = trainee(scope, folder)
    rows = []
    for threads in scope.threads:
        steps, renders, products = _steps_and_renders(subject, threads, scope.quick)
        for method, times in (("render forward + backward", renders), ("training step, Lightning included", steps)):
            values = {"times its render": median(times) / median(renders)}
            timing = Timing(tuple(times), tuple(products))
            rows.append(Measurement("train", subject.name, method, "warmup step", threads, timing, values))
    return rows


def _steps_and_renders(subject: Trainee, threads: int, quick: bool) -> tuple[list[float], list[float], list[float]]:
    """Milliseconds of steps, of the renders in them by themselves, and of matrix products, taking turns."""
    steps: list[float] = []
    renders: list[float] = []
    products: list[float] = []
    product = sgemm()

    def between(module: SplatModule, view: View, step: Step) -> None:
        if step.iteration <= WARM_STEPS[quick]:
            return
        steps.append(step.milliseconds)
        turns = [(_render_case(module, view), renders), (product, products)]
        # What comes after the product finds empty caches: each in its turn.
        for case, times in turns if step.iteration % 2 else reversed(turns):
            times.append(milliseconds(case))

    count = WARM_STEPS[quick] + STEPS[quick]
    with use_threads(threads):
        subject.train(Phase.WARMUP, count, between, codebooks=None)
    return steps, renders, products


def _render_case(module: SplatModule, view: View) -> Case:
    """The render of a step by itself, with the splats as they are and a gradient of the size a loss gives."""
    leaves = module.splats.raw()
    gradient = torch.full((view.camera.height, view.camera.width, 3), 1 / view.image.numel())

    def both() -> None:
        image = render(leaves, view.camera, sh_degree=module.active_sh_degree).image
        torch.autograd.grad(image, leaves, gradient)

    return Case("render", both)
