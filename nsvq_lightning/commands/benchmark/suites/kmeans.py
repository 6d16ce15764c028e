"""The k-means that starts the codebooks: what each further Lloyd step costs, and what it still brings."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.commands.benchmark.workloads import single_workload
from nsvq_lightning.quantize import QUANTIZED, codebook_sizes, kmeans, nearest, nearest_reference
from nsvq_lightning.random import generator

__all__ = ["distortion", "rounding_error", "run"]

LLOYD_STEPS = {True: (1, 10), False: (1, 3, 10)}
"""Lloyd steps that are compared, quick and full; training takes the last number."""
CHECKED_ROWS, CHECKED_CODES = 4_000, 256
"""Size at which k-means is repeated in float64."""
EVERY = "all attributes"


def run(scope: Scope) -> list[Measurement]:
    """Time the start of every codebook with every number of threads, fewer Lloyd steps with the largest only."""
    source = single_workload(scope, "C500k")
    tables = {name: attribute.rows(getattr(source.splats, name)) for name, attribute in QUANTIZED.items()}
    tables = {name: rows for name, rows in tables.items() if rows.shape[1] > 0}
    most = max(scope.threads)
    with use_threads(most):
        rounding = {name: rounding_error(rows) for name, rows in tables.items()}
    found = []
    for threads in scope.threads:
        steps = LLOYD_STEPS[scope.quick] if threads == most else LLOYD_STEPS[scope.quick][-1:]
        found += _rows(source.name, tables, steps, rounding, threads, scope)
    return found


def _rows(
    source: str,
    tables: Mapping[str, Tensor],
    steps: tuple[int, ...],
    rounding: Mapping[str, float],
    threads: int,
    scope: Scope,
) -> list[Measurement]:
    sizes, codebooks = codebook_sizes(scope.codebooks), dict[tuple[str, int], Tensor]()

    def start(name: str, count: int) -> None:
        draw = generator(0, 0, "start", name)
        codebooks[name, count] = kmeans(tables[name], sizes[name], draw, steps=count)

    keys = [(name, count) for name in tables for count in steps]
    cases = [Case(f"{name} {count}", lambda name=name, count=count: start(name, count)) for name, count in keys]  # type: ignore[misc]
    timings = dict(zip(keys, measure(cases, scope, threads).values(), strict=True))
    with use_threads(threads):
        kept = {(name, count): distortion(tables[name], codebook) for (name, count), codebook in codebooks.items()}
    note = f"{scope.codebooks} codebooks; rounding error on {CHECKED_ROWS} rows with {CHECKED_CODES} codes"
    rows = []
    for count in steps:
        method = f"{count} Lloyd step{'s' * (count > 1)}"
        for name, table in tables.items():
            workload = f"{source} {name}: {len(table)} rows, D {table.shape[1]}, K {sizes[name]}"
            values = {"distortion": kept[name, count], "rounding error": rounding[name]}
            rows.append(Measurement("kmeans", workload, method, "start", threads, timings[name, count], values, note))
        whole = _sum([timings[name, count] for name in tables])
        values = {"distortion": max(kept[name, count] for name in tables), "rounding error": max(rounding.values())}
        rows.append(Measurement("kmeans", f"{source} {EVERY}", method, "start", threads, whole, values, note))
    return rows


def _sum(timings: list[Timing]) -> Timing:
    """Times of doing one after the other."""
    samples = zip(*(timing.samples for timing in timings), strict=False)  # slow cases sit out the last rounds
    return Timing(tuple(map(sum, samples)), timings[0].sgemm)


def distortion(rows: Tensor, codebook: Tensor) -> float:
    """Mean squared distance of the rows ``[N, D]`` to their nearest codes, as a share of their variance."""
    away = (rows - codebook[nearest(rows, codebook)]).double().square().sum(1).mean()
    spread = rows.double().var(0, correction=0).sum()
    return float(away / spread) if spread > 0 else float(away)


def rounding_error(rows: Tensor) -> float:
    """Relative difference of the mean squared distance to a codebook computed in float64 from the same start."""
    some = rows[torch.randperm(len(rows), generator=generator(0, 0, "checked"))[:CHECKED_ROWS]]
    start = some[: min(CHECKED_CODES, len(some))]
    truth = _mean_square(some, kmeans(some.double(), len(start), generator(0), start=start.double()))
    found = _mean_square(some, kmeans(some, len(start), generator(0), start=start))
    return abs(found - truth) / truth if truth > 0 else found


def _mean_square(rows: Tensor, codebook: Tensor) -> float:
    rows, codebook = rows.double(), codebook.double()
    return float((rows - codebook[nearest_reference(rows, codebook)]).square().sum(1).mean())
