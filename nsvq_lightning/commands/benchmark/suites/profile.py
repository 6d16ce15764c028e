"""Where the time of a training step goes: a table of parts for each phase, whose sum is the whole step.

Steps are those of ``nsvq fit``: its module, data, callbacks, loggers and trainer. Every second one runs under cProfile,
which gives each Python function and each Numba kernel the time that it spends in itself. An operator of torch counts
for the Python function that called it. A part is a set of functions.
"""

from __future__ import annotations

import cProfile
import sys
import tempfile
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import numba

from nsvq_lightning.commands.benchmark.fitting import Step
from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.suite_list import Unavailable
from nsvq_lightning.commands.benchmark.timing import milliseconds, sgemm, use_threads
from nsvq_lightning.commands.benchmark.trainees import Trainee, trainee
from nsvq_lightning.data.scene import View
from nsvq_lightning.training.schedule import Phase

__all__ = ["OTHER", "OUTSIDE", "PARTS", "WHOLE", "Own", "part_of", "run"]

WHOLE, OTHER, OUTSIDE = "whole step", "other Python", "between the functions"

CPU = "nsvq_lightning.rendering.cpu"
QUANTIZE = "nsvq_lightning.quantize"

PARTS = {
    "data": ("nsvq_lightning.data.*", "torch.utils.data.*", "lightning.pytorch.loops.fetchers.*"),
    "project": (f"{CPU}.projection.project_splats", f"{CPU}.projection.find_visible"),
    "SH and records": (f"{CPU}.projection.finish_records",),
    "sort": (f"{CPU}.binning.sort_by_depth",),
    "bin": (f"{CPU}.binning.count_tiles", f"{CPU}.binning.fill_tiles"),
    "blend": (f"{CPU}.blend.blend",),
    "blend backward": (f"{CPU}.blend.blend_backward", f"{CPU}.blend.total_slots"),
    "projection backward": (f"{CPU}.projection_backward.project_backward",),
    "density statistics": (f"{CPU}.statistics.*", "nsvq_lightning.callbacks.density.*"),
    "rasterizer, its Python": ("nsvq_lightning.rendering.*",),
    "loss": ("nsvq_lightning.quality.*",),
    "Adam": ("nsvq_lightning.training.optim.*", "torch.optim.*"),
    "rows of visible splats": ("nsvq_lightning.compute.rows.*",),
    "buffers, checks and thread counts": ("nsvq_lightning.compute.*", "numba.*"),
    "quantizer: noise backward": (
        f"{QUANTIZE}.substitution.*backward*",
        f"{QUANTIZE}.substitution._add_parts",
        f"{QUANTIZE}.nsvq.*.backward",
    ),
    "quantizer: noise": (f"{QUANTIZE}.substitution.*", f"{QUANTIZE}.noise.*", f"{QUANTIZE}.nsvq.*"),
    "quantizer: count": (f"{QUANTIZE}.codebook.CodebookQuantizer.count", f"{QUANTIZE}.sums.*count_hits"),
    "quantizer: decode": (
        f"{QUANTIZE}.sums.*",
        f"{QUANTIZE}.codebook.CodebookQuantizer.decode",
        f"{QUANTIZE}.scene.*",
    ),
    "quantizer: search": (f"{QUANTIZE}.*",),
    "other callbacks": ("nsvq_lightning.callbacks.*",),
    "module, its Python": ("nsvq_lightning.*",),
    "autograd's own": ("torch.autograd.graph.*",),
    "torch's Python": ("torch.*",),
    "Lightning": ("lightning.*", "contextlib.*"),
}
"""Parts by the functions that belong to them; the first pattern that fits counts. The rest is :data:`OTHER`."""

WARM_STEPS, STEPS = {True: 6, False: 60}, {True: 16, False: 120}
"""Steps before those that are counted, and steps that are, with and without cProfile: searches that remember need some
to have something to."""
PRODUCT_EVERY = 3
"""Steps between two matrix products: one after each step would empty the caches for the next. An odd number, so that
steps with and without cProfile come after a product equally often."""


class Own(NamedTuple):
    """What a part takes in a step, and how many calls of its functions that is."""

    milliseconds: float = 0.0
    calls: int = 0


def run(scope: Scope) -> list[Measurement]:
    """Profile the steps of every phase with the largest number of threads.

    Raises:
        Unavailable: Kernels would not show in a profile.
    """
    if sys.version_info >= (3, 12) and not numba.config.ENABLE_SYS_MONITORING:
        raise Unavailable("kernels show in a profile only if NUMBA_ENABLE_SYS_MONITORING=1 when Numba is loaded")
    threads = max(scope.threads)
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder, use_threads(threads):
        subject = trainee(scope, Path(folder))
        return [row for phase in Phase for row in _rows(subject, phase, scope, threads)]


def _rows(subject: Trainee, phase: Phase, scope: Scope, threads: int) -> list[Measurement]:
    profiler, product = cProfile.Profile(builtins=False, subcalls=False), sgemm()
    profiled: list[tuple[float, dict[str, Own]]] = []
    plain: list[float] = []
    products: list[float] = []
    warm = WARM_STEPS[scope.quick]
    last = warm + STEPS[scope.quick]

    def between(_: Any, __: View, step: Step) -> None:
        profiler.disable()
        parts = _parts(profiler.getstats())
        profiler.clear()
        if parts:
            profiled.append((step.milliseconds, parts))
        elif step.iteration > warm:
            plain.append(step.milliseconds)
        if step.iteration % PRODUCT_EVERY == 0:
            products.append(milliseconds(product))
        if warm <= step.iteration < last and step.iteration % 2 == 0:
            profiler.enable()

    subject.train(phase, last, between, codebooks=scope.codebooks)
    # What is outside the middle half had a disturbance or a pause.
    ordered = sorted(profiled, key=lambda step: step[0])
    middle = ordered[len(ordered) // 4 : len(ordered) - len(ordered) // 4]
    wholes = tuple(whole for whole, _ in middle)
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
        operation = f"{phase.name.lower()} step"
        rows.append(
            Measurement("profile", subject.name, name, operation, threads, Timing(times, tuple(products)), values, note)
        )
    return rows


def _parts(stats: Iterable[Any]) -> dict[str, Own]:
    """What each part takes, from the entries of a profile."""
    modules = {getattr(module, "__dict__", {}).get("__file__"): name for name, module in list(sys.modules.items())}
    parts: dict[str, Own] = {}
    for entry in stats:
        file = entry.code.co_filename
        name = part_of(f"{modules.get(file, file)}.{entry.code.co_qualname}")
        before = parts.get(name, Own())
        parts[name] = Own(before.milliseconds + 1000 * entry.inlinetime, before.calls + entry.callcount)
    return parts


def part_of(function: str) -> str:
    """The part that a function belongs to, by its full name: ``nsvq_lightning.rendering.cpu.blend.blend``."""
    fitting = (part for part, patterns in PARTS.items() if any(fnmatchcase(function, p) for p in patterns))
    return next(fitting, OTHER)
