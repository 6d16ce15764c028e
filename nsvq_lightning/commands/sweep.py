"""Train every combination of the lists; write tables of what each came to, and of how far it is from the first.

The same command goes on where it was, and trains only what is new. Options of 'nsvq fit' may follow; they hold for
every run: --data.factor=2 --splats=80000

Examples:
  nsvq sweep --scenes fox --codebooks 0.5k,1k,2k,4k,8k,16k --seeds 0,1,2 --max-steps 4500 --output sweeps/fox
  nsvq sweep --scenes fox,horns --configs paper,plain,own.yaml --output sweeps/own
"""

import json
import re
import subprocess
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from hashlib import sha256
from io import StringIO
from itertools import product
from pathlib import Path
from shutil import rmtree
from typing import Any, NamedTuple
from warnings import catch_warnings

import numpy as np

from nsvq_lightning.commands import join, markdown_table, say
from nsvq_lightning.commands.arguments import integers, names, positive
from nsvq_lightning.commands.settings import expand
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.top_level import log
from nsvq_lightning.version import __version__

# What a line of ``results.csv`` says, by column.
Row = dict[str, Any]

# A difference is called noise if, where there is none, as much is met with this chance or more.
CHANCE = 0.05
# In the folder of a run.
CHECKPOINT = Path("checkpoints", "last.ckpt")


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq sweep`` takes; what it does not know are options of ``nsvq fit``."""
    parser.usage = "nsvq sweep --output FOLDER [options] [options of nsvq fit]"
    parser.allow_abbrev = False
    parser.set_defaults(further=())
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="where all results go")
    add = parser.add_argument_group("what is combined; lists have commas between their entries").add_argument
    # An empty entry leaves the choice to the configuration.
    listed: dict[str, Any] = {"type": names, "default": ("",)}
    add("--scenes", **listed, metavar="A,B", help="COLMAP folders (default: that of the configuration)")
    add("--configs", **listed, metavar="A,B", help="files or shipped names, as for nsvq fit --config")
    add("--quantizers", **listed, metavar="A,B", help="classes, as for nsvq fit --model.quantizer")
    add("--codebooks", **listed, metavar="1k,4k", help="sizes, for configurations that have codebooks")
    add("--seeds", type=integers, default=("",), metavar="0,1,2", help="of the draws and of the order of the views")
    add("--max-steps", type=positive(int), metavar="N", help="iterations of every run (default: its configuration's)")
    parser.add_argument("--keep-checkpoints", action="store_true", help="keep those of finished runs")
    help_ = "only print a command for each unfinished run, to be run anywhere"
    parser.add_argument("--commands", action="store_true", help=help_)


def run(options: Namespace) -> int:
    """Train what is missing and write the tables.

    Returns:
        0, or 1 if a run has failed.

    Raises:
        ValueError: The scenes or configurations are wrong.
        OSError: Another sweep writes to the folder, or a file cannot be read or written.
        KeyboardInterrupt: After Ctrl-C or SIGTERM.
    """
    from nsvq_lightning.training.run_folder import hold, let_go

    output = options.output
    runs = plan(options)
    hold(output)
    try:
        if options.commands:
            for command in commands(runs):
                say(command)
            return 0
        rows = sweep(output, runs, options.keep_checkpoints)
    except KeyboardInterrupt:
        sys.stderr.write("nsvq sweep: interrupted; the same command goes on where it stopped\n")
        raise
    finally:
        let_go(output)
    sys.stdout.write((output / "results.md").read_text(encoding="utf-8"))
    return int(any(row["error"] for row in rows))


class Run(NamedTuple):
    """One run.

    Attributes:
        names: What tells it from the others: ``scene`` (name of the folder), ``config`` (name), ``quantizer`` (class),
            ``codebooks`` and ``seed``, the last three empty where the configuration decides.
        config: All settings of ``nsvq fit``, as YAML.
        folder: Its folder: the names, and a digest of settings and version, so that no other run writes there.
    """

    names: Row
    config: str
    folder: Path

    @property
    def is_finished(self) -> bool:
        """Whether it has been trained and measured."""
        return (self.folder / "metrics.json").is_file()


def plan(options: Namespace) -> list[Run]:
    """All runs that options of ``nsvq sweep`` ask for, one configuration after the other.

    Quantizers and codebook sizes are only for configurations that have codebooks.

    Raises:
        SystemExit: A configuration or an option of ``nsvq fit`` is wrong; a line on stderr says how.
        ValueError: A codebook size is unknown, a scene is no folder or not named, two runs have the same names, or
            options give a checkpoint to go on from, a seed of everything, or two sizes of the scene.
    """
    import yaml

    from nsvq_lightning.splats.attributes import codebook_sizes

    for size in filter(None, options.codebooks):
        codebook_sizes(size)
    for scene in filter(None, options.scenes):
        if not Path(scene).is_dir():
            raise ValueError(f"{scene} is no folder; --scenes takes COLMAP folders with commas between them")
    log.info("planning the runs takes a quarter of a second for each")
    common = [*options.further, "--trainer.logger=false"]
    if steps := options.max_steps:
        others = [f"--callbacks.phases.{length}=null" for length in ("iterations_per_photo", "minutes", "total")]
        common += [f"--trainer.max_steps={steps}", *others]
    runs: list[Run] = []
    for config in options.configs:
        arguments = [*_given({"config": config}), *common]
        default = yaml.safe_load(resolve([*arguments, *_given({"data.root": options.scenes[0]})]))
        own = {**default, "trainer.run_folder": default["trainer"]["run_folder"]}
        for option in ("ckpt_path", "seed_everything", "trainer.run_folder"):
            if given := own[option]:
                raise ValueError(f"a sweep has checkpoints, folders and --seeds of its own; leave {option}={given} out")
        quantizers, sizes = options.quantizers, options.codebooks
        if default["model"]["codebooks"] is None:
            quantizers = sizes = ("",)
        for scene, quantizer, size, seed in product(options.scenes, quantizers, sizes, options.seeds):
            # Absolute, so that the same sweep started from another folder finds its runs.
            found = scene or default["data"]["init_args"].get("root", "")
            if found is None:
                raise ValueError("which scenes? Name their folders: --scenes=path/to/one,path/to/another")
            root = Path(found).expanduser().resolve()
            start = default["model"]["init_from"]
            chosen = {
                "data.root": root,
                "model.init_from": start and Path(start).expanduser().absolute(),
                "model.quantizer": quantizer,
                "model.codebooks": size,
                "model.seed": seed,
                "data.seed": seed,
            }
            text = resolve([*arguments, *_given(chosen)])
            labels = {
                "scene": root.name,
                "config": Path(config).stem or "default",
                "quantizer": quantizer.rpartition(".")[2],
                "codebooks": size,
                "seed": seed,
            }
            title = "-".join(str(name) for name in labels.values() if name != "")
            if any(run.names == labels for run in runs):
                raise ValueError(f"two runs are called {title}: rename a scene or configuration to tell them apart")
            digest = sha256(f"{__version__}\n{text}".encode()).hexdigest()
            runs.append(Run(labels, text, options.output.resolve() / "runs" / f"{title}-{digest[:12]}"))
    return runs


def _given(chosen: Mapping[str, object]) -> list[str]:
    """Options of ``nsvq fit`` for what has been chosen, and is not empty."""
    return [f"--{option}={value}" for option, value in chosen.items() if value not in ("", None)]


def resolve(arguments: Sequence[str]) -> str:
    """What ``nsvq fit ARGUMENTS --print_config`` prints.

    Raises:
        SystemExit: The arguments are wrong; a line on stderr says how.
        ValueError: They name two sizes of the scene.
    """
    from nsvq_lightning.commands.fit import SplatCLI

    printed = StringIO()
    with catch_warnings(action="ignore"), redirect_stdout(printed):
        try:
            SplatCLI(["fit", *expand(arguments), "--print_config"])
        except SystemExit as end:
            if end.code:
                raise
    return printed.getvalue()


def prepare(run: Run) -> list[str]:
    """Make the folder of a run ready and write its settings there.

    What a training that failed before its first checkpoint has left in the folder is removed.

    Returns:
        Arguments of ``nsvq`` that train, from the checkpoint in the folder if there is one.

    Raises:
        FileExistsError: Another process writes to the folder.
    """
    from nsvq_lightning.training.run_folder import RUN_FILES, hold, let_go

    hold(run.folder)
    try:
        begun, config = (run.folder / CHECKPOINT).is_file(), run.folder / "config.yaml"
        if not begun:
            for path in map(run.folder.joinpath, RUN_FILES):
                rmtree(path, ignore_errors=True)
                path.unlink(missing_ok=True)
            write_text(config, run.config)  # a run that has begun notes there how many iterations its minutes are
    finally:
        let_go(run.folder)
    arguments = ["fit", "--config", config.as_posix(), f"--trainer.run_folder={run.folder.as_posix()}"]
    if begun:
        arguments.append(f"--ckpt_path={(run.folder / CHECKPOINT).as_posix()}")
    return arguments


def commands(runs: Sequence[Run]) -> Iterator[str]:
    """A line for a shell in any folder for each run that is neither finished nor being trained."""
    for run in runs:
        if not run.is_finished:
            try:
                yield join(["nsvq", *prepare(run)])
            except FileExistsError as error:
                log.info(f"{error}")


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


def train(run: Run) -> str:
    """Train, from the checkpoint in the folder if there is one.

    Returns:
        Why the training has failed, in one line; nothing if it is done.
    """
    said = run.folder / "log.txt"
    log.info(f"{run.folder.name}: see {said}")
    try:
        status = run_subprocess(prepare(run), said)
    except OSError as error:  # of the disk, or another process trains there
        return str(error)
    if status == 0:
        return "" if run.is_finished else f"the run has left no metrics.json: callbacks.report must stay (see {said})"
    if status < 0:
        guess = ", perhaps for want of memory" if status == -9 else ""
        return f"killed by signal {-status}{guess} (see {said})"
    text = said.read_text(encoding="utf-8", errors="replace").strip()
    errors = re.findall(r"^error: (.+)$", text, re.MULTILINE)
    return f"{[f'exit status {status}', *text.splitlines(), *errors][-1]} (see {said})"


def sweep(output: Path, runs: Sequence[Run], keep_checkpoints: bool = False) -> list[Row]:
    """Train what is not finished yet; a run that fails does not keep the others from theirs.

    The tables are written anew after each run, so they are complete whenever this is interrupted.

    Args:
        output: Where ``results.csv`` and ``results.md`` go.
        runs: The runs.
        keep_checkpoints: Keep those of finished runs, too.

    Returns:
        A row for each run, in their order.
    """
    failed = {}
    for number, run in enumerate(runs, start=1):
        error = "" if run.is_finished else train(run)
        if error:
            failed[run.folder] = error
        elif not keep_checkpoints:  # they are larger than everything else
            rmtree(run.folder / CHECKPOINT.parent, ignore_errors=True)
        log.info(f"[{number}/{len(runs)}] {run.folder.name}: {error or 'finished'}")
        known = [each for each in runs if each.is_finished or each.folder in failed]
        rows = [row_of(each, failed.get(each.folder, "")) for each in known]
        write_results(output, rows)
    return rows


def row_of(run: Run, error: str) -> Row:
    """What a run came to that has finished, or failed with an error.

    Returns:
        Scene, config, quantizer, codebooks, seed; PSNR (dB; None where infinite) and SSIM of the decoded file on the
        test views, its bytes and splats; its bytes at level ``paper``, and the PSNR of the scene before it was stored,
        which is that of level ``paper``; the seconds of training; the PSNR of the plain splats at the end of the prune
        phase, None without codebooks; the version of the package that trained it; folder; error. What is not known, as
        in a failed run, is None.
    """
    metrics = {} if error else json.loads((run.folder / "metrics.json").read_bytes())
    return {
        **run.names,
        "psnr": metrics.get("psnr"),
        "ssim": metrics.get("ssim"),
        "bytes": metrics.get("file_bytes"),
        "splats": metrics.get("num_splats"),
        "bytes_paper": metrics.get("paper_level", {}).get("file_bytes"),
        "psnr_paper": metrics.get("phases", [{}])[-1].get("psnr"),
        "seconds": metrics.get("train_seconds"),
        "psnr_before": (metrics.get("before_quantization") or {}).get("psnr"),
        "version": None if error else __version__,
        "folder": run.folder,
        "error": error,
    }


# Columns that say which runs a line of the table is about: they differ in the seed alone.
NAMES = ("scene", "config", "quantizer", "codebooks")
# Format of the columns of the table.
TABLE = {"psnr": ".2f", "ssim": ".4f", "bytes": ",.0f", "splats": ",.0f", "psnr_before": ".2f", "seconds": ",.0f"}


def write_results(output: Path, rows: Sequence[Row]) -> None:
    """Write ``results.csv``, a row a run, and ``results.md``, of those that have not failed.

    Those that differ in the seed alone are a line of the table, with mean and standard deviation, and how far they are
    from the scene's first line (:func:`difference`).
    """
    from nsvq_lightning.report import numbers

    groups: dict[tuple[str, ...], list[Row]] = {}
    failed = []
    for row in rows:
        if row["error"]:
            failed.append("* {scene}, {config}, {codebooks}, seed {seed}: {error}\n".format(**row))
        else:
            groups.setdefault(tuple(row[name] for name in NAMES), []).append(row)
    lines = []
    first: dict[str, list[Row]] = {}
    for key, group in groups.items():
        reference = first.setdefault(key[0], group)
        line = [*(name or "–" for name in key), str(len(group))]
        for column, form in TABLE.items():
            values = [row[column] for row in group if row[column] is not None]
            text = f"{np.mean(values):{form}}" if values else "–"
            if len(values) > 1:
                text += f" ± {np.std(values, ddof=1):{form}}"
            line.append(text)
        lines.append([*line, difference(group, reference)])
    heads = [*NAMES, "runs", *TABLE, "to the first"]
    text = f"# nsvq sweep\n\n{markdown_table(heads, lines, words=NAMES)}\n\n"
    text += "Mean ± standard deviation over the seeds. PSNR (dB) and SSIM are of the decoded file on the test views, "
    text += "psnr_before of the plain splats. To the first line of the scene: mean difference of the PSNR ± standard "
    text += f"error, paired by seed; noise where chance alone does as much in {CHANCE:.0%} of the cases.\n"
    if failed:
        text += "\nFailed:\n\n" + "".join(failed)
    numbers.write_csv(output / "results.csv", rows)
    write_text(output / "results.md", text)


def difference(rows: Sequence[Row], first: Sequence[Row]) -> str:
    """Mean difference of the PSNR of runs to others with the same seeds ± its standard error, and whether it is noise.

    Pairs share what a seed decides, so their differences vary less than the runs do; Student's t says how far the mean
    of so few can be from 0 by chance.
    """
    from scipy import stats

    known = {row["seed"]: row["psnr"] for row in first}
    found = [row["psnr"] - known[row["seed"]] for row in rows if None not in (row["psnr"], known.get(row["seed"]))]
    if rows is first or not found:
        return "–"
    if len(found) == 1:
        return f"{found[0]:+.2f}, one seed"
    mean, error = np.mean(found), stats.sem(found)
    noise = not stats.ttest_1samp(found, 0).pvalue < CHANCE  # NaN where all are 0
    return f"{mean:+.3f} ± {error:.3f}{', noise' * noise}"
