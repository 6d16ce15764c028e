"""The results as JSON and as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.report.figures import markdown_table

__all__ = ["as_json", "as_markdown", "number"]


def as_json(machine: Mapping[str, Any], scope: Scope, rows: Sequence[Measurement]) -> dict[str, Any]:
    """Everything that was measured, samples included, as JSON values.

    Args:
        machine: From :func:`nsvq_lightning.commands.benchmark.hardware.describe_machine`.
        scope: What was measured, and how thoroughly.
        rows: Measurements.
    """
    chosen = {name: _plain(value) for name, value in asdict(scope).items()}
    return {"machine": dict(machine), "settings": chosen, "rows": [row.as_json() for row in rows]}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


def as_markdown(machine: Mapping[str, Any], scope: Scope, rows: Sequence[Measurement]) -> str:
    """The machine, then one table for every operation of every suite."""
    parts = ["# nsvq benchmark", *_machine_lines(machine, scope)]
    for suite in dict.fromkeys(row.suite for row in rows):
        parts += [f"## {suite}", *_operations([row for row in rows if row.suite == suite])]
    return "\n\n".join(parts) + "\n"


def _operations(rows: Sequence[Measurement]) -> Iterator[str]:
    for operation in dict.fromkeys(row.operation for row in rows):
        chosen = [row for row in rows if row.operation == operation]
        # What is the same in all rows is said once.
        common = [name for name in ("workload", "threads") if len({getattr(row, name) for row in chosen}) == 1]
        said = {"workload": chosen[0].workload, "threads": _counted(chosen[0].threads, "thread")}
        yield f"### {operation}" + "".join(f", {said[name]}" for name in common)
        yield markdown_table(*_columns(chosen, common), words=("workload", "method"))
        yield from _notes(chosen)


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def _machine_lines(machine: Mapping[str, Any], scope: Scope) -> Iterator[str]:
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    load = machine["load_average"]
    busy = "" if load is None else f", load average {load:.1f} at the start"
    simd = f"{machine['simd_bits']}-bit vectors ({', '.join(machine['simd']) or 'no extension'})"
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    cores = f"{machine['usable_cores']} of {machine['cores']} cores"
    yield f"{machine['cpu']} ({machine['llvm_cpu']}), {cores}, {simd}{gpu}, {machine['system']}{busy}"
    yield versions
    yield (
        f"Rounds: {scope.repeats}; threads: {', '.join(map(str, scope.threads))}{'; quick' * scope.quick}. "
        "ms: median of the calls; quartiles and n beside it. sgemm: the median as a multiple of a 2048³ float32 matrix "
        "product of torch that took turns with it."
    )


def _columns(rows: Sequence[Measurement], common: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Head and cells without those that are ``common``; values that no row of the table has get no column."""
    names = list(dict.fromkeys(name for row in rows for name in row.values))
    own = [name for name in ("workload", "method", "threads") if name not in common]
    head = [*own, "ms", "quartiles", "min", "n", "sgemm", *names]
    cells = []
    for row in rows:
        timing = row.timing
        quartiles = "–".join(map(number, timing.quartiles))
        times = [number(timing.median), quartiles, number(timing.minimum), str(len(timing.samples))]
        values = [number(row.values[name]) if name in row.values else "" for name in names]
        cells.append([*(str(getattr(row, name)) for name in own), *times, number(timing.ratio), *values])
    return head, cells


def number(value: float) -> str:
    """Three significant digits, counts in full: ``0.0123``, ``4.1e-07``, ``80,000``."""
    if value == 0:
        return "0"
    if value == round(value) and abs(value) < 1e15:
        return f"{value:,.0f}"
    if abs(value) < 1e-3 or abs(value) >= 1e7:
        return f"{value:.2g}"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def _notes(rows: Sequence[Measurement]) -> list[str]:
    """Each different note once, with the workloads it is about where there are several."""
    by_note: dict[str, list[str]] = {}
    for row in rows:
        if row.note:
            about = by_note.setdefault(row.note, [])
            if row.workload not in about:
                about.append(row.workload)
    if len(by_note) <= 1:
        return [f"{note[0].upper()}{note[1:]}." for note in by_note]
    return [f"{'; '.join(about)}: {note}." for note, about in by_note.items()]
