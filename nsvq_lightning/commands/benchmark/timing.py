"""Fair times on a shared machine (what is compared takes turns, and a matrix product takes part), and their tables."""

import gc
import os
import platform
import re
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import torch
from llvmlite import binding

from nsvq_lightning.commands import markdown_table
from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.random import generator
from nsvq_lightning.version import __version__

# What is timed.
Call = Callable[[], object]


@dataclass(frozen=True)
class Scope:
    """What is measured, and how thoroughly: what the command line says, with its defaults filled in.

    Attributes:
        quick: Small workloads and few repeats, for continuous integration.
        repeats: Timed calls of each case, at least 1.
        seconds: A case is not called again once its calls have taken this long together.
        workloads: Names of synthetic scenes of ``render`` and ``codec``.
        scene: Scene file or COLMAP folder that is measured instead of the synthetic scenes.
        init_from: Scene file whose splats are seen by the cameras of the COLMAP folder ``scene``, instead of its
            points.
        steps: Iterations of each run of ``train``, at least 4: a phase has one at least.
        switches: Names of :data:`nsvq_lightning.skips.SKIPS` that ``train`` inverts one by one.
        emulate: Numbers of cores whose steps ``train`` works out.
        config: Config of the runs of ``train``; by default ``fast.yaml``, without photos ``demo.yaml``.
    """

    quick: bool = False
    repeats: int = 15
    seconds: float = 5.0
    workloads: tuple[str, ...] = ("A20k", "B100k", "C500k")
    scene: Path | None = None
    init_from: Path | None = None
    steps: int = 1000
    switches: tuple[str, ...] = ()
    emulate: tuple[int, ...] = ()
    config: str | None = None

    @property
    def photos(self) -> Path | None:
        """The COLMAP folder, if the scene is one."""
        return self.scene if self.scene and self.scene.is_dir() else None

    @property
    def codebooks(self) -> str:
        """The paper's codebook setting in the suites that quantize."""
        return "1k" if self.quick else "16k"


class Measurement(NamedTuple):
    """One row of a table.

    Attributes:
        operation: What was done; measurements of one operation are compared with each other.
        workload: What it was done to.
        method: How it was done.
        samples: Milliseconds of each call, in the order of the calls.
        sgemm: Milliseconds of each 2048³ float32 matrix product of torch that was interleaved with them.
        values: Errors and sizes by name, the unit in the name where there is one.
    """

    operation: str
    workload: str
    method: str
    samples: Sequence[float]
    sgemm: Sequence[float]
    values: Mapping[str, float]

    @property
    def median(self) -> float:
        """Median, ms."""
        return statistics.median(self.samples)

    @property
    def ratio(self) -> float:
        """Median as a multiple of the median matrix product: comparable between machines and between busy hours."""
        return self.median / statistics.median(self.sgemm)


def compare(
    operation: str,
    workload: str,
    cases: Mapping[str, Call],
    values: Mapping[str, Mapping[str, float]],
    scope: Scope,
    device: str = "cpu",
) -> list[Measurement]:
    """Time the methods of an operation in turns, in an order that rotates, and reverses, from round to round.

    The first call of each is not counted: it compiles kernels and grows buffers. A method that has used up
    ``scope.seconds`` sits out the remaining rounds, so that one slow method does not make the run endless; the matrix
    product never sits out. Python's cyclic collector waits for the end.

    Args:
        operation: See :class:`Measurement`.
        workload: See :class:`Measurement`.
        cases: What to time, by method.
        values: Errors and sizes by method, then by name.
        scope: Number of rounds and time limit.
        device: Where the work is done, and with it the matrix product.
    """
    players = [("", sgemm(device)), *cases.items()]
    samples: dict[str, list[float]] = {name: [] for name, _ in players}
    gc.collect()
    gc.disable()
    try:
        for turn in range(-1, scope.repeats):
            shift = max(turn, 0) % len(players)
            order = players[shift:] + players[:shift]
            # What follows the matrix product finds no data in the caches: not always the same method.
            for name, call in order[:: -1 if turn % 2 else 1]:
                if name and sum(samples[name]) >= 1000 * scope.seconds:
                    continue
                took = milliseconds(call)
                if turn >= 0:
                    samples[name].append(took)
    finally:
        gc.enable()
    return [Measurement(operation, workload, name, samples[name], samples[""], values[name]) for name in cases]


def milliseconds(call: Call) -> float:
    """Time one call, with the work of a GPU that it begins."""
    finish()
    start = time.perf_counter_ns()
    call()
    finish()
    return (time.perf_counter_ns() - start) / 1e6


def finish() -> None:
    """Wait for kernels of a GPU that are still running."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


SGEMM_SIDE = 2048


def sgemm(device: str = "cpu") -> Call:
    """The 2048³ float32 matrix product that all times are compared with."""
    draw = generator(0, 0, "sgemm")
    left, right = (torch.randn(SGEMM_SIDE, SGEMM_SIDE, generator=draw).to(device) for _ in range(2))
    out = torch.empty_like(left)
    return lambda: torch.mm(left, right, out=out)


def describe_machine() -> list[str]:
    """A line about the machine and how busy it is, and one with the versions of packages that results depend on."""
    cpu = platform.processor() or platform.machine()
    # The platform module knows only the architecture of the processor on Linux.
    about = Path("/proc/cpuinfo")
    if about.is_file():
        found = re.search(r"^model name\s*: (.*)", about.read_text(encoding="utf-8"), re.MULTILINE)
        cpu = found[1] if found else cpu
    features = binding.get_host_cpu_features()
    notable = ("avx512f", "avx512_bf16", "avx512bf16", "amx-tile", "avx2", "fma", "f16c", "neon", "sve")
    machine = {
        "cpu": cpu,
        "llvm": binding.get_host_cpu_name(),
        "simd": " ".join(name for name in notable if features.get(name)) or None,
        "cores": f"{usable_cores()} of {os.cpu_count()}",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "system": f"{platform.system()} {platform.machine()}",
        "load": round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None,
    }
    packages = ("numpy", "torch", "numba", "llvmlite", "lightning", "torchmetrics", "jsonargparse", "scipy", "pycolmap")
    versions = {"nsvq-lightning": __version__, "python": platform.python_version()}
    versions |= {name: version(name) for name in packages if find_spec(name)}
    return [_listed(machine), _listed(versions)]


def _listed(facts: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in facts.items() if value is not None)


def as_markdown(about: Sequence[str], scope: Scope, suites: Mapping[str, Sequence[Measurement]]) -> str:
    """The machine, then one table for every operation of every suite.

    Args:
        about: From :func:`describe_machine`.
        scope: What was measured, and how thoroughly.
        suites: Measurements by the name of their suite.
    """
    quick = "; quick" if scope.quick else ""
    parts = [
        "# nsvq benchmark",
        *about,
        f"Rounds: {scope.repeats}; threads: {torch.get_num_threads()}{quick}. ms: median of the n "
        "calls. sgemm: the median as a multiple of a 2048³ float32 matrix product of torch that took turns with it.",
    ]
    for suite, rows in suites.items():
        parts.append(f"## {suite}")
        for operation in dict.fromkeys(row.operation for row in rows):
            parts += [f"### {operation}", _table([row for row in rows if row.operation == operation])]
    return "\n\n".join(parts) + "\n"


def _table(rows: Sequence[Measurement]) -> str:
    """Rows of one operation; what only some of them have is empty in the others."""
    names = dict.fromkeys(name for row in rows for name in row.values)
    cells = []
    for row in rows:
        times = [row.median, min(row.samples), len(row.samples), row.ratio]
        values = [number(row.values[name]) if name in row.values else "" for name in names]
        cells.append([row.workload, row.method, *map(number, times), *values])
    words = ["workload", "method"]
    return markdown_table([*words, "ms", "min", "n", "sgemm", *names], cells, words)


def number(value: float) -> str:
    """Three significant digits, counts in full: ``0.0123``, ``4.1e-07``, ``80,000``."""
    size = abs(value)
    if (value == round(value) and size < 1e15) or 100 <= size < 1e7:
        return f"{value:,.0f}"
    return f"{value:.3g}" if 1e-3 <= size < 1e7 else f"{value:.2g}"
