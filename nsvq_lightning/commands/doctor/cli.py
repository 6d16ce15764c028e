"""``nsvq doctor [FOLDER]``: check whether this machine and a scene folder are fit for training."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from nsvq_lightning.commands.arguments import Parser

if TYPE_CHECKING:
    from nsvq_lightning.commands.doctor.finding import Finding

__all__ = ["main"]

EPILOG = """\
Each line is good, a note (works, could be better or faster) or a problem (a run would fail).

examples:
  nsvq doctor
  nsvq doctor path/to/scene
  nsvq doctor path/to/scene --json > doctor.json
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Check this machine and, if given, a scene folder.

    Args:
        argv: Arguments after ``nsvq doctor``; those of the process if None.

    Returns:
        0, or 1 if there is a problem: the self-test fails or the folder cannot be used. Wrong arguments end the process
        with status 2.
    """
    options = _parser().parse_args(argv)
    findings = []
    for finding in _findings(options.folder):
        findings.append(finding)
        if not options.json:
            sys.stdout.write(f"{finding}\n")
            sys.stdout.flush()  # each check takes seconds
    problems = sum(finding.verdict == "problem" for finding in findings)
    if options.json:
        from dataclasses import asdict

        document = {"ok": problems == 0, "findings": [asdict(finding) for finding in findings]}
        sys.stdout.write(json.dumps(document, indent=2, ensure_ascii=False) + "\n")
    else:
        notes = sum(finding.verdict == "note" for finding in findings)
        sys.stdout.write(f"\n{_counted(problems, 'problem')}, {_counted(notes, 'note')}\n")
    return 1 if problems else 0


def _counted(count: int, word: str) -> str:
    return f"{count or 'no'} {word}{'' if count == 1 else 's'}"


def _findings(folder: Path | None) -> Iterator[Finding]:
    # Imported here so that --help and wrong arguments answer at once.
    from nsvq_lightning.commands.doctor.backends import check_backends, check_extras
    from nsvq_lightning.commands.doctor.finding import report
    from nsvq_lightning.commands.doctor.machine import (
        check_disk,
        check_memory,
        check_opencv,
        check_threads,
        check_versions,
    )

    yield from report("versions", check_versions)
    yield from report("opencv", check_opencv)
    yield from report("cpu", check_backends)
    yield from report("extras", check_extras)
    yield from report("threads", check_threads)
    yield from report("memory", check_memory)
    yield from report("disk", lambda: check_disk(Path()))
    yield from report("self-test", _self_test)
    if folder is not None:
        from nsvq_lightning.commands.doctor.folder import check_folder

        yield from check_folder(folder)


def _self_test() -> Iterator[Finding]:
    # Imported within the check, which then reports what is missing, such as OpenCV, and lets the others run.
    from nsvq_lightning.commands.doctor.self_test import check_rendering

    yield from check_rendering()


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsvq doctor",
        description="Check whether this machine is fit for training, by a test against a float64 oracle, and whether a "
        "COLMAP folder is a good scene.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", nargs="?", type=Path, metavar="FOLDER", help="COLMAP folder to check")
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")
    return parser
