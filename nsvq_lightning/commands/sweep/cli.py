"""``nsvq sweep``: rate–distortion curves over codebook sizes, quantizers, seeds and scenes."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from nsvq_lightning.commands.arguments import Parser, integers, names

if TYPE_CHECKING:
    from nsvq_lightning.commands.sweep.plan import Run
    from nsvq_lightning.commands.sweep.runs import Sweep

__all__ = ["main"]

log = logging.getLogger("nsvq_lightning.commands.sweep")

EPILOG = """\
Options of 'nsvq fit' may follow; they hold for every run: --data.factor=2 --callbacks.density.max_splats=80000

examples:
  nsvq sweep --scenes fox --codebooks 0.5k,1k,2k,4k,8k,16k --seeds 0,1,2 --max-steps 4500 --output sweeps/fox
  nsvq sweep --scenes fox,horns --configs nsvq_4k,plain,own.yaml --output sweeps/own
"""

INTERRUPTED = 130
"""Exit status after Ctrl-C."""


def main(argv: Sequence[str] | None = None) -> int:
    """Train what is missing and write the tables.

    Args:
        argv: Arguments after ``nsvq sweep``; those of the process if None.

    Returns:
        0; 1 if a run has failed or the scenes or configurations are wrong; 130 after Ctrl-C. Wrong arguments end the
        process with status 2.
    """
    parser = _parser()
    options, further = parser.parse_known_args(argv)
    if further and not further[0].startswith("--"):
        parser.error(f"unknown argument {further[0]!r}; a list has commas between its entries, and no spaces")
    logging.basicConfig(format="%(message)s")
    log.setLevel(logging.INFO)
    from nsvq_lightning.commands.sweep.plan import Request, plan
    from nsvq_lightning.commands.sweep.runs import Sweep

    request = Request(
        scenes=tuple(map(Path, options.scenes)),
        configs=options.configs,
        quantizers=options.quantizers,
        codebooks=options.codebooks,
        seeds=options.seeds,
        max_steps=options.max_steps,
        options=tuple(further),
    )
    try:
        runs = plan(request)
        options.output.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"nsvq sweep: {error}\n")
        return 1
    sweep = Sweep(options.output, keep_checkpoints=options.keep_checkpoints)
    if options.dry_run:
        sys.stdout.writelines(_preview(sweep, runs))
        return 0
    return _train(sweep, runs)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsvq sweep",
        usage="nsvq sweep --output FOLDER [options] [options of nsvq fit]",
        description="Train every combination of scenes, configurations, quantizers, codebook sizes and seeds; write a "
        "table and a picture of PSNR against file size. What several runs share is trained once. The same command goes "
        "on where it was interrupted, and where it asks for more, trains only what is new.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="where all results go")
    add = parser.add_argument_group("what is combined; lists have commas between their entries").add_argument
    add("--scenes", type=names, default=(), metavar="A,B", help="COLMAP folders (default: that of the configuration)")
    add("--configs", type=names, default=(), metavar="A,B", help="files or shipped names, as for nsvq fit --config")
    add("--quantizers", type=names, default=(), metavar="A,B", help="classes, as for nsvq fit --model.quantizer")
    add("--codebooks", type=names, default=(), metavar="1k,4k", help="sizes, for configurations that have codebooks")
    add("--seeds", type=integers, default=(), metavar="0,1,2", help="of the draws and of the order of the views")
    add("--max-steps", type=int, metavar="N", help="iterations of every run (default: those of its configuration)")
    parser.add_argument("--keep-checkpoints", action="store_true", help="keep those of finished runs")
    parser.add_argument("--dry-run", action="store_true", help="only say which runs there are")
    return parser


def _preview(sweep: Sweep, runs: Sequence[Run]) -> list[str]:
    """A line for each run."""
    lines = []
    for run in runs:
        training, trunk = sweep.training(run), sweep.trunk(run)
        state = "finished" if training.record is not None else "begun" if training.checkpoint.is_file() else "new"
        origin = f"from trunks/{trunk.folder.name}" if trunk is not None else "from the start"
        lines.append(f"{training.folder.name}: {run.steps} iterations {origin}, {state}\n")
    return lines


def _train(sweep: Sweep, runs: Sequence[Run]) -> int:
    # What a job scheduler sends ends the training that is on, too; it would go on alone otherwise.
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        rows = sweep.train(runs)
    except KeyboardInterrupt:
        sys.stderr.write("nsvq sweep: interrupted; the same command goes on where it stopped\n")
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, before)
    sys.stdout.write((sweep.folder / "results.md").read_text(encoding="utf-8"))
    return int(any(row.error for row in rows))


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
