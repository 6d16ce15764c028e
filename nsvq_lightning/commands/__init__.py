"""The commands that may follow ``nsvq``. Light: it imports no heavy modules."""

import sys
from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches

from nsvq_lightning.top_level import join as join

# What each command does. It is the module of its name that does it, see
# :func:`~nsvq_lightning.commands.main.run_command`, or Lightning.
COMMANDS = {
    "prepare": "make a scene of photos or a video",
    "fit": "train a scene, compress it, and measure the decoded file",
    "test": "write the compressed file of a checkpoint, read it back and measure it",
    "validate": "measure the scene of a checkpoint",
    "predict": "render every view of a scene into a folder",
    "export": "write the scene of a checkpoint as a file",
    "info": "describe a scene file of any format",
    "convert": "write a scene file in another format",
    "compress": "make an existing splat file small",
    "split": "cut a scene folder into parts to train one by one",
    "merge": "join the trained parts of a scene",
    "view": "look at a scene in the browser, also while it trains",
    "render": "render pictures or a video along a path of cameras",
    "sweep": "train many runs and compare them",
    "doctor": "check whether this machine and a scene folder are fit",
    "benchmark": "measure run time against error on this machine",
}

# Those of Lightning's command line, which takes seconds to start.
OF_LIGHTNING = ("fit", "test", "validate", "predict", "export")


def overview() -> str:
    """What ``nsvq --help`` prints."""
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:{width}}  {summary}" for name, summary in COMMANDS.items())
    return f"""usage: nsvq COMMAND [options]

Train 3D Gaussian splatting scenes and store them small.

commands:
{commands}

nsvq COMMAND --help    options of a command
nsvq --version         version of this package

nsvq fit --config demo                    train the embedded scene
nsvq fit --data.root path/to/scene        train yours
"""


def nearest(word: str, known: Iterable[str]) -> str:
    """``; did you mean …?`` with the one that is most like a word; empty if none is."""
    found = get_close_matches(word, known, n=1)
    return f"; did you mean {found[0]}?" if found else ""


def say(*lines: str) -> None:
    """Write lines to standard output."""
    sys.stdout.writelines(f"{line}\n" for line in lines)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[str]) -> str:
    """A Markdown table that also reads well as plain text; columns named in ``words`` align left, numbers right."""
    columns = []
    for name, *cells in zip(head, *rows, strict=True):
        width = max(3, *map(len, (name, *cells)))
        aligned, end = (str.ljust, "-") if name in words else (str.rjust, ":")
        columns.append([aligned(cell, width) for cell in (name, aligned(end, width, "-"), *cells)])
    return "\n".join(f"| {' | '.join(line)} |" for line in zip(*columns, strict=True))
