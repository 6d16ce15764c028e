"""``nsvq benchmark SUITE``: how fast the parts are on this machine, and how wrong."""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from nsvq_lightning.commands.arguments import Parser, integers, names
from nsvq_lightning.commands.benchmark import SIZES, Scope
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.skips import SKIPS

__all__ = ["main"]

log = logging.getLogger(__name__)

SUITES = {
    "render": "back-ends of the rasterizer and of the loss, forward and backward, against float64",
    "quantize": "a step of NSVQ, the search for the nearest code, and k-means",
    "codec": "writing and reading scene files; a trained scene made small, beside other formats",
    "train": "whole runs, with switches on and off; the parts of a step; how it grows with splats and pixels",
}
"""What each suite measures; its name is that of its module, which has a function ``run(scope)`` and ``PANELS``."""
ALL = "all"
EXAMPLES = """

examples:
  nsvq benchmark all --quick
  nsvq benchmark render --output results
  nsvq benchmark train --scene path/to/colmap/folder --switches all
  nsvq benchmark codec --scene path/to/colmap/folder --init-from scene.ply --beside scene.sog,scene.spz
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables and write the files that are asked for.

    Args:
        argv: Arguments after ``nsvq benchmark``; those of the process if None.

    Returns:
        0, or 1 after a one-line error if the scene cannot be read or the results not be written. Wrong arguments end
        the process with status 2.
    """
    if "numba" not in sys.modules:
        # From Python 3.12 on, kernels show in a profile only with it. Later, some would show and others not.
        os.environ.setdefault("NUMBA_ENABLE_SYS_MONITORING", "1")
    parser = _parser()
    options = parser.parse_args(argv)
    try:
        suites, scope = _suites(options.suite), _scope(options)
    except ValueError as error:
        parser.error(str(error))
    logging.basicConfig(format="%(message)s")
    log.setLevel(logging.INFO)
    try:
        _read_scene(scope)
    except (OSError, ValueError) as error:
        return _fail(error)
    try:
        sys.stdout.write(_measured(suites, scope, options))
    except OSError as error:
        return _fail(error)
    return 0


def _suites(choice: str) -> tuple[str, ...]:
    """The suites that a word of the command line stands for: one, some with commas between them, or ``all``."""
    chosen = tuple(SUITES) if choice == ALL else names(choice)
    unknown = [name for name in chosen if name not in SUITES]
    if unknown or not chosen:
        raise ValueError(f"unknown benchmark suite {choice!r}; choose from {', '.join(SUITES)}, or {ALL}")
    return chosen


def _fail(error: Exception) -> int:
    message = str(error)
    if isinstance(error, OSError) and error.filename:
        message = f"{error.filename}: {error.strerror}"
    sys.stderr.write(f"nsvq benchmark: {message}\n")
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsvq benchmark",
        description="Measure run time against error: each part beside its plain counterpart and a float64 oracle.",
        epilog="suites:\n" + "\n".join(f"  {name:10} {about}" for name, about in SUITES.items()) + EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("suite", metavar="SUITE", help=f"one, some with commas between them, or {ALL}")
    what = parser.add_argument_group("what is measured")
    known = f"some of {','.join(SIZES)} (A20k,B100k,C500k; quick A20k)"
    what.add_argument("--workloads", type=names, metavar="NAME,NAME", help=f"synthetic scenes, {known}")
    what.add_argument("--scene", type=Path, metavar="PATH", help="scene file or COLMAP folder, not synthetic ones")
    help_ = "scene file whose splats are used with the photos of the COLMAP folder, instead of its points"
    what.add_argument("--init-from", type=Path, metavar="FILE", help=help_)
    help_ = "files of the same scene by other programs, which codec measures beside ours"
    what.add_argument("--beside", type=_paths, metavar="FILE,FILE", help=help_)
    help_ = "config of the runs of train (fast.yaml, without photos demo.yaml)"
    what.add_argument("--config", metavar="NAME", help=help_)
    what.add_argument("--steps", type=int, metavar="N", help="iterations of each run of train (1000; quick 40)")
    help_ = "switches that train inverts one by one, or all"
    what.add_argument("--switches", type=_switches, metavar="NAME,NAME", help=help_)
    effort = parser.add_argument_group("how much")
    effort.add_argument("--quick", action="store_true", help="small workloads, few repeats: all within a minute")
    effort.add_argument("--repeats", type=int, metavar="N", help="timed calls of each case (15; quick 3)")
    effort.add_argument("--threads", type=integers, metavar="N,N", help="thread counts (1 and all; quick all)")
    results = parser.add_argument_group("results")
    results.add_argument("--output", type=Path, metavar="FOLDER", help="write benchmark.json, benchmark.md, SUITE.png")
    results.add_argument("--json", action="store_true", help="print JSON instead of tables")
    return parser


def _paths(text: str) -> tuple[Path, ...]:
    return tuple(map(Path, names(text)))


def _switches(text: str) -> tuple[str, ...]:
    return tuple(SKIPS) if text == ALL else names(text)


def _scope(options: argparse.Namespace) -> Scope:
    # Imported here so that --help and wrong arguments answer at once.
    import numba

    given = {name: value for name, value in vars(options).items() if name not in ("suite", "output", "json")}
    return Scope.of(most_threads=int(numba.config.NUMBA_NUM_THREADS), **given)


def _read_scene(scope: Scope) -> None:
    """Read the user's scene before anything is measured: a wrong file must end in one line."""
    from nsvq_lightning.commands.benchmark.workloads import workloads

    if scope.scene is not None:
        workloads(scope)


def _measured(suites: Sequence[str], scope: Scope, options: argparse.Namespace) -> str:
    """Measure, write the files that are asked for, and return what is printed."""
    from nsvq_lightning.commands.benchmark.report import as_json, as_markdown, describe_machine, draw_suite
    from nsvq_lightning.commands.benchmark.timing import Measurement

    machine, modules, rows = describe_machine(), {}, list[Measurement]()
    for name in suites:
        start = time.perf_counter()
        modules[name] = importlib.import_module(f"nsvq_lightning.commands.benchmark.{name}")
        rows += modules[name].run(scope)
        log.info("%s (%s): %.1f s", name, SUITES[name], time.perf_counter() - start)
    text = json.dumps(as_json(machine, scope, rows), indent=2, ensure_ascii=False) + "\n"
    tables = as_markdown(machine, scope, rows)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        write_text(options.output / "benchmark.json", text)
        write_text(options.output / "benchmark.md", tables)
        for name, module in modules.items():
            draw_suite(options.output / f"{name}.png", [row for row in rows if row.suite == name], module.PANELS)
    return text if options.json else tables
