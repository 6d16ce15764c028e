"""The results, and what they were measured on, as JSON, as Markdown tables, and as a picture for each suite."""

import importlib.metadata
import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from llvmlite import binding

from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.commands.benchmark.timing import Measurement
from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.report import figures
from nsvq_lightning.version import __version__

# Measurements by the name of their suite.
Suites = Mapping[str, Sequence[Measurement]]


def describe_machine() -> dict[str, Any]:
    """Processor, vector width, versions and how busy the machine was, as JSON values."""
    features = {name for name, present in binding.get_host_cpu_features().items() if present}
    if platform.machine().lower() in ("arm64", "aarch64"):
        features.add("neon")  # always there, but on a Mac LLVM may name no feature at all
    # The platform module knows only the architecture of the processor on Linux.
    about = Path("/proc/cpuinfo")
    lines = about.read_text(encoding="utf-8").splitlines() if about.is_file() else []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    packages = ("numpy", "torch", "numba", "llvmlite")
    bits = {"avx512f": 512, "avx2": 256, "avx": 256, "neon": 128, "sse2": 128}  # of a vector, the widest first
    notable = ("avx512f", "avx512_bf16", "avx512bf16", "amx-tile", "avx2", "fma", "f16c", "neon", "sve")
    return {
        "cpu": next(models, platform.processor() or platform.machine()),
        "llvm_cpu": binding.get_host_cpu_name(),
        "cores": os.cpu_count(),
        "usable_cores": usable_cores(),
        "simd_bits": next((width for name, width in bits.items() if name in features), 32),
        "simd": [name for name in notable if name in features],
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "system": f"{platform.system()} {platform.machine()}",
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": {
            "nsvq-lightning": __version__,
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in packages},
        },
    }


def as_json(machine: Mapping[str, Any], scope: Scope, suites: Suites) -> str:
    """Everything that was measured, samples included.

    Args:
        machine: From :func:`describe_machine`.
        scope: What was measured, and how thoroughly.
        suites: Measurements.
    """
    rows = []
    for suite, found in suites.items():
        for row in found:
            times = {"median_ms": row.timing.median, "quartiles_ms": row.timing.quartiles}
            rows.append({"suite": suite, **asdict(row), **times, "sgemm_ratio": row.timing.ratio})
    document = {"machine": machine, "settings": asdict(scope), "rows": rows}
    return json.dumps(document, indent=2, ensure_ascii=False, default=str) + "\n"  # paths are not JSON


def as_markdown(machine: Mapping[str, Any], scope: Scope, suites: Suites) -> str:
    """The machine, then one table for every operation of every suite."""
    load = machine["load_average"]
    about = [
        f"{machine['cpu']} ({machine['llvm_cpu']})",
        f"{machine['usable_cores']} of {machine['cores']} cores",
        f"{machine['simd_bits']}-bit vectors ({', '.join(machine['simd']) or 'no extension'})",
        *filter(None, [machine["gpu"], machine["system"]]),
        *([] if load is None else [f"load average {load:.1f} at the start"]),
    ]
    parts = ["# nsvq benchmark", ", ".join(about)]
    parts.append(", ".join(f"{name} {version}" for name, version in machine["versions"].items()))
    parts.append(
        f"Rounds: {scope.repeats}; threads: {', '.join(map(str, scope.threads))}{'; quick' * scope.quick}. "
        "ms: median of the calls; quartiles and n beside it. sgemm: the median as a multiple of a 2048³ float32 matrix "
        "product of torch that took turns with it."
    )
    for suite, rows in suites.items():
        parts.append(f"## {suite}")
        for operation in dict.fromkeys(row.operation for row in rows):
            parts += _table([row for row in rows if row.operation == operation])
    return "\n\n".join(parts) + "\n"


def _table(rows: Sequence[Measurement]) -> Iterator[str]:
    """Title, table and notes of one operation; what is the same in all rows is said once, in the title."""
    own = ["workload", "method", "threads"]
    title = f"### {rows[0].operation}"
    if len({row.workload for row in rows}) == 1:
        own.remove("workload")
        title += f", {rows[0].workload}"
    if len({row.threads for row in rows}) == 1:
        own.remove("threads")
        title += f", {rows[0].threads} thread{'s' * (rows[0].threads != 1)}"
    yield title
    names = list(dict.fromkeys(name for row in rows for name in row.values))
    cells = []
    for row in rows:
        timing = row.timing
        times = [number(timing.median), "–".join(map(number, timing.quartiles)), number(min(timing.samples))]
        times += [str(len(timing.samples)), number(timing.ratio)]
        values = [number(row.values[name]) if name in row.values else "" for name in names]
        cells.append([*(str(getattr(row, name)) for name in own), *times, *values])
    head = [*own, "ms", "quartiles", "min", "n", "sgemm", *names]
    yield figures.markdown_table(head, cells, words=("workload", "method"))
    notes = dict.fromkeys(row.note for row in rows if row.note)
    for note in notes:
        about = dict.fromkeys(row.workload for row in rows if row.note == note)
        yield f"{'; '.join(about)}: {note}." if len(notes) > 1 else f"{note[0].upper()}{note[1:]}."


def number(value: float) -> str:
    """Three significant digits, counts in full: ``0.0123``, ``4.1e-07``, ``80,000``."""
    if value == 0:
        return "0"
    if value == round(value) and abs(value) < 1e15:
        return f"{value:,.0f}"
    if abs(value) < 1e-3 or abs(value) >= 1e7:
        return f"{value:.2g}"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def draw_suite(path: Path, rows: Sequence[Measurement]) -> None:
    """Draw the rows of one suite, error over time: a panel for each operation, with the first value of its rows.

    A colour for each method, a marker for each workload, hollow where threads are fewer. Axes are logarithmic; where a
    value is 0 its axis has a linear strip at the bottom, and dB are linear. Rows whose methods have the same name up to
    a colon are joined by a line.

    Args:
        path: PNG file, replaced atomically.
        rows: Those of one suite; those that say what share of a step they are have no error.
    """
    rows = [row for row in rows if "share %" not in row.values]
    colours = figures.colours_of(list(dict.fromkeys(row.method.partition(":")[0] for row in rows)))
    markers = figures.markers_of(list(dict.fromkeys(row.workload for row in rows)))
    most = max(row.threads for row in rows)
    operations = dict.fromkeys(row.operation for row in rows)
    figure, axes = figures.panels(len(operations), 4.2, max(len(colours), len(markers)))
    for axis, operation in zip(axes, operations, strict=True):
        shown = [row for row in rows if row.operation == operation]
        value = next(iter(shown[0].values))
        lines: dict[tuple[str, str, int], list[tuple[float, float]]] = {}
        for row in shown:
            line = lines.setdefault((row.method.partition(":")[0], row.workload, row.threads), [])
            line.append((row.timing.median, row.values[value]))
        for (method, workload, threads), line in lines.items():
            face = colours[method] if threads == most else "none"
            style = {"marker": markers[workload], "color": colours[method], "markerfacecolor": face}
            axis.plot([x for x, _ in line], [y for _, y in line], linewidth=1, **style)
        axis.set(xscale="log", xlabel="ms", ylabel=value, title=operation)
        axis.xaxis.set_major_formatter("{x:g}")
        axis.grid(alpha=0.3)
        heights = [y for line in lines.values() for _, y in line]
        if min(heights) > 0 and "dB" not in value:
            axis.set_yscale("log")
        elif min(heights) == 0:
            axis.set_yscale("symlog", linthresh=min((y for y in heights if y > 0), default=1.0))
    fewer = any(row.threads < most for row in rows)
    figures.draw_keys(figure, colours, markers, f"fewer than {most} threads" if fewer else None)
    figures.write_figure(path, figure)
