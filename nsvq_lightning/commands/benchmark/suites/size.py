"""How time and memory of a training step grow with the number of splats and of pixels.

Every size is trained in a process of its own, so that its peak of memory is its own. Peaks are of everything in the
process: Python, torch, compiled kernels, three photos, the splats with gradients and moments, and the buffers of
renderer and loss.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from nsvq_lightning.commands.benchmark.fitting import Step
from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.sizes import Size
from nsvq_lightning.commands.benchmark.timing import milliseconds, sgemm, use_threads
from nsvq_lightning.commands.benchmark.trainees import photographed
from nsvq_lightning.commands.benchmark.workloads import sized_workload
from nsvq_lightning.data.scene import View
from nsvq_lightning.training.schedule import Phase

__all__ = ["run"]

SPLATS = {
    True: (5_000,),
    False: (20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000, 5_000_000),
}
"""Numbers of splats, at :data:`SIDE` pixels."""
SIDES = {True: (64,), False: (316, 500, 707, 1000, 1414, 2000)}
"""Sides of square pictures, pixels, with :data:`FIXED` splats."""
SIDE, FIXED = {True: 128, False: 707}, {True: 5_000, False: 200_000}
WARM_STEPS, STEPS, PRODUCT_EVERY = 3, 9, 4
VIEWS = 3


class Trained(NamedTuple):
    """What a process reports: milliseconds of its steps and of matrix products, and its peak of memory in bytes."""

    steps: list[float]
    products: list[float]
    peak: int


def run(scope: Scope) -> list[Measurement]:
    """Train a few steps of the prune phase at every size, with the largest number of threads."""
    threads, quick = max(scope.threads), scope.quick
    rows = []
    for count in SPLATS[quick]:
        timing, peak = _measured(count, SIDE[quick], threads)
        values = {"splats": count, "µs a splat": 1000 * timing.median / count, "peak MB": peak / 1e6}
        workload, method = f"{SIDE[quick]}x{SIDE[quick]}", f"{count:,} splats"
        rows.append(Measurement("size", workload, method, "step by splats", threads, timing, values))
    for side in SIDES[quick]:
        timing, peak = _measured(FIXED[quick], side, threads)
        values = {"megapixels": side**2 / 1e6, "ns a pixel": 1e6 * timing.median / side**2, "peak MB": peak / 1e6}
        workload, method = f"{FIXED[quick]:,} splats", f"{side}x{side}"
        rows.append(Measurement("size", workload, method, "step by pixels", threads, timing, values))
    return rows


def _measured(splats: int, side: int, threads: int) -> tuple[Timing, int]:
    """Times of steps, and the peak of memory in bytes; splats are as small as in the named scenes of about as many."""
    size = Size(splats, side, side, 0.01 * (100_000 / splats) ** 0.36)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        steps, products, peak = pool.apply(_train, (size, threads))
    return Timing(tuple(steps), tuple(products)), peak


def _train(size: Size, threads: int) -> Trained:
    steps: list[float] = []
    products: list[float] = []
    product = sgemm()

    def between(_: Any, __: View, step: Step) -> None:
        if step.iteration > WARM_STEPS:
            steps.append(step.milliseconds)
        if step.iteration % PRODUCT_EVERY == 0:
            products.append(milliseconds(product))

    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder, use_threads(threads):
        subject = photographed(sized_workload("size", size), Path(folder), VIEWS)
        subject.train(Phase.PRUNE, WARM_STEPS + STEPS, between, codebooks=None)
    return Trained(steps, products, _peak())


def _peak() -> int:
    """Largest resident memory of this process so far, bytes; 0 where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
