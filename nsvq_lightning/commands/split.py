r"""Cut a scene folder into parts that are trained one by one, on as many machines as there are, and then merged.

Each part is a scene folder of its own, with the photos and points that show it. The commands that train the parts go to
standard output, a line each; options of 'nsvq fit' may follow and are in them. Those of the data (--data.factor=2) say
how the photos of the whole are read.

Examples:
  nsvq split photos parts --blocks 4
  nsvq split photos parts --blocks 4 --config best | tr '\n' '\0' | xargs -0 -n 1 -P 2 sh -c
  nsvq merge parts -o scene.nsvq
"""

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from shutil import rmtree

from nsvq_lightning.commands import join, say
from nsvq_lightning.commands.arguments import READ, positive
from nsvq_lightning.commands.sweep import resolve

# Folder of a part's run.
RUN = "run"
# Options of the data of parts, whatever those of the whole are.
AS_WRITTEN = "--data.factor=1", "--data.images_folder=images", "--data.model=null", "--data.masks=masks"


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq split`` takes; what it does not know are options of ``nsvq fit``."""
    parser.usage = "nsvq split SCENE OUT [--blocks N] [options of nsvq fit]"
    parser.allow_abbrev = False
    parser.set_defaults(further=())
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("output", type=Path, metavar="OUT", help="new folder, with a folder for each part")
    parser.add_argument("--blocks", type=positive(int), default=4, metavar="N", help="number of parts; 4 by default")


def run(options: Namespace) -> None:
    """Write the parts, and print the commands that train them.

    Raises:
        ValueError: The scene cannot be used or has too little to see for so many parts.
        OSError: The output exists, or a file cannot be read or written.
    """
    import yaml

    from nsvq_lightning.data.blocks import cut, write_blocks
    from nsvq_lightning.data.scene import load_scene, usable

    if options.output.exists():
        raise FileExistsError(f"{options.output} exists: remove it, or give another folder")
    read = {}
    if options.further:
        given = yaml.safe_load(resolve([*options.further, f"--data.root={options.scene}"]))["data"]["init_args"]
        read = {name: given[name] for name in READ if name in given}
    scene = usable(load_scene(options.scene, cache_bytes=0, **read))
    behind = ["--model.background=white"] if scene.white else []  # what the photos of parts are in front of
    blocks = cut(scene, options.blocks, **read)
    folders = [options.output / str(number) for number in range(1, len(blocks) + 1)]
    for folder in folders:
        folder.mkdir(parents=True)
    try:
        counts = write_blocks(scene, blocks, folders)
    except BaseException:
        rmtree(options.output, ignore_errors=True)  # so that the command can be given again
        raise
    for folder, (train, test) in zip(folders, counts, strict=True):
        sys.stderr.write(f"{folder}: {train} train and {test} test photos\n")
        root = folder.resolve().as_posix()  # which every shell takes
        ends = [f"--data.root={root}", f"--trainer.run_folder={root}/{RUN}", *AS_WRITTEN * bool(read)]
        say(join(["nsvq", "fit", *behind, *options.further, *ends]))
