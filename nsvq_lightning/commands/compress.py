"""Make a splat file small: codebooks, and fewer splats, fitted to the scene's own pictures.

Pictures are those from where the scene shows detail, or the train photos of --data.root, or of the run it lies in.
The error is the root mean square difference of pictures before and after, for channels in [0, 1]: 0.01 is 40 dB.

Examples:
  nsvq compress scene.ply scene.nsvq
  nsvq compress scene.ply scene.nsvq --target-bytes 2000000 --splats 50%
  nsvq compress scene.ply scene.nsvq --max-error 0.01 --data.root photos
  nsvq compress scene.ply www/lod-meta.json --levels 4
"""

import re
import sys
from argparse import ArgumentError, ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from nsvq_lightning.commands import say
from nsvq_lightning.commands.arguments import add_root, positive, scene_with_views
from nsvq_lightning.io.atomic import make_folder_of, write_bytes
from nsvq_lightning.io.formats import FORMATS, read_scene, save, suffix_of
from nsvq_lightning.io.lod import NAME
from nsvq_lightning.io.nsvq.precision import DEFAULT_LEVEL, LEVELS, Storage
from nsvq_lightning.splats.attributes import DEFAULT_SIZE, SIZES

if TYPE_CHECKING:
    from nsvq_lightning.compression.compressor import Compressor

LOD_LEVELS = 3


def share_or_number(text: str) -> int | float:
    """``25%`` as 0.25, ``50000`` as it is, an integer.

    Raises:
        ArgumentTypeError: It is neither.
    """
    if match := re.fullmatch(r"(\d+(?:\.\d+)?)(%?)", text):
        value = float(match[1])
        if match[2] and 0 < value <= 100:
            return value / 100
        if not match[2] and value >= 1 and value.is_integer():
            return int(value)
    raise ArgumentTypeError(f"expected a number of splats, or a share such as 25%, got {text!r}")


def splats_left(asked: int | float | None, count: int) -> int:
    """How many of ``count`` splats a result of :func:`share_or_number` leaves; all if it is None."""
    if asked is None:
        return count
    return min(count, max(1, asked if isinstance(asked, int) else round(asked * count)))


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq compress`` takes."""
    add = parser.add_argument
    aim = parser.add_mutually_exclusive_group().add_argument
    add("input", type=Path, metavar="SCENE", help=f"splat file: {', '.join(FORMATS)}")
    add("output", type=Path, metavar="OUT.nsvq", help=f"file to write; {NAME} for a streamed SOG")
    aim("--codebooks", choices=(*SIZES, "none"), help=f"codebook sizes; {DEFAULT_SIZE} by default")
    aim("--max-error", type=positive(float), metavar="E", help="the smallest file with an error of at most E")
    aim("--target-bytes", type=positive(int), metavar="B", help="the best file of at most B bytes")
    help_ = "how many splats are left, or which share of them; all by default"
    add("--splats", type=share_or_number, metavar="N", help=help_)
    help_ = f"levels of detail of {NAME}, each with a quarter of the splats of the one before; {LOD_LEVELS} by default"
    aim("--levels", type=positive(int), metavar="N", help=help_)
    add("--level", choices=LEVELS, default=DEFAULT_LEVEL, help="%(default)s by default")
    add("--seed", type=int, default=0, help="seed of all draws")
    add_root(parser, "scene folder with the photos: splats and codebooks are fitted to its train photos")
    help_ = "steps of a training; 500, or 1500 with fewer splats, if they fit into --minutes"
    add("--steps", type=positive(int), metavar="N", help=help_)
    help_ = "what steps of one training may take, about, of a million splats if there are more; %(default)g by default"
    add("--minutes", type=positive(float), default=2.0, metavar="M", help=help_)


def run(options: Namespace) -> int:
    """Compress a file.

    Returns:
        0, or 130 where Ctrl-C has ended a training early.

    Raises:
        ArgumentError: Options do not go together.
        ValueError: The scene cannot be used, or a limit cannot be met.
        OSError: A file cannot be read or written.
    """
    streamed = suffix_of(options.output) == NAME
    wrong = ""
    if not streamed and suffix_of(options.output) != ".nsvq":
        wrong = f"{options.output}: the result is a .nsvq file or {NAME}; 'nsvq convert' writes other formats"
    elif streamed and (options.codebooks or options.max_error or options.target_bytes or options.level != LEVELS[0]):
        wrong = f"{NAME} has levels of detail (--levels), no codebooks and no limits, and one --level"
    elif options.output.is_dir():
        wrong = f"{options.output} is a folder: name a file"
    elif options.levels and not streamed:
        wrong = f"--levels is for {NAME}, but the output is {options.output}"
    if wrong:
        raise ArgumentError(None, wrong)
    scene, cameras, photos = scene_with_views(read_scene(options.input), options.input, options.root)
    most = splats_left(options.splats, len(scene))
    from nsvq_lightning.compression.compressor import Compressor

    make_folder_of(options.output)  # now, not after the training
    given = [] if photos else cameras
    compressor = Compressor(scene, given, photos, Storage(options.level), options.seed, options.minutes, options.steps)
    if streamed:
        _write_levels(options, compressor, most)
    else:
        _write_file(options, compressor, most, "its own pictures" if photos is None else f"the photos of {photos.root}")
    return 130 if compressor.stopped else 0


def _write_levels(options: Namespace, compressor: "Compressor", most: int) -> None:
    """Write a streamed SOG of levels of detail, the finest of ``most`` splats."""
    from nsvq_lightning.compression.compressor import Setting

    scene = compressor.scene
    # Where there are few, the last levels would be alike.
    wanted = dict.fromkeys(max(1, most // 4**level) for level in range(options.levels or LOD_LEVELS))
    levels = [scene if count == len(scene) else compressor.at(Setting(count, "none")).scene for count in wanted]
    size = save(levels[0], options.output, coarser=levels[1:])
    say(f"{options.output}: levels of {', '.join(f'{len(level):,}' for level in levels)} splats, {size:,} bytes")


def _write_file(options: Namespace, compressor: "Compressor", most: int, views: str) -> None:
    """Write the ``.nsvq`` file of at most ``most`` splats that is asked for."""
    measure = compressor.measure  # refuses a scene that shows nothing, before it is trained
    candidate = compressor.best(most, options.codebooks, options.target_bytes, options.max_error)
    write_bytes(options.output, candidate.data)
    before, after = compressor.scene.stored_bytes or 0, len(candidate.data)
    sizes = candidate.setting.codebooks
    books = "no codebooks" if sizes == "none" else f"codebooks {sizes}"
    error = measure.told(compressor.error(candidate), "the original")
    say(
        f"{options.output}: {len(candidate.scene):,} of {len(compressor.scene):,} splats in {after:,} bytes, "
        f"{before / after:.1f} times smaller than {options.input.name}",
        f"  {books}, fitted to {views}, {error}",
    )
    if compressor.stopped:
        sys.stderr.write(f"Ctrl-C ended the training early: {options.output} holds what it had reached\n")
