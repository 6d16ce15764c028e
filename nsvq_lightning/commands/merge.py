"""Join the trained parts of 'nsvq split' to one scene file, and test it on the photos of the whole.

Examples:
  nsvq merge parts -o scene.nsvq
"""

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

from nsvq_lightning.commands import say
from nsvq_lightning.commands.split import RUN


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq merge`` takes."""
    parser.add_argument("parts", type=Path, metavar="PARTS", help="folder that 'nsvq split' has made")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="file to write, of any format")


def run(options: Namespace) -> None:
    """Join what lies in the core of each part.

    Raises:
        ValueError: The folder has no parts, a part is not trained yet, or nothing is left of it.
        OSError: A file cannot be read or written.
    """
    from nsvq_lightning.data.blocks import BLOCK, Block
    from nsvq_lightning.data.scene import load_scene, usable
    from nsvq_lightning.io.compressed import CompressedScene, on_white, renderer
    from nsvq_lightning.io.formats import format_of, read_scene, save
    from nsvq_lightning.report.numbers import evaluate
    from nsvq_lightning.splats.conventions import ZERO

    format_of(options.output)
    folders = [path.parent for path in options.parts.glob(f"*/{BLOCK}")]
    folders.sort(key=lambda path: (len(path.name), path))
    if not folders:
        raise ValueError(f"{options.parts} has no parts: make them with 'nsvq split'")
    files = [folder / RUN / "scene.nsvq" for folder in folders]
    if missing := [file for file in files if not file.is_file()]:
        untrained = f"{len(missing)} of {len(files)} parts are not trained yet"
        raise ValueError(f"{untrained}, first {missing[0]}: run their fits")
    blocks = [Block.read(folder) for folder in folders]
    if len(blocks) < blocks[0].parts:
        raise ValueError(f"{options.parts} has {len(blocks)} of {blocks[0].parts} parts: copy the others there, too")
    parts = []
    for folder, block, file in zip(folders, blocks, files, strict=True):
        whole = read_scene(file)
        part = whole.take(block.contains(whole.means + whole.origin)).in_use()
        say(f"{folder}: {len(part):,} of {len(whole):,} splats are in its core")
        parts.append(part)
    photos = usable(load_scene(blocks[0].scene, **blocks[0].options))
    # Parts have the coordinates of the whole's files, whose origin only the whole knows, or are relative to one there.
    scene = replace(CompressedScene.joined(parts).relative_to(ZERO), origin=photos.frame.origin)
    size = save(scene, options.output)
    say(f"{options.output}: {len(scene):,} splats in {size:,} bytes")
    look = renderer(on_white(scene) if photos.white else scene)
    quality, _ = evaluate(look, scene.tensors(), map(photos.view, photos.test))
    say(f"  test photos of {photos.root}: {quality:.2f} dB")
