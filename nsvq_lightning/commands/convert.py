"""``nsvq convert``: write a scene file in another format, for viewers."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nsvq_lightning.commands.arguments import Parser
from nsvq_lightning.commands.progress import progress
from nsvq_lightning.io.compressed import UP_AXES, CompressedScene, cropped, rotated, turn_up
from nsvq_lightning.io.describe import attribute_errors
from nsvq_lightning.io.formats import FORMATS, read_scene, save
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.io.sog import PALETTE_LIMIT
from nsvq_lightning.io.spz import DEFAULT_AXES, DEFAULT_VERSION, SPZ_AXES, SPZ_VERSIONS

if TYPE_CHECKING:
    from nsvq_lightning.data.scene import View

__all__ = ["main"]

_OPTIONS = {
    "level": ("--level", ".nsvq"),
    "palette": ("--palette", ".sog"),
    "version": ("--spz-version", ".spz"),
    "axes": ("--spz-axes", ".spz"),
}
"""Options of writers: their flag here, and their format."""

EPILOG = """\
The codebooks of a .nsvq file are used as the palette of .sog, and to make .spz smaller. To make a .ply small, with
codebooks fitted to it, use 'nsvq compress'.

examples:
  nsvq convert scene.nsvq scene.sog
  nsvq convert scene.ply scene.sog --palette 4096
  nsvq convert scene.ply scene.spz --measure
  nsvq convert scene.nsvq clean.nsvq --floaters --up z --data.root my/scene
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Convert a file.

    Args:
        argv: Arguments after ``nsvq convert``; those of the process if None.

    Returns:
        0, or 1 after an error in the user's files. Wrong arguments end the process with status 2.
    """
    parser = _parser()
    options = parser.parse_args(argv)
    chosen = {name: getattr(options, name) for name in _OPTIONS if getattr(options, name) is not None}
    for flag, suffix in (_OPTIONS[name] for name in chosen):
        if options.output.suffix.lower() != suffix:
            parser.error(f"{flag} is an option of {suffix} files, but the output is {options.output}")
    if options.up_from is not None and options.up is None:
        parser.error("--up-from says where up is: add --up to say what it is to become")
    if options.root is None and options.floaters:
        parser.error("--floaters asks the photos: add --data.root")
    if options.root is None and options.up is not None and options.up_from is None:
        parser.error("--up needs to know where up is now: add --data.root or --up-from")
    if options.root is not None and not (options.measure or options.floaters or options.up):
        parser.error("--data.root says where to measure: add --measure")
    if options.measure and (options.crop or options.floaters or options.up):
        parser.error("--measure compares with the input as it is: convert without it first")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("nsvq_lightning").setLevel(logging.INFO)
    if "level" in chosen:
        chosen["storage"] = Storage(chosen.pop("level"))
    try:
        _convert(options, chosen)
        if options.measure:
            _measure(options.input, options.output, options.root)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"nsvq convert: {error}\n")
        return 1
    return 0


def _convert(options: argparse.Namespace, chosen: dict[str, Any]) -> None:
    output: Path = options.output
    if not output.parent.is_dir():  # now, not after the minutes that floaters take
        raise FileNotFoundError(f"cannot write {output}: the folder {output.parent} does not exist; create it first")
    scene = _cleaned(read_scene(options.input).finite(), options)
    size = save(scene, output, **chosen)
    # What reading the output back would say of it is known here.
    logging.getLogger("nsvq_lightning").setLevel(logging.WARNING)
    each = f", {size / len(scene):.1f} per splat" if len(scene) else ""
    sys.stdout.write(f"{output}: {len(scene):,} splats in {size:,} bytes{each}\n{_errors(scene, output)}")


def _cleaned(scene: CompressedScene, options: argparse.Namespace) -> CompressedScene:
    """The scene within the box, without floaters, turned, in this order."""
    before = len(scene)
    if options.crop is not None:
        scene = cropped(scene, np.array(options.crop[:3]), np.array(options.crop[3:]))
        if len(scene) == 0:
            raise ValueError(f"no splat of {options.input} is in the box {' '.join(map(str, options.crop))}")
        sys.stdout.write(f"crop: {before - len(scene):,} of {before:,} splats are outside\n")
    if options.floaters:
        scene = _without_floaters(scene, options.root)
    if options.up is not None:
        scene = rotated(scene, turn_up(_up(options), options.up))
    return scene.in_use() if len(scene) < before else scene


def _up(options: argparse.Namespace) -> NDArray[np.float64]:
    if options.up_from is None:
        from nsvq_lightning.data.scene import load_scene
        from nsvq_lightning.rendering.camera import up_of

        return up_of(load_scene(options.root).cameras)
    up = np.array(options.up_from)
    length = float(np.linalg.norm(up))
    if not 0 < length < np.inf:
        raise ValueError(f"--up-from {' '.join(map(str, options.up_from))} is no direction")
    return np.asarray(up / length)


def _without_floaters(scene: CompressedScene, root: Path) -> CompressedScene:
    import torch

    from nsvq_lightning.compression.floaters import floaters
    from nsvq_lightning.data.scene import load_scene
    from nsvq_lightning.rendering.rasterize import render
    from nsvq_lightning.report.evaluation import evaluate

    photos = load_scene(root)
    splats = scene.decode().raw()
    look = partial(render, antialiased=scene.antialiased)

    def views() -> Iterator[View]:
        return (photos.view(index) for index in progress(photos.train, "photos"))

    def quality(keep: torch.Tensor) -> str:
        tested = evaluate(
            lambda camera: look(type(splats)(*(t[keep] for t in splats)), camera).image,
            (photos.view(index) for index in photos.test),
            torch.device("cpu"),
        )
        return f"{tested.psnr:.2f} dB"

    removed = floaters(splats, views, look)
    before, after = quality(torch.ones_like(removed)), quality(~removed)
    sys.stdout.write(
        f"floaters: {int(removed.sum()):,} of {len(scene):,} splats; test photos at {before} before, {after} after\n"
    )
    return scene.take((~removed).numpy())


def _errors(scene: CompressedScene, output: Path) -> str:
    """A line with the errors of the values in the file; empty if the format is exact."""
    in_order = FORMATS[output.suffix.lower()].in_order
    if in_order is None:
        return ""
    errors = attribute_errors(read_scene(output), in_order(scene))
    listed = ", ".join(f"{name} {error:.2g}{'°' * (name == 'rotation')}" for name, error in errors.items())
    return f"  root mean square errors: {listed}\n"


def _measure(source: Path, output: Path, root: Path | None) -> None:
    from nsvq_lightning.compression.ladder import MEASURED
    from nsvq_lightning.compression.viewpoints import decibels, picture_error, pictures, views_of

    original = read_scene(source).finite()
    if len(original) == 0:
        raise ValueError(f"{source} holds no finite splat; there is nothing to measure")
    splats = original.decode()
    cameras = views_of(splats, root, MEASURED)
    expected = pictures(splats, cameras, original.antialiased)
    error = picture_error(read_scene(output).decode(), cameras, expected, original.antialiased)
    sys.stdout.write(
        f"  error {error:.4g} ({decibels(error):.2f} dB against {source.name} in {len(cameras)} pictures)\n"
    )


def _parser() -> argparse.ArgumentParser:
    suffixes = ", ".join(FORMATS)
    parser = Parser(
        prog="nsvq convert",
        description="Write a scene file in another format; the suffixes select the formats.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("input", type=Path, metavar="SCENE", help=f"file to read: {suffixes}")
    parser.add_argument("output", type=Path, metavar="OUT", help=f"file to write: {suffixes}")
    parser.add_argument(
        "--palette",
        type=int,
        metavar="ROWS",
        help="largest number of rows of the .sog palette for a scene without an SH codebook; "
        f"{PALETTE_LIMIT} by default, 4096 to 16384 make a smaller file",
    )
    parser.add_argument(
        "--spz-version",
        dest="version",
        type=int,
        choices=SPZ_VERSIONS,
        help=f"version of .spz; {DEFAULT_VERSION} by default, which more viewers support",
    )
    parser.add_argument(
        "--spz-axes",
        dest="axes",
        choices=SPZ_AXES,
        help=f"axes of .spz; {DEFAULT_AXES} by default, those of .ply, as viewers take them",
    )
    parser.add_argument("--level", choices=LEVELS, help="level of .nsvq")
    parser.add_argument("--measure", action="store_true", help="render both files and say how they differ")
    parser.add_argument(
        "--crop",
        nargs=6,
        type=float,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="keep the splats with centres in this box, in scene units of the input",
    )
    parser.add_argument(
        "--floaters", action="store_true", help="remove splats that no photo of --data.root supports; takes minutes"
    )
    parser.add_argument(
        "--up", choices=UP_AXES, help="turn the scene so that up, as the cameras of --data.root hold it, is this axis"
    )
    parser.add_argument(
        "--up-from", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where up is in the input, for --up"
    )
    parser.add_argument(
        "--data.root",
        dest="root",
        type=Path,
        metavar="FOLDER",
        help="scene folder: for --floaters and --up, and for --measure instead of views from around the scene",
    )
    return parser
