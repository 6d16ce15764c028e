"""Fair times on a shared machine: what is compared takes turns, and a matrix product takes part."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.random import generator

__all__ = ["Case", "Measurement", "Timing", "finish", "measure", "milliseconds", "sgemm", "use_threads"]

SGEMM_SIDE = 2048


@dataclass(frozen=True)
class Timing:
    """Times of one case and of the matrix products that were interleaved with it.

    Attributes:
        samples: Milliseconds of each call, in the order of the calls.
        sgemm: Milliseconds of each 2048³ float32 matrix product of torch.
    """

    samples: tuple[float, ...]
    sgemm: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median, ms."""
        return statistics.median(self.samples)

    @property
    def quartiles(self) -> tuple[float, float]:
        """First and third quartile, ms; the sample itself where there is only one."""
        if len(self.samples) == 1:
            return self.samples[0], self.samples[0]
        first, _, third = statistics.quantiles(self.samples, n=4, method="inclusive")
        return first, third

    @property
    def ratio(self) -> float:
        """Median as a multiple of the median matrix product: comparable between machines and between busy hours."""
        return self.median / statistics.median(self.sgemm)


@dataclass(frozen=True)
class Measurement:
    """One row of a table.

    Attributes:
        suite: Name of the suite.
        workload: What it was done to.
        method: How it was done; what is before a colon is the name of a curve.
        operation: What was done; measurements of one operation are compared with each other.
        threads: Threads it was done with.
        timing: How long it took.
        values: Errors and sizes by name, the unit in the name where there is one.
        note: How the errors were measured, where that is not on the workload itself.
        course: Seconds and the first value during a run, ``(s, value)``. Empty for single calls.
    """

    suite: str
    workload: str
    method: str
    operation: str
    threads: int
    timing: Timing
    values: Mapping[str, float] = field(default_factory=dict)
    note: str = ""
    course: tuple[tuple[float, float], ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The measurement as JSON values, samples included."""
        timing = self.timing
        known = {"median_ms": timing.median, "quartiles_ms": timing.quartiles, "sgemm_ratio": timing.ratio}
        return {**asdict(self), **known}


@dataclass(frozen=True, eq=False)
class Case:
    """Something to be timed.

    Attributes:
        name: Key of the result.
        run: The timed call.
        prepare: Done before every call, not timed.
    """

    name: str
    run: Callable[[], object]
    prepare: Callable[[], object] | None = None


def measure(cases: Sequence[Case], scope: Scope, threads: int, device: torch.device | str = "cpu") -> dict[str, Timing]:
    """Time cases in turns, in an order that rotates from round to round, after one call each that is not counted.

    The first call compiles kernels and grows buffers. A case that has used up ``scope.seconds`` sits out the
    remaining rounds, so that one slow method does not make the run endless; the matrix product never sits out. Python's
    cyclic collector waits for the end.

    Args:
        cases: What to time, by different names.
        scope: Number of rounds and time limit.
        threads: Threads of torch and of the kernels.
        device: Where the work is done, and the matrix product.

    Returns:
        Times by name of the case.

    Raises:
        ValueError: Two cases have the same name.
    """
    names = [case.name for case in cases]
    if len(set(names)) != len(names):
        raise ValueError(f"cases need different names, got {names}")
    product = sgemm(device)
    players = [product, *cases]
    samples: dict[str, list[float]] = {case.name: [] for case in players}
    gc.collect()
    gc.disable()
    try:
        with use_threads(threads):
            for case in players:
                milliseconds(case, device)
            for turn in range(scope.repeats):
                shift = turn % len(players)
                for case in players[shift:] + players[:shift]:
                    if case is product or sum(samples[case.name]) < 1000 * scope.seconds:
                        samples[case.name].append(milliseconds(case, device))
    finally:
        gc.enable()
    return {name: Timing(tuple(samples[name]), tuple(samples[product.name])) for name in names}


@contextmanager
def use_threads(threads: int) -> Iterator[None]:
    """Let torch, and with it the kernels of this package, use a number of threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def milliseconds(case: Case, device: torch.device | str = "cpu") -> float:
    """Time one call, its preparation left out.

    On a GPU, that is from when it begins the first work to when it ends the last, its waits for the host included.
    """
    if case.prepare is not None:
        case.prepare()
    finish()
    if torch.device(device).type == "cuda":
        first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
        first.record()
        case.run()
        last.record()
        last.synchronize()
        return float(first.elapsed_time(last))
    start = time.perf_counter_ns()
    case.run()
    finish()
    return (time.perf_counter_ns() - start) / 1e6


def finish() -> None:
    """Wait for kernels of a GPU that are still running."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def sgemm(device: torch.device | str = "cpu") -> Case:
    """The matrix product that all times are compared with."""
    draw = generator(0, 0, "sgemm")
    left, right = (torch.randn(SGEMM_SIDE, SGEMM_SIDE, generator=draw).to(device) for _ in range(2))
    out = torch.empty_like(left)
    return Case("2048³ float32 matrix product", lambda: torch.mm(left, right, out=out))
