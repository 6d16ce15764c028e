"""Measure run time against error: each part beside its plain counterpart and a float64 oracle.

Suites:
  render     back-ends of the rasterizer and of the loss, forward and backward, against float64
  quantize   a step of NSVQ, the search for the nearest code, and k-means
  codec      writing and reading scene files; a trained scene made small, beside other formats
  train      whole runs, with switches on and off; the parts of a step

Examples:
  nsvq benchmark all --quick
  nsvq benchmark render --output results
  nsvq benchmark train --scene path/to/colmap/folder --switches all
  nsvq benchmark codec --scene path/to/colmap/folder --init-from scene.ply --beside scene.sog,scene.spz
"""

import argparse
import importlib
import logging
import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.arguments import integers, names, positive
from nsvq_lightning.commands.benchmark import SIZES, SUITES, Scope
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.skips import SKIPS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what ``nsvq benchmark`` takes."""
    help_ = f"of {', '.join(SUITES)}: one, some with commas between them, or all"
    parser.add_argument("suites", type=_some_of(SUITES), metavar="SUITE", help=help_)
    add = parser.add_argument_group("what is measured").add_argument
    help_ = f"synthetic scenes, some of {','.join(SIZES)} (A20k,B100k,C500k; quick A20k)"
    add("--workloads", type=_some_of(SIZES), metavar="NAME,NAME", help=help_)
    add("--scene", type=Path, metavar="PATH", help="scene file or COLMAP folder, not synthetic ones")
    help_ = "scene file whose splats are used with the photos of the COLMAP folder, instead of its points"
    add("--init-from", type=Path, metavar="FILE", help=help_)
    help_ = "files of the same scene by other programs, which codec measures beside ours"
    add("--beside", type=lambda text: tuple(map(Path, names(text))), metavar="FILE,FILE", help=help_)
    add("--config", metavar="NAME", help="config of the runs of train (fast.yaml, without photos demo.yaml)")
    add("--steps", type=positive(int), metavar="N", help="iterations of each run of train (1000; quick 40)")
    help_ = "switches that train inverts one by one, or all"
    add("--switches", type=_some_of(SKIPS), metavar="NAME,NAME", help=help_)
    add = parser.add_argument_group("how much").add_argument
    add("--quick", action="store_true", help="small workloads, few repeats: all within a minute")
    add("--repeats", type=positive(int), metavar="N", help="timed calls of each case (15; quick 3)")
    add("--threads", type=integers, metavar="N,N", help="thread counts (1 and all; quick all)")
    add = parser.add_argument_group("results").add_argument
    add("--output", type=Path, metavar="FOLDER", help="write benchmark.json, benchmark.md, SUITE.png")
    add("--json", action="store_true", help="print JSON instead of tables")


def _some_of(known: Iterable[str]) -> Callable[[str], tuple[str, ...]]:
    def parse(text: str) -> tuple[str, ...]:
        chosen = tuple(known) if text == "all" else names(text)
        if not chosen or not set(chosen) <= set(known):
            raise argparse.ArgumentTypeError(f"choose some of {', '.join(known)}, or all, got {text!r}")
        return chosen

    return parse


def run(options: argparse.Namespace) -> int:
    """Measure, print the tables and write the files that are asked for.

    Raises:
        argparse.ArgumentError: Options do not go together, or a number is out of range.
        ValueError: The scene cannot be used.
        OSError: A file cannot be read or written.
    """
    if "numba" not in sys.modules:
        # From Python 3.12 on, kernels show in a profile only with it. Later, some would show and others not.
        os.environ.setdefault("NUMBA_ENABLE_SYS_MONITORING", "1")
    import numba

    from nsvq_lightning.commands.benchmark import report, workloads

    most = int(numba.config.NUMBA_NUM_THREADS)
    values: dict[str, Any] = {"threads": tuple(sorted({1, most}))}
    if options.quick:
        values = {"threads": (most,), "repeats": 3, "seconds": 0.5, "workloads": ("A20k",), "steps": 40}
    given = {name: value for name, value in vars(options).items() if name in Scope.__dataclass_fields__}
    scope = Scope(**values | {name: value for name, value in given.items() if value is not None})
    wrong = ""
    if min(scope.threads) < 1 or max(scope.threads) > most:
        wrong = (
            f"--threads: at least 1 and at most {most} can be measured here; NUMBA_NUM_THREADS, which is the number "
        )
        wrong += "of cores by default, raises the limit"
    elif scope.steps < 4:
        wrong = f"--steps must be at least 4, one for each phase, got {scope.steps}"
    elif scope.init_from is not None and scope.photos is None:
        wrong = "--init-from needs a COLMAP folder as --scene, whose cameras look at its splats"
    if wrong:
        raise argparse.ArgumentError(None, wrong)
    logging.getLogger("nsvq_lightning").setLevel(logging.WARNING)
    if scope.scene is not None:
        workloads.workloads(scope)  # before anything is measured: a wrong file must end in one line
    machine, found = report.describe_machine(), {}
    suites = {name: importlib.import_module(f"{__package__}.{name}") for name in options.suites}
    for name, suite in suites.items():
        start = time.perf_counter()
        found[name] = list(suite.run(scope))
        sys.stderr.write(f"{name}: {time.perf_counter() - start:.1f} s\n")
    text, tables = report.as_json(machine, scope, found), report.as_markdown(machine, scope, found)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        write_text(options.output / "benchmark.json", text)
        write_text(options.output / "benchmark.md", tables)
        for name in suites:
            report.draw_suite(options.output / f"{name}.png", found[name])
    sys.stdout.write(text if options.json else tables)
    return 0
