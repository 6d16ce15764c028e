"""``nsvq benchmark SUITE``: how fast the parts are on this machine, and how wrong."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.sizes import LARGE, STANDARD
from nsvq_lightning.commands.benchmark.suite_list import ALL, SUITES, Unavailable, load_suite, suite_names
from nsvq_lightning.commands.benchmark.tables import as_json, as_markdown
from nsvq_lightning.commands.comma_lists import integers, names
from nsvq_lightning.commands.messages import Parser
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.skips import SKIPS

__all__ = ["main"]

log = logging.getLogger(__name__)

EXAMPLES = """

examples:
  nsvq benchmark all --quick
  nsvq benchmark render --output results
  nsvq benchmark train --scene path/to/colmap/folder --switches all
  nsvq benchmark profile --scene path/to/colmap/folder --init-from scene.ply
  nsvq benchmark compress --scene path/to/colmap/folder --init-from scene.ply --beside scene.sog,scene.spz
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
        suites, scope = suite_names(options.suite), _scope(options)
    except ValueError as error:
        parser.error(str(error))
    logging.basicConfig(format="%(message)s")
    log.setLevel(logging.INFO)
    try:
        fault = _fault_of_scene(scope)
        if fault is not None:
            return _fail(fault)
        results = _measure(suites, scope)
        if options.output is not None:
            _write(results, options.output)
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    sys.stdout.write(results.json() if options.json else results.markdown())
    return 0


def _fail(message: str) -> int:
    sys.stderr.write(f"nsvq benchmark: {message}\n")
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsvq benchmark",
        description="Measure run time against error: each part beside its plain counterpart and a float64 oracle.",
        epilog="suites:\n" + "\n".join(f"  {name:10} {suite.about}" for name, suite in SUITES.items()) + EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("suite", metavar="SUITE", help=f"one, some with commas between them, or {ALL}")
    what = parser.add_argument_group("what is measured")
    what.add_argument(
        "--workloads",
        type=names,
        metavar="NAME,NAME",
        help=f"synthetic scenes of render, codec, gpu ({','.join(STANDARD)}; gpu also {','.join(LARGE)}; quick A20k)",
    )
    what.add_argument(
        "--scene", type=Path, metavar="PATH", help="scene file or COLMAP folder instead of synthetic ones"
    )
    what.add_argument(
        "--init-from",
        type=Path,
        metavar="FILE",
        help="scene file whose splats are used with the photos of the COLMAP folder, instead of its points",
    )
    what.add_argument(
        "--beside",
        type=_paths,
        metavar="FILE,FILE",
        help="files of the same scene by other programs, which compress measures beside ours",
    )
    what.add_argument(
        "--config",
        metavar="NAME",
        help="config of the runs of profile and train (fast.yaml, without photos demo.yaml)",
    )
    what.add_argument("--steps", type=int, metavar="N", help="iterations of each run of train (1000; quick 40)")
    what.add_argument(
        "--switches", type=_switches, metavar="NAME,NAME", help="switches that train inverts one by one, or all"
    )
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

    return Scope.of(
        quick=options.quick,
        most_threads=int(numba.config.NUMBA_NUM_THREADS),
        threads=options.threads,
        repeats=options.repeats,
        workloads=options.workloads,
        scene=options.scene,
        init_from=options.init_from,
        steps=options.steps,
        switches=options.switches,
        config=options.config,
        beside=options.beside,
    )


def _fault_of_scene(scope: Scope) -> str | None:
    """Read the user's scene before anything is measured: a wrong file must end in one line."""
    from nsvq_lightning.commands.benchmark.workloads import workloads

    if scope.scene is None:
        return None
    try:
        workloads(scope)
    except ValueError as error:
        return str(error)
    return None


class _Results(NamedTuple):
    """What was measured, where, and how thoroughly."""

    machine: Mapping[str, Any]
    scope: Scope
    rows: Sequence[Measurement]

    def json(self) -> str:
        return json.dumps(as_json(*self), indent=2, ensure_ascii=False) + "\n"

    def markdown(self) -> str:
        return as_markdown(*self)


def _measure(suites: Sequence[str], scope: Scope) -> _Results:
    from nsvq_lightning.commands.benchmark.hardware import describe_machine

    machine = describe_machine()
    rows: list[Measurement] = []
    for name in suites:
        start = time.perf_counter()
        try:
            rows += load_suite(name)(scope)
        except Unavailable as reason:
            log.info("%s (%s): skipped, %s", name, SUITES[name].about, reason)
            continue
        log.info("%s (%s): %.1f s", name, SUITES[name].about, time.perf_counter() - start)
    return _Results(machine, scope, rows)


def _write(results: _Results, folder: Path) -> None:
    from nsvq_lightning.commands.benchmark.suite_picture import draw_suite

    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "benchmark.json", results.json())
    write_text(folder / "benchmark.md", results.markdown())
    for name in dict.fromkeys(row.suite for row in results.rows):
        draw_suite(folder / f"{name}.png", [row for row in results.rows if row.suite == name], SUITES[name])
