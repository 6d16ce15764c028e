"""Fair times on a shared machine: what is compared takes turns, and a matrix product takes part."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from nsvq_lightning.commands.benchmark.measurement import Timing
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.random import generator

__all__ = ["Case", "finish", "measure", "milliseconds", "sgemm", "use_threads"]

SGEMM_SIDE = 2048


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
    remaining rounds, so that one slow method does not make the run endless; the matrix product never sits out.

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
    with use_threads(threads), _no_collection():
        for case in players:
            milliseconds(case, device)
        for turn in range(scope.repeats):
            shift = turn % len(players)
            for case in players[shift:] + players[:shift]:
                if case is product or sum(samples[case.name]) < 1000 * scope.seconds:
                    samples[case.name].append(milliseconds(case, device))
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


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keep Python's cyclic collector out of the times."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def milliseconds(case: Case, device: torch.device | str = "cpu") -> float:
    """Time one call, its preparation left out: by the clock, or by events in the stream of a GPU."""
    if case.prepare is not None:
        case.prepare()
    finish()
    return _between_events(case.run) if torch.device(device).type == "cuda" else _by_the_clock(case.run)


def _by_the_clock(run: Callable[[], object]) -> float:
    start = time.perf_counter_ns()
    run()
    finish()
    return (time.perf_counter_ns() - start) / 1e6


def _between_events(run: Callable[[], object]) -> float:
    """From when the GPU begins the first work to when it ends the last, its waits for the host included."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
    start.record()
    run()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end))


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
