"""Write scene files in another format, joined, cleaned, thinned, turned and moved; the names select the formats.

The codebooks of a .nsvq file are used as the palette of .sog, and to make .spz smaller. To make a .ply small, with
codebooks fitted to it, or to thin it and train what is left, use 'nsvq compress'.

Examples:
  nsvq convert scene.nsvq scene.sog
  nsvq convert scene.ply scene.sog --palette 4096
  nsvq convert scene.ply scene.glb --measure
  nsvq convert house.ply garden.spz both.nsvq --crop -5 -5 -5 5 5 5
  nsvq convert scene.nsvq clean.nsvq --floaters --up z --data.root my/scene
"""

import argparse
import logging
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nsvq_lightning.commands.arguments import views_of
from nsvq_lightning.commands.compress import VIEWS, share_or_number, splats_left
from nsvq_lightning.io import formats, lod, placing, spz
from nsvq_lightning.io.compressed import CompressedScene, attribute_errors
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.io.sog import PALETTE_LIMIT
from nsvq_lightning.splats.conventions import Float64s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what ``nsvq convert`` takes."""
    add, suffixes = parser.add_argument, ", ".join(formats.FORMATS)
    add("inputs", nargs="+", type=Path, metavar="SCENE", help=f"files to read and join: {suffixes}")
    add("output", type=Path, metavar="OUT", help="file to write, of one of these formats")
    help_ = "largest number of rows of the .sog palette for a scene without an SH codebook; "
    help_ += f"{PALETTE_LIMIT} by default, 4096 to 16384 make a smaller file"
    add("--palette", type=int, metavar="ROWS", help=help_)
    help_ = f"version of .spz; {spz.DEFAULT_VERSION} by default, which more viewers support"
    add("--spz-version", dest="version", type=int, choices=spz.SPZ_VERSIONS, help=help_)
    help_ = f"axes of .spz; {spz.DEFAULT_AXES} by default, those of .ply, as viewers take them"
    add("--spz-axes", dest="axes", choices=spz.SPZ_AXES, help=help_)
    add("--level", choices=LEVELS, help="level of .nsvq")
    add("--measure", action="store_true", help="render both files and say how they differ")
    corners, help_ = ("X0", "Y0", "Z0", "X1", "Y1", "Z1"), "keep the splats with centres in this box, in scene units"
    add("--crop", nargs=6, type=float, metavar=corners, help=f"{help_} of the input")
    help_ = "remove splats that no photo of --data.root supports; takes minutes"
    add("--floaters", action="store_true", help=help_)
    help_ = "keep so many splats, or this share of them: those that contribute most to its pictures"
    add("--splats", type=share_or_number, metavar="N", help=help_)
    help_ = "keep spherical harmonics up to this degree"
    add("--sh-degree", type=int, choices=range(4), help=help_)
    turn = parser.add_mutually_exclusive_group().add_argument
    help_ = "turn the scene so that up, as the cameras of --data.root hold it, is this axis"
    turn("--up", choices=placing.UP_AXES, help=help_)
    help_ = "turn, scale and move the scene: the upper three rows of a matrix, from old to new coordinates"
    turn("--matrix", nargs=12, type=float, metavar=("A", *"BCDEFGHIJKL"), help=help_)
    help_ = "move the scene so that the cameras of --data.root are where those of this scene folder are, by photo name"
    turn("--align", type=Path, metavar="FOLDER", help=help_)
    add("--up-from", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where up is in the input, for --up")
    help_ = "scene folder: for --floaters, --up and --align; for --measure and --splats instead of the scene's pictures"
    add("--data.root", dest="root", type=Path, metavar="FOLDER", help=help_)


def run(options: argparse.Namespace) -> int:
    """Convert a file.

    Raises:
        argparse.ArgumentError: Options do not go together.
        ValueError: A file cannot be understood, or nothing is left of the scene.
        OSError: A file cannot be read or written.
    """
    moves = options.up or options.matrix or options.align
    edits = moves or options.crop or options.floaters or options.splats or len(options.inputs) > 1
    wrong = {
        "--up-from says where up is: add --up to say what it is to become": options.up_from and not options.up,
        "--floaters asks the photos: add --data.root": options.floaters and not options.root,
        "--align moves the cameras of a scene folder: add --data.root": options.align and not options.root,
        "--up needs to know where up is now: add --data.root or --up-from": options.up
        and not (options.up_from or options.root),
        "--data.root says where to measure: add --measure": options.root
        and not (options.measure or options.floaters or options.up or options.align or options.splats),
        "--measure compares with the input as it is: convert without it first": options.measure and edits,
    }
    writer: dict[str, Any] = {}
    for flag, name, suffixes in (
        ("--level", "level", (".nsvq",)),
        ("--palette", "palette", (".sog", lod.NAME)),
        ("--spz-version", "version", (".spz",)),
        ("--spz-axes", "axes", (".spz",)),
    ):
        if (value := getattr(options, name)) is not None:
            fits = formats.suffix_of(options.output) in suffixes
            wrong[f"{flag} is an option of {suffixes[0]} files, but the output is {options.output}"] = not fits
            writer |= {"storage": Storage(value)} if name == "level" else {name: value}
    for message, is_so in wrong.items():
        if is_so:
            raise argparse.ArgumentError(None, message)
    output: Path = options.output
    # Now, not after the minutes that floaters take.
    entry = formats.format_of(output)
    if not output.parent.is_dir() and formats.suffix_of(output) != lod.NAME:
        raise FileNotFoundError(f"cannot write {output}: the folder {output.parent} does not exist; create it first")
    scene = _edited(CompressedScene.joined([formats.read_scene(path) for path in options.inputs]), options)
    size = formats.save(scene, output, **writer)
    # What reading the output back would say of it is known here.
    logging.getLogger("nsvq_lightning").setLevel(logging.WARNING)
    sys.stdout.write(f"{output}: {len(scene):,} splats in {size:,} bytes, {size / len(scene):.1f} per splat\n")
    if entry.in_order is not None:  # the format is not exact
        errors = attribute_errors(formats.read_scene(output), entry.in_order(scene))
        listed = ", ".join(f"{name} {error:.2g}{'°' * (name == 'rotation')}" for name, error in errors.items())
        sys.stdout.write(f"  root mean square errors: {listed}\n")
    if options.measure:
        _measure(options.inputs[0], output, options.root)
    return 0


def _edited(scene: CompressedScene, options: argparse.Namespace) -> CompressedScene:
    """The scene within the box, without floaters, thinned, turned and moved, up to a degree, in this order."""
    before = len(scene)
    if options.crop is not None:
        scene = scene.cropped(np.array(options.crop[:3]), np.array(options.crop[3:]))
        if len(scene) == 0:
            named = ", ".join(map(str, options.inputs))
            raise ValueError(f"no splat of {named} is in the box {' '.join(map(str, options.crop))}")
        sys.stdout.write(f"crop: {before - len(scene):,} of {before:,} splats are outside\n")
    if options.floaters:
        scene = _without_floaters(scene, options.root)
    if (left := splats_left(options.splats, len(scene))) < len(scene):
        scene = _thinned(scene, left, options)
    if options.up is not None:
        scene = placing.rotated(scene, placing.turn_up(_up(options), options.up))
    if options.matrix is not None:
        scene = placing.moved(scene, np.array([*options.matrix, 0, 0, 0, 1]).reshape(4, 4))
    if options.align is not None:
        from nsvq_lightning.data.colmap import alignment
        from nsvq_lightning.data.transforms import read_poses

        scene = placing.moved(scene, alignment(*(read_poses(folder) for folder in (options.root, options.align))))
    if options.sh_degree is not None and options.sh_degree < scene.sh_degree:
        scene = scene.with_degree(options.sh_degree)
    return scene.in_use() if len(scene) < before else scene


def _up(options: argparse.Namespace) -> Float64s:
    """Where up is in the input, a unit vector ``[3]``."""
    if options.up_from is None:
        from nsvq_lightning.data.scene import load_scene
        from nsvq_lightning.rendering.poses import up_of

        return up_of(load_scene(options.root).cameras)
    up = np.array(options.up_from)
    length = float(np.linalg.norm(up))
    if not 0 < length < np.inf:
        raise ValueError(f"--up-from {' '.join(map(str, options.up_from))} is no direction")
    return np.asarray(up / length)


def _without_floaters(scene: CompressedScene, root: Path) -> CompressedScene:
    import torch

    from nsvq_lightning.compression.importance import floaters
    from nsvq_lightning.data.scene import View, load_scene
    from nsvq_lightning.rendering.rasterize import render
    from nsvq_lightning.report.numbers import evaluate

    photos = load_scene(root)
    splats = scene.decode().raw()
    look = partial(render, antialiased=scene.antialiased)

    def views() -> Iterator[View]:
        return (photos.view(index) for index in tqdm(photos.train, unit=" photos", mininterval=1))

    def psnr(keep: torch.Tensor) -> float:
        kept = type(splats)(*(tensor[keep] for tensor in splats))
        tests = (photos.view(index) for index in photos.test)
        return evaluate(lambda camera: look(kept, camera).image, tests, torch.device("cpu"))[0]

    removed = floaters(splats, views, look)
    sys.stdout.write(
        f"floaters: {int(removed.sum()):,} of {len(scene):,} splats; test photos at "
        f"{psnr(torch.ones_like(removed)):.2f} dB before, {psnr(~removed):.2f} dB after\n"
    )
    return scene.take((~removed).numpy())


def _thinned(scene: CompressedScene, count: int, options: argparse.Namespace) -> CompressedScene:
    """The splats that contribute most to photos of --data.root, or to the scene's own pictures."""
    from nsvq_lightning.compression.importance import contributions, most_contributing, row_weights
    from nsvq_lightning.rendering.rasterize import render

    splats = scene.decode()
    cameras, _ = views_of(options.inputs[0], splats, VIEWS, options.root)
    found = contributions(splats, cameras, partial(render, antialiased=scene.antialiased))
    return scene.take(most_contributing(row_weights(found), count).numpy())


def _measure(source: Path, output: Path, root: Path | None) -> None:
    """Say how pictures of two files differ."""
    from nsvq_lightning.compression.viewpoints import MEASURED, Measure, decibels

    original = formats.read_scene(source)
    splats = original.decode()
    cameras, _ = views_of(source, splats, MEASURED, root)
    measure = Measure(splats, cameras, original.antialiased)
    error = measure.error(formats.read_scene(output).decode())
    sys.stdout.write(
        f"  error {error:.4g} ({decibels(error):.2f} dB against {source.name} in {len(measure.cameras)} pictures)\n"
    )
