"""Suite ``train``: whole runs of a config, PSNR against seconds; the parts of their steps; steps by themselves.

Runs are those of ``nsvq fit``: its module, data, callbacks, loggers and trainer. What only watches a run (reports,
checkpoints, the progress bar) is left out, and test views are compared while the clock is stopped. Every run has the
same number of steps. Variants differ from the first one in one thing. Where one promises the same bits, the column
``other numbers`` checks it: it counts the trained numbers that are not those of the first row.
"""

from __future__ import annotations

import logging
import multiprocessing
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

import numba
import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import SIZES, Scope
from nsvq_lightning.commands.benchmark.report import Panel
from nsvq_lightning.commands.benchmark.runs import OTHER, OUTSIDE, PARTS, Step, StepSampler, config_run, run_name
from nsvq_lightning.commands.benchmark.timing import Case, Measurement, Timing, measure, milliseconds, sgemm
from nsvq_lightning.commands.benchmark.workloads import synthetic_workload
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import View
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.report.evaluation import evaluate
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.schedule import Phase

__all__ = ["PANELS", "different_numbers", "part_rows", "run", "run_rows", "serial_share", "size_rows", "variants"]

log = logging.getLogger(__name__)

RUN, ALONE = "run", "step by itself"
PANELS = (Panel(RUN, "PSNR dB", "seconds"), Panel(ALONE, "ms", "splats"), Panel(ALONE, "peak MB", "splats"))
ROUNDS = {True: 1, False: 2}
"""Runs of every variant, quick and full; their order turns, their steps are counted together."""
EVALUATIONS = 16
"""Points during a run at which its test views are compared, besides the ends of the phases."""
PRODUCT_EVERY = 8
"""Steps between two matrix products."""
FIRST_STEPS = 8
"""Steps of a first run that is not counted, through all phases."""
SHIPPED, WHOLE = "as shipped", "whole step"


def run(scope: Scope) -> Iterator[Measurement]:
    """Train with every variant, then profile the steps of a run, then time steps of growing size."""
    yield from run_rows(scope)
    if sys.version_info < (3, 12) or numba.config.ENABLE_SYS_MONITORING:
        yield from part_rows(scope)
    else:
        log.warning("train: no profile: it shows kernels only if NUMBA_ENABLE_SYS_MONITORING=1 when Numba is loaded")
    yield from size_rows(scope)


# Whole runs


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
        sgemm: Matrix products in between, ms.
        numbers: Everything that was trained, by name.
    """

    steps: list[Step]
    course: list[tuple[float, float]]
    sgemm: list[float]
    numbers: Mapping[str, Tensor]

    @property
    def seconds(self) -> float:
        """Time of all steps."""
        return sum(step.milliseconds for step in self.steps) / 1000


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


def run_rows(scope: Scope) -> Iterator[Measurement]:
    """A row for each variant, see :func:`variants`."""
    chosen = variants(scope)
    # Not counted: kernels are loaded, and compiled where they never were.
    _train(chosen[0], replace(scope, steps=FIRST_STEPS))
    trained: dict[str, list[Trained]] = {variant.name: [] for variant in chosen}
    for turn in range(ROUNDS[scope.quick]):
        for variant in chosen[turn:] + chosen[:turn]:
            trained[variant.name].append(_train(variant, scope))
    for variant in chosen:
        yield _run_row(run_name(scope), variant, trained[variant.name], trained[SHIPPED])


def _train(variant: Variant, scope: Scope) -> Trained:
    steps: list[Step] = []
    course: list[tuple[float, float]] = []
    products: list[float] = []
    product, every = sgemm(), max(1, scope.steps // EVALUATIONS)

    def between(module: SplatModule, _: View, step: Step) -> None:
        steps.append(step)
        # Between the round numbers: opacities are reset at those, and just then a picture says nothing.
        if step.iteration in module.schedule.ends or step.iteration % every == every // 2:
            course.append((sum(step.milliseconds for step in steps) / 1000, _test_psnr(module)))
        if step.iteration % PRODUCT_EVERY == 0:
            products.append(milliseconds(product))

    module = config_run(scope, variant.threads, between, variant.options)
    numbers = {name: tensor.detach() for name, tensor in module.named_parameters()}
    return Trained(steps, course, products or [milliseconds(product)], numbers)


def _test_psnr(module: SplatModule) -> float:
    data: ColmapDataModule = module.trainer.datamodule  # type: ignore[attr-defined]  # Lightning does not type it
    with torch.no_grad():
        splats = module.hard_splats(module.phase)
        return evaluate(
            lambda camera: module.render_splats(splats, camera).image, data.test_dataloader(), module.device
        ).psnr


def _run_row(workload: str, variant: Variant, runs: Sequence[Trained], shipped: Sequence[Trained]) -> Measurement:
    timing, first = _timing(runs), runs[0]
    # Mean steps in matrix products, so that a busy machine is not mistaken for a slow variant.
    own, other = (fmean(each.samples) / median(each.sgemm) for each in (timing, _timing(shipped)))
    by_phase: dict[Phase, list[float]] = {}
    for step in (step for trained in runs for step in trained.steps):
        by_phase.setdefault(step.phase, []).append(step.milliseconds)
    values = {
        "PSNR dB": first.course[-1][1],
        "seconds": fmean(trained.seconds for trained in runs),
        "times as shipped": own / other,
        **{f"{phase.name.lower()} ms": median(times) for phase, times in by_phase.items()},
        "splats": float(len(first.numbers["splats.means"])),
        "other numbers": float(different_numbers(first.numbers, shipped[0].numbers)),
    }
    if variant.off is not None:
        values["saves %"] = 100 * (1 - other / own)
    note = "times are of whole steps, those that start a phase included; PSNR is that of the test views"
    return Measurement("train", workload, variant.name, RUN, variant.threads, timing, values, note, tuple(first.course))


def _timing(runs: Sequence[Trained]) -> Timing:
    steps = tuple(step.milliseconds for trained in runs for step in trained.steps)
    return Timing(steps, tuple(time for trained in runs for time in trained.sgemm))


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


# The parts of a step


def part_rows(scope: Scope) -> Iterator[Measurement]:
    """A table of parts for each phase, whose sum is the whole step, with the largest number of threads.

    With several thread counts, the same run with the fewest of them trains the same bits, so that each part is compared
    over the same steps; whole steps are compared without cProfile.
    """
    few, many = min(scope.threads), max(scope.threads)
    samplers = {}
    for threads in {many, few}:
        samplers[threads] = StepSampler(scope.steps)
        config_run(scope, threads, samplers[threads])
    products = samplers[many].products
    for phase in Phase:
        steps = _middle(samplers[many], phase)
        plain = {n: [step.milliseconds for step in each.plain if step.phase is phase] for n, each in samplers.items()}
        if not steps or not plain[many]:
            continue  # a short run may have no step of a phase
        parts, fewer = _parts_of(samplers[many], steps), _parts_of(samplers[few], steps)
        note = f"cProfile is in the times: without it the median step takes {median(plain[many]):.3g} ms"
        if few < many:
            faster = median(samplers[few].products) / median(products)
            note += f"; with {many} threads instead of {few} the matrix product is {faster:.2f} times faster"
        for name, times in parts.items():
            values = {"share %": 100 * fmean(times) / fmean(parts[WHOLE])}
            few_ms, many_ms = median(fewer.get(name, times)), median(times)
            if name == WHOLE:
                few_ms, many_ms = median(plain[few]), median(plain[many])
            if few < many and few_ms > 0 and many_ms > 0:
                values["times faster"] = few_ms / many_ms
                values["serial %"] = 100 * serial_share(few, few_ms, many, many_ms)
            timing, operation = Timing(tuple(times), tuple(products)), f"parts of a {phase.name.lower()} step"
            yield Measurement("train", run_name(scope), name, operation, many, timing, values, note)


def _middle(sampler: StepSampler, phase: Phase) -> set[int]:
    """Profiled iterations of a phase, the middle half by time: what is outside had a disturbance or a pause."""
    times = sorted((step.milliseconds, step.iteration) for step, _ in sampler.profiled if step.phase is phase)
    return {iteration for _, iteration in times[len(times) // 4 : len(times) - len(times) // 4]}


def _parts_of(sampler: StepSampler, iterations: set[int]) -> dict[str, list[float]]:
    """Milliseconds of the whole step and of each part in some profiled steps, the longest part first."""
    profiled = [(step, parts) for step, parts in sampler.profiled if step.iteration in iterations]
    found = {name: [parts.get(name, 0.0) for _, parts in profiled] for name in (*PARTS, OTHER)}
    found = {name: times for name, times in found.items() if any(times)}
    found[OUTSIDE] = [step.milliseconds - sum(parts.values()) for step, parts in profiled]
    longest = sorted(found.items(), key=lambda item: -sum(item[1]))
    return {WHOLE: [step.milliseconds for step, _ in profiled], **dict(longest)}


def serial_share(few: int, few_ms: float, many: int, many_ms: float) -> float:
    """Amdahl: the share s of the time with one thread that is not divided by their number, T(n) ∝ s + (1 - s) / n.

    Clipped to [0, 1], where noise or caches go beyond it.
    """
    serial = (many * many_ms - few * few_ms) / (many - few)
    divided = few * (few_ms - serial)
    return min(1.0, max(0.0, serial / (serial + divided)))


# Growth


def size_rows(scope: Scope) -> Iterator[Measurement]:
    """Render, loss, backward pass and Adam on every workload, each in a process whose peak of memory is its own."""
    threads = max(scope.threads)
    for name in scope.workloads:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            timing, peak = pool.apply(_step_alone, (name, scope, threads))
        size = SIZES[name]
        values = {"splats": float(size.splats), "megapixels": size.width * size.height / 1e6, "peak MB": peak / 1e6}
        yield Measurement("train", "synthetic scenes", f"step: {name}", ALONE, threads, timing, values)


def _step_alone(name: str, scope: Scope, threads: int) -> tuple[Timing, int]:
    """Times of a step, and the largest resident memory of this process so far, bytes; 0 where no one says."""
    workload = synthetic_workload(name)
    splats = Splats.from_tensors(*workload.splats)
    optimizer = build_adam(param_groups(splats, {}, LearningRates(), extent=1.0))
    photo = torch.full(workload.image_gradient.shape, 128, dtype=torch.uint8)

    def step() -> None:
        optimizer.zero_grad()
        loss = photometric_loss(render(splats.raw(), workload.camera).image, photo)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    timing = measure([Case("step", step)], scope, threads)["step"]
    # Not resource.getrusage, whose maximum a new process takes over from the one that starts it.
    status = Path("/proc/self/status")
    lines = status.read_text(encoding="utf-8").splitlines() if status.exists() else []
    return timing, next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)
