"""The commands that may follow ``nsvq``. Light: it imports no heavy modules."""

from typing import NamedTuple


class Command(NamedTuple):
    """A command."""

    summary: str
    module: str | None = None
    """What :func:`~nsvq_lightning.commands.main.run_command` runs; None for the commands of Lightning's command line,
    which takes seconds to start."""


# All commands by name.
COMMANDS = {
    "prepare": Command("make a scene of photos or a video", "nsvq_lightning.commands.prepare"),
    "fit": Command("train a scene, compress it, and measure the decoded file"),
    "test": Command("write the compressed file of a checkpoint, read it back and measure it"),
    "validate": Command("measure the scene of a checkpoint"),
    "predict": Command("render every view of a scene into a folder"),
    "export": Command("write the scene of a checkpoint as a file"),
    "info": Command("describe a scene file of any format", "nsvq_lightning.commands.info"),
    "convert": Command("write a scene file in another format", "nsvq_lightning.commands.convert"),
    "compress": Command("make an existing splat file small", "nsvq_lightning.commands.compress"),
    "split": Command("cut a scene folder into parts to train one by one", "nsvq_lightning.commands.split"),
    "merge": Command("join the trained parts of a scene", "nsvq_lightning.commands.merge"),
    "view": Command("look at a scene in the browser, also while it trains", "nsvq_lightning.commands.view"),
    "render": Command("render pictures or a video along a path of cameras", "nsvq_lightning.commands.render"),
    "sweep": Command("train many runs and compare them", "nsvq_lightning.commands.sweep"),
    "doctor": Command("check whether this machine and a scene folder are fit", "nsvq_lightning.commands.doctor"),
    "benchmark": Command("measure run time against error on this machine", "nsvq_lightning.commands.benchmark.command"),
}


def overview() -> str:
    """What ``nsvq --help`` prints."""
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:{width}}  {command.summary}" for name, command in COMMANDS.items())
    return f"""usage: nsvq COMMAND [options]

Train 3D Gaussian splatting scenes and store them small.

commands:
{commands}

nsvq COMMAND --help    options of a command
nsvq --version         version of this package

nsvq fit --config demo                    train the embedded scene
nsvq fit --data.root path/to/scene        train yours
"""
