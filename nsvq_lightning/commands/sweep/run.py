"""Train every combination of the lists; write a table and a picture of PSNR over file size.

What several runs share is trained once. The same command goes on where it was, and trains only what is new. Options
of 'nsvq fit' may follow; they hold for every run: --data.factor=2 --callbacks.density.max_splats=80000

Examples:
  nsvq sweep --scenes fox --codebooks 0.5k,1k,2k,4k,8k,16k --seeds 0,1,2 --max-steps 4500 --output sweeps/fox
  nsvq sweep --scenes fox,horns --configs paper,plain,own.yaml --output sweeps/own
"""

from __future__ import annotations

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
from nsvq_lightning.commands.sweep import results
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.version import __version__

if TYPE_CHECKING:
    from nsvq_lightning.commands.sweep.plan import Run, Settings

log = logging.getLogger(__name__)

CHECKPOINT = Path("checkpoints", "last.ckpt")


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
    add = parser.add_mutually_exclusive_group().add_argument
    add("--dry-run", action="store_true", help="only say which runs there are")
    add("--commands", action="store_true", help="only print a command for each unfinished run, to be run anywhere")


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
    if options.dry_run:
        sys.stdout.writelines(preview(output, runs))
        return 0
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


def prepare(folder: Path, settings: Settings, start: Path | None = None) -> list[str]:
    """Make the folder of a training ready and write its settings there.

    Args:
        folder: Where; what a training that failed before its first checkpoint has left there is removed.
        settings: All settings of ``nsvq fit``.
        start: Checkpoint to branch from if there is none in the folder to continue from.

    Returns:
        Arguments of ``nsvq`` that train.

    Raises:
        FileExistsError: Another process writes to the folder.
    """
    from nsvq_lightning.training.run_folder import RUN_FILES, hold, let_go

    folder.mkdir(parents=True, exist_ok=True)
    hold(folder)
    try:
        if (folder / CHECKPOINT).is_file():
            start = folder / CHECKPOINT
        else:
            for path in map(folder.joinpath, RUN_FILES):
                shutil.rmtree(path, ignore_errors=True)
                path.unlink(missing_ok=True)
        write_text(folder / "config.yaml", json.dumps(settings, indent=2) + "\n")  # JSON is YAML
    finally:
        let_go(folder)
    arguments = ["fit", "--config", str(folder / "config.yaml"), f"--trainer.run_folder={folder}"]
    return arguments if start is None else [*arguments, f"--ckpt_path={start}"]


def train(folder: Path, settings: Settings, start: Path | None = None) -> str:
    """Train, from the checkpoint in the folder if there is one, else from ``start``, else from the beginning.

    Returns:
        Why the training has failed, in one line; nothing if it is done.
    """
    said = folder / "log.txt"
    log.info("%s: see %s", folder.name, said)
    try:
        status = run_subprocess(prepare(folder, settings, start), said)
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


def folder_of(output: Path, run: Run, kind: str = "runs") -> Path:
    """Folder of a run, named after its digest: no other run writes there. The title is that of the first."""
    return next((output / kind).glob(f"*-{run.digest}"), output / kind / f"{run.title}-{run.digest}")


def preview(output: Path, runs: Sequence[Run]) -> Iterator[str]:
    """A line for each run."""
    for run in runs:
        folder, trunk = folder_of(output, run), run.trunk
        begun = "begun" if (folder / CHECKPOINT).is_file() else "new"
        state = "finished" if (folder / "metrics.json").is_file() else begun
        origin = f"trunks/{folder_of(output, trunk, 'trunks').name}" if trunk is not None else "the start"
        yield f"{folder.name}: {run.names['steps']} iterations from {origin}, {state}\n"


def commands(output: Path, runs: Sequence[Run]) -> Iterator[str]:
    """A line for a shell in any folder for each run that is neither finished nor being trained."""
    for run in runs:
        folder = folder_of(output.absolute(), run)
        if not (folder / "metrics.json").is_file():
            try:
                yield shlex.join(["nsvq", *prepare(folder, run.settings)]) + "\n"
            except FileExistsError as error:
                log.info("%s", error)


def sweep(output: Path, runs: Sequence[Run], keep_checkpoints: bool = False) -> list[results.Row]:
    """Train what is not finished yet; a run that fails does not keep the others from theirs.

    The tables are written anew after each run, so they are complete whenever this is interrupted. A trunk is what
    several runs share: the training up to the end of the prune phase. It is trained once, and its checkpoint stays, so
    that more sizes or quantizers can branch from it later.

    Args:
        output: Where: ``results.csv``, ``results.md``, ``results.png``, and a folder for each run and trunk.
        runs: The runs.
        keep_checkpoints: Keep those of finished runs, too.

    Returns:
        A row for each run, in their order.
    """
    folders = {folder_of(output, run): run for run in runs}
    rows: dict[Path, results.Row] = {}
    for folder, run in folders.items():
        if (folder / "finished.json").is_file():
            rows[folder] = results.row_of(run.names, folder)
    failed: dict[Path, str] = {}
    results.write_results(output, list(rows.values()))
    for number, (folder, run) in enumerate(folders.items(), start=1):
        counted = f"[{number}/{len(runs)}] {run.title}"
        if folder in rows:
            log.info("%s: finished before", counted)
            continue
        error = _finish(output, run, folder, failed)
        if not (error or keep_checkpoints):  # they are larger than everything else
            shutil.rmtree(folder / CHECKPOINT.parent, ignore_errors=True)
        row = rows[folder] = results.row_of(run.names, folder, error)
        result = "PSNR {:.2f} dB, {bytes} bytes, {seconds:.0f} s of training, {trunk_seconds:.0f} s of it shared"
        log.info("%s: %s", counted, f"failed: {error}" if error else result.format(row["psnr"] or float("inf"), **row))
        results.write_results(output, [rows[folder] for folder in folders if folder in rows])
    return [rows[folder] for folder in folders]


def _finish(output: Path, run: Run, folder: Path, failed: dict[Path, str]) -> str:
    """Train a run and its trunk, or collect what its command has left; returns why it has failed.

    Args:
        output: Folder of the sweep.
        run: The run.
        folder: Its folder.
        failed: Why trunks have failed, by their folders; they are not tried again.
    """
    trunk, start, shared = run.trunk, None, None
    if trunk is not None:
        base = folder_of(output, trunk, "trunks")
        start, shared = base / CHECKPOINT, results.read(base / "metrics.json")
        # A run that was interrupted after its trunk goes on from its own checkpoint.
        needed = not any((folder / name).is_file() for name in ("metrics.json", CHECKPOINT))
        if needed and (shared is None or not start.is_file()):
            failed[base] = failed.get(base) or train(base, trunk.settings)
            if failed[base]:
                return f"trunk: {failed[base]}"
            shared = results.read(base / "metrics.json")
    if not (folder / "metrics.json").is_file() and (error := train(folder, run.settings, start)):
        return error
    # A run that its command has started has not branched, and has measured other times.
    branched = shared is not None and shared["phases"][-1] in results.read(folder / "metrics.json")["phases"]
    record = {"version": __version__, "trunk": base.name if branched else None}
    write_text(folder / "finished.json", json.dumps(record, indent=2) + "\n")
    return ""
