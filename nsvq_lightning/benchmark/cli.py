"""``nsvq benchmark SUITE``: how fast the parts are here, and how wrong."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from nsvq_lightning.benchmark.registry import ALL, SUITES, load_suite, suite_names
from nsvq_lightning.benchmark.report import as_json, as_markdown
from nsvq_lightning.benchmark.row import Row
from nsvq_lightning.benchmark.settings import Settings
from nsvq_lightning.benchmark.sizes import SIZES
from nsvq_lightning.io.errors import FormatError

__all__ = ["main"]

log = logging.getLogger(__name__)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables and write the files that are asked for.

    Args:
        argv: Arguments after ``nsvq benchmark``; those of the process if None.

    Returns:
        0, or 1 after a one-line error if the scene cannot be read or the results not be written. Wrong arguments end
        the process with status 2.
    """
    parser = _parser()
    options = parser.parse_args(argv)
    try:
        settings = _settings(options)
    except ValueError as error:
        parser.error(str(error))
    logging.basicConfig(format="%(message)s")
    log.setLevel(logging.INFO)
    try:
        if settings.scene is not None:
            _check_scene(settings.scene)
        _run(suite_names(options.suite), settings, options.output, options.json)
    except FormatError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    return 0


def _fail(message: str) -> int:
    sys.stderr.write(f"nsvq benchmark: {message}\n")
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nsvq benchmark",
        description="Measure run time against error: each part beside its plain counterpart and a float64 oracle.",
        epilog="suites: " + "; ".join(f"{name}: {about}" for name, about in SUITES.items()),
    )
    parser.add_argument("suite", choices=[*SUITES, ALL], metavar="SUITE", help=f"{', '.join(SUITES)} or {ALL}")
    parser.add_argument("--quick", action="store_true", help="small workloads, few repeats: all within a minute")
    parser.add_argument("--repeats", type=int, metavar="N", help="timed calls of each case (15; quick 3)")
    parser.add_argument("--threads", type=_integers, metavar="N,N", help="thread counts (1 and all; quick all)")
    parser.add_argument(
        "--workloads",
        type=_names,
        metavar="NAME,NAME",
        help=f"synthetic scenes of render and codec ({','.join(SIZES)}; quick A20k)",
    )
    parser.add_argument("--scene", type=Path, metavar="FILE", help="scene file (.ply, .nsvq) instead of synthetic ones")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="write benchmark.json, benchmark.md, SUITE.png")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    return parser


def _integers(text: str) -> tuple[int, ...]:
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected whole numbers with commas between them, got {text!r}") from None


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


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
    )


def _check_scene(path: Path) -> None:
    """Read the scene once before anything is measured: a wrong file is an error of the user, later it would be ours."""
    from nsvq_lightning.benchmark.workloads import scene_workload

    try:
        scene_workload(path)
    except ValueError as error:
        raise FormatError(str(error)) from error


def _run(suites: Sequence[str], settings: Settings, output: Path | None, print_json: bool) -> None:
    from nsvq_lightning.benchmark.machine import describe_machine

    machine = describe_machine()
    rows: list[Row] = []
    for name in suites:
        start = time.perf_counter()
        rows += load_suite(name)(settings)
        log.info("%s (%s): %.1f s", name, SUITES[name], time.perf_counter() - start)
    results = json.dumps(as_json(machine, settings, rows), indent=2, ensure_ascii=False) + "\n"
    tables = as_markdown(machine, settings, rows)
    if output is not None:
        _write(output, results, tables, rows)
    sys.stdout.write(results if print_json else tables)


def _write(folder: Path, results: str, tables: str, rows: Sequence[Row]) -> None:
    from nsvq_lightning.benchmark.plot import draw_suite
    from nsvq_lightning.io.atomic import atomic_write

    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("benchmark.json", results), ("benchmark.md", tables)):
        with atomic_write(folder / name) as file:
            file.write(text.encode())
    for suite in dict.fromkeys(row.suite for row in rows):
        draw_suite(folder / f"{suite}.png", [row for row in rows if row.suite == suite])
