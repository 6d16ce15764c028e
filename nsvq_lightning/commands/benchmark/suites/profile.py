"""Where the time of a training step goes: a table of parts for each phase.

Steps are those of ``nsvq fit``: its module, data, callbacks, loggers and trainer. Every function and kernel of the
package is timed by itself (:mod:`nsvq_lightning.commands.benchmark.stopwatches`), and Lightning tells when it fetches
data, calls a hook or steps the optimiser. A part is a set of such names. What has no name is Lightning's loop, up to
what the loop takes around a module that does nothing; the remainder is called unexplained. A few more steps run under
torch's profiler, without the clocks: it names the torch operators, which are spread over the parts.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import torch
from lightning.pytorch import LightningModule
from torch import Tensor, nn
from torch.autograd.profiler import profile as torch_profile

from nsvq_lightning.commands.benchmark.fitting import Step, StepClock, fit, one_phase, training_callbacks
from nsvq_lightning.commands.benchmark.row import Row, Timing
from nsvq_lightning.commands.benchmark.settings import Settings
from nsvq_lightning.commands.benchmark.stopwatches import Own, Recorder, RecordingProfiler, timed_functions
from nsvq_lightning.commands.benchmark.timing import milliseconds, sgemm, use_threads
from nsvq_lightning.commands.benchmark.trainees import Trainee, trainee
from nsvq_lightning.data.scene import View
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.training.schedule import Phase

__all__ = ["LIGHTNING", "PARTS", "UNEXPLAINED", "WHOLE", "Profile", "parts_of", "run"]

WHOLE, LIGHTNING, UNEXPLAINED = "whole step", "Lightning", "unexplained"

PARTS = (
    ("data", ("*train_dataloader_next", "*batch_to_device", "nsvq_lightning.data.*")),
    ("project", ("*.project_splats", "*.find_visible", "*._Frame.project")),
    ("SH and records", ("*.finish_records",)),
    ("sort", ("*.sort_by_depth",)),
    ("bin", ("*.count_tiles", "*.fill_tiles", "*._Frame.bin")),
    ("blend", ("*.cpu.blend.blend",)),
    ("blend backward", ("*.blend_backward", "*.total_slots")),
    ("projection backward", ("*.project_backward",)),
    ("loss", ("nsvq_lightning.quality.*",)),
    ("rows of visible splats", ("nsvq_lightning.compute.rows*",)),
    ("Adam", ("*.optimizer_step", "nsvq_lightning.training.optim.*", "nsvq_lightning.training.adam_cpu.*")),
    ("density statistics", ("*.DensityControl._observe", "*.add_view", "*.add_table", "*.cpu.statistics.*")),
    ("rasterizer, its Python", ("nsvq_lightning.rendering.*",)),
    ("quantizer: noise backward", ("*.substitute_backward", "*.substitution._add_parts", "*Substitution.backward")),
    ("quantizer: noise", ("*.substitution.*", "*.quantize.noise.*", "*.quantize.nsvq.*")),
    ("quantizer: count", ("*.CodebookQuantizer.count",)),
    ("quantizer: decode", ("*.quantize.sums.*", "*.CodebookQuantizer.decode", "nsvq_lightning.quantize.scene.*")),
    ("quantizer: search", ("nsvq_lightning.quantize.*",)),
    ("other callbacks", ("nsvq_lightning.callbacks.*",)),
    ("autograd's own", ("*Strategy.backward",)),
    ("module, its Python and torch", ("nsvq_lightning.*",)),
)
"""Parts by the names that belong to them; the first pattern that fits counts. What fits none is left to Lightning."""

WARM_STEPS, STEPS = {True: 6, False: 60}, {True: 8, False: 60}
"""Steps before those that are counted, and steps that are: searches that remember need some to have something to."""
TORCH_STEPS = 3
"""Steps under torch's profiler."""
PRODUCT_EVERY = 4
"""Steps between two matrix products: one after each step would empty the caches for the next."""
SMALLEST = 0.5
"""Parts below this share, %, are one line together."""


class Profile(NamedTuple):
    """Steps of one phase.

    Attributes:
        milliseconds: Whole steps.
        parts: Each part in those steps, by name.
        calls: Timed calls of a part in a step.
        sgemm: Matrix products in between.
        operators: Milliseconds a step in each of torch's operators by itself, largest first.
    """

    milliseconds: tuple[float, ...]
    parts: Mapping[str, tuple[float, ...]]
    calls: Mapping[str, float]
    sgemm: tuple[float, ...]
    operators: Mapping[str, float]


def run(settings: Settings) -> list[Row]:
    """Profile the steps of every phase with the largest number of threads."""
    threads = max(settings.threads)
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder, use_threads(threads):
        subject = trainee(settings, Path(folder))
        loop = _empty_loop(subject, settings.quick)
        rows = []
        for phase in Phase:
            profile = _profile(subject, phase, settings.quick)
            rows += _rows(profile, subject.name, f"{phase.name.lower()} step", threads, loop)
        return rows


def _profile(subject: Trainee, phase: Phase, quick: bool) -> Profile:
    recorder, product = Recorder(), sgemm()
    steps: list[tuple[float, Mapping[str, Own]]] = []
    products: list[float] = []
    warm, last = WARM_STEPS[quick], WARM_STEPS[quick] + STEPS[quick]
    operators = torch_profile(use_kineto=False)  # Kineto writes lines of its own to the terminal
    with ExitStack() as timing:

        def between(_: Any, __: View, step: Step) -> None:
            own = recorder.take()
            if step.iteration == warm:
                timing.enter_context(timed_functions(recorder))
            # The step in which the timing began has seen it in part only.
            if warm + 1 < step.iteration <= last:
                steps.append((step.milliseconds, own))
            if step.iteration <= last and step.iteration % PRODUCT_EVERY == 0:
                products.append(milliseconds(product))
            if step.iteration == last:
                timing.close()
                timing.enter_context(operators)

        module = subject.module(codebooks="1k" if quick else "16k", quantizer=partial(NSVQ, kmeans_steps=1))
        whole = last + TORCH_STEPS
        callbacks = [*training_callbacks(phases=one_phase(phase, whole)), StepClock(between)]
        fit(module, subject.data(), callbacks, whole, RecordingProfiler(recorder))
    return _summary(steps, products, _operator_times(operators))


def _operator_times(profiler: torch_profile) -> dict[str, float]:
    """Milliseconds a step in each of torch's operators, largest first."""
    averages: Any = profiler.key_averages()  # type: ignore[no-untyped-call]
    events = sorted(averages, key=lambda event: -event.self_cpu_time_total)
    return {
        event.key.removeprefix("aten::"): event.self_cpu_time_total / 1000 / TORCH_STEPS
        for event in events
        if event.key.startswith("aten::")
    }


def _summary(
    steps: Sequence[tuple[float, Mapping[str, Own]]], products: Sequence[float], operators: Mapping[str, float]
) -> Profile:
    """Add names up to parts in the middle half of the steps; what is outside had a disturbance or a pause."""
    ordered = sorted(steps, key=lambda step: step[0])
    middle = ordered[len(ordered) // 4 : len(ordered) - len(ordered) // 4]
    added = [parts_of(own) for _, own in middle]
    names = dict.fromkeys(name for parts in added for name in parts)
    return Profile(
        tuple(total for total, _ in middle),
        {name: tuple(1000 * parts.get(name, Own()).seconds for parts in added) for name in names},
        {name: fmean(parts.get(name, Own()).calls for parts in added) for name in names},
        tuple(products),
        operators,
    )


def parts_of(own: Mapping[str, Own]) -> dict[str, Own]:
    """Times by part from times by name."""
    parts: dict[str, Own] = {}
    for name, (seconds, calls) in own.items():
        part = next((part for part, patterns in PARTS if any(fnmatchcase(name, p) for p in patterns)), None)
        if part is not None:
            before = parts.get(part, Own())
            parts[part] = Own(before.seconds + seconds, before.calls + calls)
    return parts


def _rows(profile: Profile, workload: str, operation: str, threads: int, loop: float) -> list[Row]:
    total = fmean(profile.milliseconds)
    parts = dict(profile.parts)
    covered = [sum(values) for values in zip(*parts.values(), strict=True)]
    # What no part has: Lightning's, up to what its loop takes by itself.
    remaining = [whole - inner for whole, inner in zip(profile.milliseconds, covered, strict=True)]
    parts[LIGHTNING] = tuple(min(rest, loop) for rest in remaining)
    parts[UNEXPLAINED] = tuple(rest - min(rest, loop) for rest in remaining)
    shares = {name: 100 * fmean(samples) / total for name, samples in parts.items()}
    small = [name for name in parts if shares[name] < SMALLEST and name not in (LIGHTNING, UNEXPLAINED)]
    if small:
        parts["smaller parts"] = tuple(map(sum, zip(*(parts.pop(name) for name in small), strict=True)))
        shares["smaller parts"] = sum(shares.pop(name) for name in small)
    note = f"the middle half of the steps by their time; Lightning's loop around an empty module takes {loop:.2f} ms"
    large = [f"{name} {time:.2f} ms" for name, time in profile.operators.items() if 100 * time > SMALLEST * total]
    if large:
        note += f"; torch's operators, which are in several parts: {', '.join(large)}"
    if small:
        note += f"; smaller parts: {', '.join(sorted(small))}"
    rows = []
    for name in (WHOLE, *sorted(parts, key=lambda name: -shares[name])):
        samples = profile.milliseconds if name == WHOLE else parts[name]
        values = {"share %": 100.0 if name == WHOLE else shares[name]}
        if name in profile.calls:
            values["calls"] = profile.calls[name]
        rows.append(Row("profile", workload, name, operation, threads, Timing(samples, profile.sgemm), values, note))
    return rows


class _Nothing(LightningModule):
    """One number that is trained to be 0."""

    def __init__(self) -> None:
        super().__init__()
        self.number = nn.Parameter(torch.ones(()))

    def training_step(self, batch: View, batch_idx: int) -> Tensor:
        return self.number.square()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1e-3)


def _empty_loop(subject: Trainee, quick: bool) -> float:
    """Median step of a module that does nothing without its data, ms: Lightning's hooks, loggers and bookkeeping."""
    recorder = Recorder()
    times: list[float] = []

    def between(_: Any, __: View, step: Step) -> None:
        data = parts_of(recorder.take()).get("data", Own())
        times.append(step.milliseconds - 1000 * data.seconds)

    steps = WARM_STEPS[quick] + STEPS[quick]
    fit(_Nothing(), subject.data(), [StepClock(between)], steps, RecordingProfiler(recorder))
    return median(times[WARM_STEPS[quick] :])
