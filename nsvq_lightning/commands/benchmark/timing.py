"""Fair times on a shared machine: what is compared takes turns, and a matrix product takes part."""

import gc
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.random import generator

SGEMM_SIDE = 2048

# What is timed.
Call = Callable[[], object]


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
        operation: What was done; measurements of one operation are compared with each other.
        workload: What it was done to.
        method: How it was done; what is before a colon is the name of a curve.
        threads: Threads it was done with.
        timing: How long it took.
        values: Errors and sizes by name, the unit in the name where there is one.
        note: How the errors were measured, where that is not on the workload itself.
    """

    operation: str
    workload: str
    method: str
    threads: int
    timing: Timing
    values: Mapping[str, float] = field(default_factory=dict)
    note: str = ""


def compare(
    operation: str,
    workload: str,
    cases: Mapping[str, Call],
    values: Mapping[str, Mapping[str, float]],
    scope: Scope,
    note: str = "",
    device: str = "cpu",
    prepare: Call | None = None,
) -> Iterator[Measurement]:
    """Time the methods of one operation with every number of threads; on a GPU only with the most, those of the host.

    Args:
        operation: See :class:`Measurement`.
        workload: See :class:`Measurement`.
        cases: What to time, by method.
        values: Errors and sizes by method, then by name.
        scope: Numbers of threads and of rounds, and the time limit.
        note: See :class:`Measurement`.
        device: Where the work is done.
        prepare: Done before every call, not timed.
    """
    for threads in scope.threads if device == "cpu" else (max(scope.threads),):
        for method, timing in measure(cases, scope, threads, device, prepare).items():
            yield Measurement(operation, workload, method, threads, timing, values[method], note)


def measure(
    cases: Mapping[str, Call], scope: Scope, threads: int, device: str = "cpu", prepare: Call | None = None
) -> dict[str, Timing]:
    """Time cases in turns, in an order that rotates from round to round, after one call each that is not counted.

    The first call compiles kernels and grows buffers. A case that has used up ``scope.seconds`` sits out the
    remaining rounds, so that one slow method does not make the run endless; the matrix product never sits out. Python's
    cyclic collector waits for the end.

    Args:
        cases: What to time, by name.
        scope: Number of rounds and time limit.
        threads: Threads of torch and of the kernels.
        device: Where the work is done, and the matrix product.
        prepare: Done before every call of a case, not timed.

    Returns:
        Times by name of the case.
    """
    product = sgemm(device)
    players = [("", product), *cases.items()]
    samples: dict[str, list[float]] = {name: [] for name, _ in players}
    gc.collect()
    gc.disable()
    try:
        with use_threads(threads):
            for turn in range(-1, scope.repeats):
                shift = max(turn, 0) % len(players)
                for name, call in players[shift:] + players[:shift]:
                    if name and sum(samples[name]) >= 1000 * scope.seconds:
                        continue
                    if name and prepare is not None:
                        prepare()
                    took = milliseconds(call, device)
                    if turn >= 0:
                        samples[name].append(took)
    finally:
        gc.enable()
    return {name: Timing(tuple(samples[name]), tuple(samples[""])) for name in cases}


@contextmanager
def use_threads(threads: int) -> Iterator[None]:
    """Let torch, and with it the kernels of this package, use a number of threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def milliseconds(call: Call, device: str = "cpu") -> float:
    """Time one call.

    On a GPU, that is from when it begins the first work to when it ends the last, its waits for the host included.
    """
    finish()
    if torch.device(device).type == "cuda":
        first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
        first.record()
        call()
        last.record()
        last.synchronize()
        return float(first.elapsed_time(last))
    start = time.perf_counter_ns()
    call()
    finish()
    return (time.perf_counter_ns() - start) / 1e6


def finish() -> None:
    """Wait for kernels of a GPU that are still running."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def sgemm(device: str = "cpu") -> Call:
    """The 2048³ float32 matrix product that all times are compared with."""
    draw = generator(0, 0, "sgemm")
    left, right = (torch.randn(SGEMM_SIDE, SGEMM_SIDE, generator=draw).to(device) for _ in range(2))
    out = torch.empty_like(left)
    return lambda: torch.mm(left, right, out=out)
