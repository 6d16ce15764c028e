"""Train every combination of the lists; write a table and a picture of PSNR over file size.

The same command goes on where it was, and trains only what is new. Options of 'nsvq fit' may follow; they hold for
every run: --data.factor=2 --splats=80000

Examples:
  nsvq sweep --scenes fox --codebooks 0.5k,1k,2k,4k,8k,16k --seeds 0,1,2 --max-steps 4500 --output sweeps/fox
  nsvq sweep --scenes fox,horns --configs paper,plain,own.yaml --output sweeps/own
"""

import argparse
import json
import logging
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from nsvq_lightning.commands.arguments import integers, names
from nsvq_lightning.io.atomic import write_text

if TYPE_CHECKING:
    from nsvq_lightning.commands.sweep.plan import Run, Settings
    from nsvq_lightning.commands.sweep.results import Row

log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what ``nsvq sweep`` takes; what it does not know are options of ``nsvq fit``."""
    parser.usage = "nsvq sweep --output FOLDER [options] [options of nsvq fit]"
    parser.allow_abbrev = False
    parser.set_defaults(further=[])
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="where all results go")
    add = parser.add_argument_group("what is combined; lists have commas between their entries").add_argument
    add("--scenes", type=names, default=(), metavar="A,B", help="COLMAP folders (default: that of the configuration)")
    add("--configs", type=names, default=(), metavar="A,B", help="files or shipped names, as for nsvq fit --config")
    add("--quantizers", type=names, default=(), metavar="A,B", help="classes, as for nsvq fit --model.quantizer")
    add("--codebooks", type=names, default=(), metavar="1k,4k", help="sizes, for configurations that have codebooks")
    add("--seeds", type=integers, default=(), metavar="0,1,2", help="of the draws and of the order of the views")
    add("--max-steps", type=int, metavar="N", help="iterations of every run (default: those of its configuration)")
    parser.add_argument("--keep-checkpoints", action="store_true", help="keep those of finished runs")
    help_ = "only print a command for each unfinished run, to be run anywhere"
    parser.add_argument("--commands", action="store_true", help=help_)


def run(options: argparse.Namespace) -> int:
    """Train what is missing and write the tables.

    Returns:
        0, or 1 if a run has failed.

    Raises:
        argparse.ArgumentError: There is an argument that is no option.
        ValueError: The scenes or configurations are wrong.
        OSError: Another sweep writes to the folder, or a file cannot be read or written.
        KeyboardInterrupt: After Ctrl-C or SIGTERM.
    """
    from nsvq_lightning.commands.sweep.plan import plan
    from nsvq_lightning.training.run_folder import hold, let_go

    output, further = options.output, options.further
    if further and not further[0].startswith("--"):
        message = f"unknown argument {further[0]!r}; a list has commas between its entries, and no spaces"
        raise argparse.ArgumentError(None, message)
    steps = [] if options.max_steps is None else [f"--trainer.max_steps={options.max_steps}"]
    lists = (options.scenes, options.configs, options.quantizers, options.codebooks, options.seeds)
    runs = plan(*lists, options=[*steps, *further])
    output.mkdir(parents=True, exist_ok=True)
    hold(output)
    # What a job scheduler sends ends the training that is on, too; it would go on alone otherwise.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if options.commands:
            sys.stdout.writelines(commands(output, runs))
            return 0
        rows = sweep(output, runs, keep_checkpoints=options.keep_checkpoints)
    except KeyboardInterrupt:
        sys.stderr.write("nsvq sweep: interrupted; the same command goes on where it stopped\n")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
        let_go(output)
    sys.stdout.write((output / "results.md").read_text(encoding="utf-8"))
    return int(any(row["error"] for row in rows))


def run_subprocess(arguments: Sequence[str], log: Path) -> int:
    """Run ``nsvq ARGUMENTS`` as a process of its own: what goes wrong in it, or is not given back, ends with it.

    Returns:
        Its exit status.
    """
    command = [sys.executable, "-u", "-X", "utf8", "-m", "nsvq_lightning", *arguments]
    with open(log, "wb") as file:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT)
    try:
        return process.wait()
    except KeyboardInterrupt:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(20.0)  # seconds that it has to stop by itself
        raise
    finally:  # nothing if it has ended
        process.kill()
        process.wait()


CHECKPOINT = Path("checkpoints", "last.ckpt")


def prepare(folder: Path, settings: "Settings") -> list[str]:
    """Make the folder of a training ready and write its settings there.

    Args:
        folder: Where; what a training that failed before its first checkpoint has left there is removed.
        settings: All settings of ``nsvq fit``.

    Returns:
        Arguments of ``nsvq`` that train, from the checkpoint in the folder if there is one.

    Raises:
        FileExistsError: Another process writes to the folder.
    """
    from nsvq_lightning.training.run_folder import RUN_FILES, hold, let_go

    folder.mkdir(parents=True, exist_ok=True)
    hold(folder)
    try:
        begun = (folder / CHECKPOINT).is_file()
        if not begun:
            for path in map(folder.joinpath, RUN_FILES):
                shutil.rmtree(path, ignore_errors=True)
                path.unlink(missing_ok=True)
        write_text(folder / "config.yaml", json.dumps(settings, indent=2) + "\n")  # JSON is YAML
    finally:
        let_go(folder)
    arguments = ["fit", "--config", str(folder / "config.yaml"), f"--trainer.run_folder={folder}"]
    return [*arguments, f"--ckpt_path={folder / CHECKPOINT}"] if begun else arguments


def train(folder: Path, settings: "Settings") -> str:
    """Train, from the checkpoint in the folder if there is one.

    Returns:
        Why the training has failed, in one line; nothing if it is done.
    """
    said = folder / "log.txt"
    log.info("%s: see %s", folder.name, said)
    try:
        status = run_subprocess(prepare(folder, settings), said)
    except OSError as error:  # of the disk, or another process trains there
        return str(error)
    if status == 0:
        found = (folder / "metrics.json").is_file()
        return "" if found else f"the run has left no metrics.json: callbacks.report must stay (see {said})"
    if status < 0:
        return f"killed by signal {-status}{', perhaps for want of memory' * (status == -9)} (see {said})"
    lines = [line.strip() for line in said.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return f"{(errors or lines or [f'exit status {status}'])[-1]} (see {said})"


def folder_of(output: Path, run: "Run") -> Path:
    """Folder of a run, named after its digest: no other run writes there. The title is that of the first."""
    return next((output / "runs").glob(f"*-{run.digest}"), output / "runs" / f"{run.title}-{run.digest}")


def commands(output: Path, runs: "Sequence[Run]") -> Iterator[str]:
    """A line for a shell in any folder for each run that is neither finished nor being trained."""
    for run in runs:
        folder = folder_of(output.absolute(), run)
        if not (folder / "metrics.json").is_file():
            try:
                yield shlex.join(["nsvq", *prepare(folder, run.settings)]) + "\n"
            except FileExistsError as error:
                log.info("%s", error)


def sweep(output: Path, runs: "Sequence[Run]", keep_checkpoints: bool = False) -> "list[Row]":
    """Train what is not finished yet; a run that fails does not keep the others from theirs.

    The tables are written anew after each run, so they are complete whenever this is interrupted.

    Args:
        output: Where: ``results.csv``, ``results.md``, ``results.png``, and a folder for each run.
        runs: The runs.
        keep_checkpoints: Keep those of finished runs, too.

    Returns:
        A row for each run, in their order.
    """
    from nsvq_lightning.commands.sweep import results

    folders = {folder_of(output, run): run for run in runs}
    finished = [folder for folder in folders if (folder / "metrics.json").is_file()]
    rows = {folder: results.row_of(folders[folder].names, folder) for folder in finished}
    results.write_results(output, list(rows.values()))
    for number, (folder, run) in enumerate(folders.items(), start=1):
        error, said = "", "finished before"
        if folder not in finished:
            error = train(folder, run.settings)
            row = rows[folder] = results.row_of(run.names, folder, error)
            said = "PSNR {:.2f} dB, {bytes} bytes, {seconds:.0f} s of training"
            said = f"failed: {error}" if error else said.format(row["psnr"] or float("inf"), **row)
            results.write_results(output, [rows[folder] for folder in folders if folder in rows])
        if not (error or keep_checkpoints):  # they are larger than everything else
            shutil.rmtree(folder / CHECKPOINT.parent, ignore_errors=True)
        log.info("[%d/%d] %s: %s", number, len(runs), run.title, said)
    return [rows[folder] for folder in folders]
