"""``nsvq convert``: write a scene file in another format, for viewers."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.io.attribute_error import attribute_errors
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import FORMATS, read_scene, save
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.io.sog import PALETTE_LIMIT
from nsvq_lightning.io.spz import DEFAULT_VERSION
from nsvq_lightning.io.spz_frame import SPZ_VERSIONS

__all__ = ["main"]

_OPTIONS = {"level": ("--level", ".nsvq"), "palette": ("--palette", ".sog"), "version": ("--spz-version", ".spz")}
"""Options of writers: their flag here, and their format."""

EPILOG = """\
The codebooks of a .nsvq file are used as the palette of .sog, and to make .spz smaller. To make a .ply small, with
codebooks fitted to it, use 'nsvq compress'.

examples:
  nsvq convert scene.nsvq scene.sog
  nsvq convert scene.ply scene.sog --palette 4096
  nsvq convert scene.ply scene.spz --measure
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
    if options.root is not None and not options.measure:
        parser.error("--data.root says where to measure: add --measure")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("nsvq_lightning").setLevel(logging.INFO)
    if "level" in chosen:
        chosen["storage"] = Storage(chosen.pop("level"))
    try:
        _convert(options.input, options.output, chosen)
        if options.measure:
            _measure(options.input, options.output, options.root)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"nsvq convert: {error}\n")
        return 1
    return 0


def _convert(source: Path, output: Path, options: dict[str, Any]) -> None:
    scene = read_scene(source).finite()
    output.parent.mkdir(parents=True, exist_ok=True)
    size = save(scene, output, **options)
    each = f", {size / len(scene):.1f} per splat" if len(scene) else ""
    sys.stdout.write(f"{output}: {len(scene):,} splats in {size:,} bytes{each}\n{_errors(scene, output)}")


def _errors(scene: CompressedScene, output: Path) -> str:
    """A line with the errors of the values in the file; empty if the format is exact."""
    in_order = FORMATS[output.suffix.lower()].in_order
    if in_order is None:
        return ""
    errors = attribute_errors(read_scene(output).arrays(), in_order(scene).arrays())
    listed = ", ".join(f"{name} {error:.2g}{'°' * (name == 'rotation')}" for name, error in errors.items())
    return f"  root mean square errors: {listed}\n"


def _measure(source: Path, output: Path, root: Path | None) -> None:
    from nsvq_lightning.compression.ladder import MEASURED
    from nsvq_lightning.compression.pictures import decibels, picture_error, pictures
    from nsvq_lightning.compression.viewpoints import views_of

    original = read_scene(source).finite()
    if len(original) == 0:
        raise ValueError(f"{source} holds no finite splat; there is nothing to measure")
    splats = original.decode()
    cameras = views_of(splats, root, MEASURED)
    error = picture_error(read_scene(output).decode(), cameras, pictures(splats, cameras))
    sys.stdout.write(
        f"  error {error:.4g} ({decibels(error):.2f} dB against {source.name} in {len(cameras)} pictures)\n"
    )


def _parser() -> argparse.ArgumentParser:
    suffixes = ", ".join(FORMATS)
    parser = argparse.ArgumentParser(
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
    parser.add_argument("--level", choices=LEVELS, help="level of .nsvq")
    parser.add_argument("--measure", action="store_true", help="render both files and say how they differ")
    parser.add_argument(
        "--data.root",
        dest="root",
        type=Path,
        metavar="FOLDER",
        help="measure in the train views of a COLMAP folder instead of views from around the scene",
    )
    return parser
