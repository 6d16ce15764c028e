"""Join the trained parts of 'nsvq split' to one scene file, and test it on the photos of the whole.

Examples:
  nsvq merge parts -o scene.nsvq
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np

from nsvq_lightning.commands.split import RUN


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what ``nsvq merge`` takes."""
    parser.add_argument("parts", type=Path, metavar="PARTS", help="folder that 'nsvq split' has made")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="file to write, of any format")


def run(options: argparse.Namespace) -> int:
    """Join what lies in the core of each part.

    Raises:
        ValueError: The folder has no parts, a part is not trained yet, or nothing is left of it.
        OSError: A file cannot be read or written.
    """
    import torch

    from nsvq_lightning.data.blocks import BLOCK, Block, near_seams, points_in_front, shown
    from nsvq_lightning.data.scene import load_scene
    from nsvq_lightning.io.compressed import CompressedScene
    from nsvq_lightning.io.formats import format_of, read_scene, save
    from nsvq_lightning.quality.metrics import eight_bit, psnr
    from nsvq_lightning.rendering.rasterize import render

    format_of(options.output)
    found = (path.parent for path in options.parts.glob(f"*/{BLOCK}"))
    folders = sorted(found, key=lambda path: (len(path.name), path))
    if not folders:
        raise ValueError(f"{options.parts} has no parts: make them with 'nsvq split'")
    blocks = [Block.read(folder) for folder in folders]
    files = [folder / RUN / "scene.nsvq" for folder in folders]
    if missing := [file for file in files if not file.is_file()]:
        untrained = f"{len(missing)} of {len(files)} parts are not trained yet"
        raise ValueError(f"{untrained}, first {missing[0]}: run their fits")
    parts = []
    for folder, block, file in zip(folders, blocks, files, strict=True):
        whole = read_scene(file)
        part = whole.take(block.contains(whole.means + np.array(whole.origin))).in_use()
        sys.stdout.write(f"{folder}: {len(part):,} of {len(whole):,} splats are in its core\n")
        parts.append(part)
    photos = load_scene(blocks[0].scene)
    # Parts have the coordinates of the whole's files, whose origin only the whole knows.
    scene = replace(CompressedScene.joined(parts), origin=photos.frame.origin)
    size = save(scene, options.output)
    sys.stdout.write(f"{options.output}: {len(scene):,} splats in {size:,} bytes\n")
    splats = scene.decode()
    points = photos.points.double().numpy()
    seams = near_seams(points, blocks)

    # Where parts lie apart, no photo shows a seam.
    scores: dict[str, list[float]] = {"": [], "; at seams": [], ", elsewhere": []}
    for index in photos.test:
        view = photos.view(index)
        with torch.no_grad():
            image = render(splats, view.camera, antialiased=scene.antialiased).image
        pair = eight_bit(image), eight_bit(view.image)
        seam = torch.from_numpy(shown(points_in_front(points, view.camera), seams, view.camera))
        for place, chosen in zip(scores, (None, seam, ~seam), strict=True):
            masks = [each for each in (chosen, view.mask) if each is not None]
            mask = torch.stack(masks).all(0) if masks else None
            if mask is None or mask.any():
                scores[place].append(float(psnr(*pair, mask)))
    places = scores if scores["; at seams"] else [""]
    listed = "".join(f"{place} {fmean(scores[place]):.2f} dB" for place in places)
    sys.stdout.write(f"  test photos of {photos.root}:{listed}\n")
    return 0
