"""``nsvq benchmark SUITE``: how fast the parts are here, and how wrong."""

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

from nsvq_lightning.commands.benchmark.registry import ALL, SUITES, Unavailable, load_suite, suite_names
from nsvq_lightning.commands.benchmark.report import (
    as_json,
    as_markdown,
    fill_in,
    has_place,
    results_line,
    suite_tables,
)
from nsvq_lightning.commands.benchmark.row import Row
from nsvq_lightning.commands.benchmark.settings import Settings
from nsvq_lightning.commands.benchmark.sizes import LARGE, STANDARD
from nsvq_lightning.commands.benchmark.switch_table import PLACE as SWITCHES
from nsvq_lightning.commands.benchmark.switch_table import fill_switches, scene_name, shares_saved
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.skips import SKIPS

__all__ = ["main"]

log = logging.getLogger(__name__)

TRAIN = "train"
"""The suite that measures switches."""

EXAMPLES = """

examples:
  nsvq benchmark all --quick
  nsvq benchmark render --output results
  nsvq benchmark train --scene path/to/colmap/folder --switches all
  nsvq benchmark profile --scene path/to/colmap/folder --init-from scene.ply
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables and write the files that are asked for.

    Args:
        argv: Arguments after ``nsvq benchmark``; those of the process if None.

    Returns:
        0, or 1 after a one-line error if the scene cannot be read or the results not be written. Wrong arguments end
        the process with status 2.
    """
    # Read when torch is loaded: its profiler keeps its diary to itself.
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")
    parser = _parser()
    options = parser.parse_args(argv)
    try:
        suites, settings = suite_names(options.suite), _settings(options)
    except ValueError as error:
        parser.error(str(error))
    logging.basicConfig(format="%(message)s")
    log.setLevel(logging.INFO)
    try:
        document = _read_document(options.document, suites, parser)
        fault = _fault_of_scene(settings)
        if fault is not None:
            return _fail(fault)
        results = _measure(suites, settings)
        _write(results, options.output, options.document, document)
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    sys.stdout.write(results.json() if options.json else results.markdown())
    return 0


def _read_document(path: Path | None, suites: Sequence[str], parser: argparse.ArgumentParser) -> str | None:
    """The document that will be filled in; what it lacks is said before anything is measured."""
    if path is None:
        return None
    document = path.read_text(encoding="utf-8")
    try:
        _filled(document, dict.fromkeys(suites, ""))
    except ValueError as error:
        parser.error(f"{path}: {error}")
    return document


def _fail(message: str) -> int:
    sys.stderr.write(f"nsvq benchmark: {message}\n")
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nsvq benchmark",
        description="Measure run time against error: each part beside its plain counterpart and a float64 oracle.",
        epilog="suites:\n" + "\n".join(f"  {name:10} {suite.about}" for name, suite in SUITES.items()) + EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("suite", metavar="SUITE", help=f"one, some with commas between them, or {ALL}")
    what = parser.add_argument_group("what is measured")
    what.add_argument(
        "--workloads",
        type=_names,
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
    what.add_argument("--steps", type=int, metavar="N", help="iterations of each run of train (1000; quick 40)")
    what.add_argument(
        "--switches", type=_switches, metavar="NAME,NAME", help="switches that train turns round one by one, or all"
    )
    effort = parser.add_argument_group("how much")
    effort.add_argument("--quick", action="store_true", help="small workloads, few repeats: all within a minute")
    effort.add_argument("--repeats", type=int, metavar="N", help="timed calls of each case (15; quick 3)")
    effort.add_argument("--threads", type=_integers, metavar="N,N", help="thread counts (1 and all; quick all)")
    results = parser.add_argument_group("results")
    results.add_argument("--output", type=Path, metavar="FOLDER", help="write benchmark.json, benchmark.md, SUITE.png")
    results.add_argument("--document", type=Path, metavar="FILE", help="fill the tables in where the file has a place")
    results.add_argument("--json", action="store_true", help="print JSON instead of tables")
    return parser


def _integers(text: str) -> tuple[int, ...]:
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected whole numbers with commas between them, got {text!r}") from None


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def _switches(text: str) -> tuple[str, ...]:
    return tuple(SKIPS) if text == ALL else _names(text)


def _settings(options: argparse.Namespace) -> Settings:
    # Imported here so that --help and wrong arguments answer at once.
    import numba

    return Settings.of(
        quick=options.quick,
        most_threads=int(numba.config.NUMBA_NUM_THREADS),
        threads=options.threads,
        repeats=options.repeats,
        workloads=options.workloads,
        scene=options.scene,
        init_from=options.init_from,
        steps=options.steps,
        switches=options.switches,
    )


def _fault_of_scene(settings: Settings) -> str | None:
    """Read the user's scene before anything is measured: a wrong file is the user's error, later it would be ours."""
    from nsvq_lightning.commands.benchmark.workloads import workloads

    if settings.scene is None:
        return None
    try:
        workloads(settings)
    except ValueError as error:
        return str(error)
    return None


class _Results(NamedTuple):
    """What was measured, where, and how much of it."""

    machine: Mapping[str, Any]
    settings: Settings
    rows: Sequence[Row]

    def json(self) -> str:
        return json.dumps(as_json(*self), indent=2, ensure_ascii=False) + "\n"

    def markdown(self) -> str:
        return as_markdown(*self)

    def by_suite(self) -> dict[str, list[Row]]:
        names = dict.fromkeys(row.suite for row in self.rows)
        return {name: [row for row in self.rows if row.suite == name] for name in names}


def _measure(suites: Sequence[str], settings: Settings) -> _Results:
    from nsvq_lightning.commands.benchmark.machine import describe_machine

    machine = describe_machine()
    rows: list[Row] = []
    for name in suites:
        start = time.perf_counter()
        try:
            rows += load_suite(name)(settings)
        except Unavailable as reason:
            log.info("%s (%s): skipped, %s", name, SUITES[name].about, reason)
            continue
        log.info("%s (%s): %.1f s", name, SUITES[name].about, time.perf_counter() - start)
    return _Results(machine, settings, rows)


def _write(results: _Results, folder: Path | None, target: Path | None, document: str | None) -> None:
    """Write the folder, and fill the tables in the document."""
    from nsvq_lightning.commands.benchmark.plot import draw_suite

    by_suite = results.by_suite()
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / "benchmark.json", results.json())
        write_text(folder / "benchmark.md", results.markdown())
        for name, rows in by_suite.items():
            draw_suite(folder / f"{name}.png", rows, SUITES[name])
    if target is not None and document is not None:
        tables = {name: suite_tables(results.machine, results.settings, rows) for name, rows in by_suite.items()}
        saved = shares_saved(by_suite.get(TRAIN, ()))
        write_text(target, _filled(document, tables, scene_name(results.settings), saved))


def _filled(document: str, tables: Mapping[str, str], scene: str = "", saved: Mapping[str, float] | None = None) -> str:
    """The document with the tables of the suites; the switches may have a table of their own, instead of ``train``'s.

    Raises:
        ValueError: There is no place for a suite.
    """
    wanted = dict(tables)
    if TRAIN in wanted and has_place(document, SWITCHES):
        document = fill_switches(document, scene, saved)
        if not has_place(document, results_line(TRAIN)):
            del wanted[TRAIN]
    return fill_in(document, wanted)
