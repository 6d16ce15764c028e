"""What more cores bring: each part of the steps of a whole run, with few and with many threads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean

from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.recipe_run import recipe_name, recipe_run
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.step_profile import OTHER, PARTS, WHOLE, Own, StepSampler
from nsvq_lightning.commands.benchmark.timing import sgemm
from nsvq_lightning.training.schedule import Phase

__all__ = ["core_rows", "serial_share"]

EXTRAPOLATED = 8, 16
NOTE = (
    "means of the same steps with the fewest and the most threads, without the tenth of them with the lowest and the "
    "tenth with the highest speed-up; whole steps are without cProfile, parts with it. serial % is what Amdahl's law "
    "leaves undivided of the time with one thread: compare it with that of the matrix product, which has nothing "
    "serial, so that its share is what the cores of this machine take from each other; times with more threads follow "
    "from it, if every core comes with as much memory bandwidth and cache as here and no loop is too short for them"
)


def core_rows(scope: Scope) -> list[Measurement]:
    """The run with the fewest and the most threads of the scope, compared step by step; needs two of them.

    Raises:
        Unavailable: Kernels would not show in a profile.
    """
    few, many = min(scope.threads), max(scope.threads)
    samplers = {}
    for threads in (many, few):
        samplers[threads] = StepSampler(0, scope.steps)
        recipe_run(scope, threads, samplers[threads])
    few_steps, many_steps = (samplers[threads] for threads in (few, many))
    parts = _pairs(few_steps, many_steps)
    by_phase = {"all steps": parts[WHOLE]}
    for phase in Phase:
        by_phase[f"{phase.name.lower()} step"] = _plain_pairs(few_steps, many_steps, phase)
    by_phase[sgemm().name] = list(zip(few_steps.products, many_steps.products, strict=False))
    products = few_steps.products + many_steps.products
    return [*_rows(scope, "phases", by_phase, products), *_rows(scope, "parts", parts, products)]


def serial_share(few: int, few_ms: float, many: int, many_ms: float) -> float:
    """Amdahl: the share s of the time with one thread that is not divided by their number, T(n) ∝ s + (1 - s) / n.

    Clipped to [0, 1], where noise or caches go beyond it.
    """
    serial = (many * many_ms - few * few_ms) / (many - few)
    divided = few * (few_ms - serial)
    return min(1.0, max(0.0, serial / (serial + divided)))


def _plain_pairs(few: StepSampler, many: StepSampler, phase: Phase | None = None) -> list[tuple[float, float]]:
    """Milliseconds of the same steps with few and with many threads, without cProfile."""
    others = {step.iteration: step.milliseconds for step in many.plain}
    return [
        (step.milliseconds, others[step.iteration])
        for step in few.plain
        if step.iteration in others and phase in (None, step.phase)
    ]


def _pairs(few: StepSampler, many: StepSampler) -> dict[str, list[tuple[float, float]]]:
    """Milliseconds of the whole step, and of each part, with few and with many threads, step by step."""
    pairs = {WHOLE: _plain_pairs(few, many)}
    profiled = {step.iteration: parts for step, parts in many.profiled}
    both = [(parts, profiled[step.iteration]) for step, parts in few.profiled if step.iteration in profiled]
    for name in (*PARTS, OTHER):
        pairs[name] = [(one.get(name, Own()).milliseconds, other.get(name, Own()).milliseconds) for one, other in both]
    return pairs


def _kept(times: Sequence[tuple[float, float]]) -> Sequence[tuple[float, float]]:
    ordered = sorted(times, key=lambda pair: pair[0] / pair[1] if pair[1] else 0.0)
    cut = len(ordered) // 10
    return ordered[cut : len(ordered) - cut]


def _rows(
    scope: Scope, what: str, pairs: Mapping[str, Sequence[tuple[float, float]]], products: Sequence[float]
) -> Iterator[Measurement]:
    few, many = min(scope.threads), max(scope.threads)
    for name, all_times in pairs.items():
        times = _kept(all_times)
        few_ms, many_ms = (fmean(pair[side] for pair in times) if times else 0.0 for side in (0, 1))
        if not (few_ms > 0 and many_ms > 0):
            continue
        serial = serial_share(few, few_ms, many, many_ms)
        one = few_ms / (serial + (1 - serial) / few)
        values = {
            f"ms, {few}": few_ms,
            f"ms, {many}": many_ms,
            "times faster": few_ms / many_ms,
            "serial %": 100 * serial,
            "serial ms": one * serial,
            **{f"ms, {n} expected": one * (serial + (1 - serial) / n) for n in EXTRAPOLATED},
        }
        timing = Timing(tuple(pair[1] for pair in times), tuple(products))
        operation = f"{what} with {few} and {many} threads"
        yield Measurement("train", recipe_name(scope), name, operation, many, timing, values, NOTE)
