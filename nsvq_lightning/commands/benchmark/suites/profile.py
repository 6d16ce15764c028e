"""Where the time of a training step goes: a table of parts for each phase, whose sum is the whole step.

Steps are those of ``nsvq fit``: its module, data, callbacks, loggers and trainer. Every second one runs under cProfile
(:mod:`nsvq_lightning.commands.benchmark.parts`). With a config they are those of a whole run of it, otherwise each
phase is trained by itself, with the paper's settings.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean, median

from nsvq_lightning.commands.benchmark.fitting import Step
from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.recipe_run import recipe_name, recipe_run
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.step_profile import OTHER, OUTSIDE, PARTS, WHOLE, Own, StepSampler
from nsvq_lightning.commands.benchmark.timing import use_threads
from nsvq_lightning.commands.benchmark.trainees import trainee
from nsvq_lightning.training.schedule import Phase

__all__ = ["run"]

WARM_STEPS, STEPS = {True: 6, False: 60}, {True: 16, False: 120}
"""Steps before those that are counted, and steps that are, with and without cProfile: searches that remember need some
to have something to."""


def run(scope: Scope) -> list[Measurement]:
    """Profile the steps of every phase with the largest number of threads.

    Raises:
        Unavailable: Kernels would not show in a profile.
    """
    threads = max(scope.threads)
    if scope.config is not None:
        sampler = StepSampler(0, scope.steps)
        recipe_run(scope, threads, sampler)
        return [row for phase in Phase for row in _rows(recipe_name(scope), phase, sampler, threads)]
    warm = WARM_STEPS[scope.quick]
    last = warm + STEPS[scope.quick]
    rows = []
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder, use_threads(threads):
        subject = trainee(scope, Path(folder))
        for phase in Phase:
            sampler = StepSampler(warm, last)
            subject.train(phase, last, sampler, codebooks=scope.codebooks)
            rows += _rows(subject.name, phase, sampler, threads)
    return rows


def _rows(workload: str, phase: Phase, sampler: StepSampler, threads: int) -> list[Measurement]:
    profiled = [(step, parts) for step, parts in sampler.profiled if step.phase is phase]
    plain = [step.milliseconds for step in sampler.plain if step.phase is phase]
    if not profiled or not plain:
        return []  # a short run may have no step of a phase
    middle = _middle(profiled)
    wholes = tuple(step.milliseconds for step, _ in middle)
    samples = {name: tuple(parts.get(name, Own()).milliseconds for _, parts in middle) for name in (*PARTS, OTHER)}
    samples = {name: times for name, times in samples.items() if any(times)}
    covered = map(sum, zip(*samples.values(), strict=True))
    samples[OUTSIDE] = tuple(whole - inside for whole, inside in zip(wholes, covered, strict=True))
    note = (
        f"the middle half of the steps by their time; cProfile is in them: without it the median step takes "
        f"{median(plain):.3g} ms"
    )
    rows = []
    for name, times in [(WHOLE, wholes), *sorted(samples.items(), key=lambda item: -sum(item[1]))]:
        values = {"share %": 100 * sum(times) / sum(wholes)}
        calls = fmean(parts.get(name, Own()).calls for _, parts in middle)
        if calls:
            values["calls"] = calls
        timing = Timing(times, tuple(sampler.products))
        rows.append(Measurement("profile", workload, name, f"{phase.name.lower()} step", threads, timing, values, note))
    return rows


def _middle(profiled: Sequence[tuple[Step, dict[str, Own]]]) -> Sequence[tuple[Step, dict[str, Own]]]:
    """The middle half by time: what is outside had a disturbance or a pause."""
    ordered = sorted(profiled, key=lambda sample: sample[0].milliseconds)
    return ordered[len(ordered) // 4 : len(ordered) - len(ordered) // 4]
