"""The results as JSON and as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from nsvq_lightning.benchmark.row import Row
from nsvq_lightning.benchmark.settings import Settings

__all__ = ["as_json", "as_markdown"]


def as_json(machine: Mapping[str, Any], settings: Settings, rows: Sequence[Row]) -> dict[str, Any]:
    """Everything that was measured, samples included, as JSON values.

    Args:
        machine: From :func:`nsvq_lightning.benchmark.machine.describe_machine`.
        settings: How much was measured.
        rows: Results.
    """
    scene = None if settings.scene is None else str(settings.scene)
    chosen = {**asdict(settings), "scene": scene, "threads": list(settings.threads)}
    chosen["workloads"] = list(settings.workloads)
    return {"machine": dict(machine), "settings": chosen, "rows": [row.as_json() for row in rows]}


def as_markdown(machine: Mapping[str, Any], settings: Settings, rows: Sequence[Row]) -> str:
    """The machine, then one table for every operation of every suite."""
    parts = ["# nsvq benchmark", *_machine_lines(machine, settings)]
    for suite in dict.fromkeys(row.suite for row in rows):
        parts.append(f"## {suite}")
        of_suite = [row for row in rows if row.suite == suite]
        for operation in dict.fromkeys(row.operation for row in of_suite):
            chosen = [row for row in of_suite if row.operation == operation]
            parts += [f"### {operation}", _table(*_columns(chosen)), *_notes(chosen)]
    return "\n\n".join(parts) + "\n"


def _machine_lines(machine: Mapping[str, Any], settings: Settings) -> Iterator[str]:
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    load = machine["load_average"]
    busy = "" if load is None else f", load average {load:.1f} at the start"
    simd = f"{machine['simd_bits']}-bit vectors ({', '.join(machine['simd']) or 'no extension'})"
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    cores = f"{machine['usable_cores']} of {machine['cores']} cores"
    yield f"{machine['cpu']} ({machine['llvm_cpu']}), {cores}, {simd}{gpu}, {machine['system']}{busy}"
    yield versions
    yield (
        f"Rounds: {settings.repeats}; threads: {', '.join(map(str, settings.threads))}{'; quick' * settings.quick}. "
        "ms: median of the calls; quartiles and n beside it. sgemm: the median as a multiple of a 2048³ float32 matrix "
        "product of torch that took turns with it."
    )


def _columns(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Head and cells; values that no row of the table has get no column."""
    names = list(dict.fromkeys(name for row in rows for name in row.values))
    head = ["workload", "method", "threads", "ms", "quartiles", "min", "n", "sgemm", *names]
    cells = []
    for row in rows:
        timing = row.timing
        quartiles = "–".join(map(number, timing.quartiles))
        times = [number(timing.median), quartiles, number(timing.minimum), str(len(timing.samples))]
        values = [number(row.values[name]) if name in row.values else "" for name in names]
        cells.append([row.workload, row.method, str(row.threads), *times, number(timing.ratio), *values])
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


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table that also reads well as plain text; the first two columns are words."""
    lines = [list(head), *map(list, rows)]
    widths = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    rule = ["-" * width if column < 2 else "-" * (width - 1) + ":" for column, width in enumerate(widths)]
    padded = [
        [
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in lines
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in [padded[0], rule, *padded[1:]])


def _notes(rows: Sequence[Row]) -> list[str]:
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
