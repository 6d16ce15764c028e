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

from argparse import ArgumentError, ArgumentParser, Namespace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from nsvq_lightning.commands import say
from nsvq_lightning.commands.arguments import add_root, known_views, trained_scene, views_of
from nsvq_lightning.commands.compress import share_or_number, splats_left
from nsvq_lightning.io import formats, lod, placing, spz
from nsvq_lightning.io.compressed import CompressedScene, on_white, renderer
from nsvq_lightning.io.nsvq.precision import LEVELS
from nsvq_lightning.io.sog import PALETTE_LIMIT
from nsvq_lightning.splats.conventions import Float64s
from nsvq_lightning.top_level import log


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq convert`` takes."""
    add = parser.add_argument
    add("inputs", nargs="+", type=Path, metavar="SCENE", help=f"files to read and join: {', '.join(formats.FORMATS)}")
    add("output", type=Path, metavar="OUT", help="file to write, of one of these formats")
    help_ = "largest number of rows of the .sog palette, also of an SH codebook; "
    help_ += f"{PALETTE_LIMIT} by default, 4096 to 16384 make a smaller file"
    add("--palette", type=int, metavar="ROWS", help=help_)
    help_ = f"version of .spz; {spz.DEFAULT_VERSION} by default, which more viewers support"
    add("--spz-version", type=int, choices=spz.SPZ_VERSIONS, help=help_)
    help_ = f"axes of .spz; {spz.DEFAULT_AXES} by default, those of .ply, as viewers take them"
    add("--spz-axes", choices=spz.SPZ_AXES, help=help_)
    add("--level", choices=LEVELS, help="level of .nsvq")
    add("--measure", action="store_true", help="render both files and say how they differ")
    help_ = "keep the splats with centres in this box, in scene units of the input"
    add("--crop", nargs=6, type=float, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"), help=help_)
    add("--floaters", action="store_true", help="remove splats that no photo of --data.root supports; takes minutes")
    help_ = "keep so many splats, or this share of them: those that contribute most to its pictures"
    add("--splats", type=share_or_number, metavar="N", help=help_)
    add("--sh-degree", type=int, choices=range(4), help="keep spherical harmonics up to this degree")
    turn = parser.add_mutually_exclusive_group().add_argument
    help_ = "turn the scene so that up, as the cameras of --data.root hold it, is this axis"
    turn("--up", choices=placing.UP_AXES, help=help_)
    help_ = "turn, scale and move the scene: the upper three rows of a matrix, from old to new coordinates"
    turn("--matrix", nargs=12, type=float, metavar=tuple("ABCDEFGHIJKL"), help=help_)
    help_ = "move the scene so that the cameras of --data.root are where those of this scene folder are, by photo name"
    turn("--align", type=Path, metavar="FOLDER", help=help_)
    add("--up-from", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where up is, for --up; mostly 0 -1 0")
    add_root(parser, "scene folder for --floaters, --up, --align; for --measure, --splats in place of its own pictures")


def run(options: Namespace) -> None:
    """Convert a file.

    Raises:
        ArgumentError: Options do not go together.
        ValueError: A file cannot be understood, or nothing is left of the scene.
        OSError: A file cannot be read or written.
    """
    if wrong := _contradiction(options):
        raise ArgumentError(None, wrong)
    output = options.output
    # Now, not after the minutes that floaters take.
    entry = formats.format_of(output)
    if not output.parent.is_dir() and formats.suffix_of(output) != lod.NAME:
        raise FileNotFoundError(f"cannot write {output}: the folder {output.parent} does not exist; create it first")
    # Other formats keep no cameras.
    read = [trained_scene(path, options.root) if entry.native else formats.read_scene(path) for path in options.inputs]
    scene = _edited(CompressedScene.joined(read), options)
    writer = {"palette": options.palette, "version": options.spz_version, "axes": options.spz_axes}
    given = {name: value for name, value in writer.items() if value is not None}
    size = formats.save(scene, output, options.level, **given)
    say(f"{output}: {len(scene):,} splats in {size:,} bytes, {size / len(scene):.1f} per splat")
    if options.measure:
        # What reading the files again would say of them is known here.
        log.setLevel("WARNING")
        _measure(options.inputs[0], output, options.root)


# Formats that have an option of the writer; the first is named where another one is given.
WRITER_OPTIONS = {"level": (".nsvq",), "palette": (".sog", lod.NAME), "spz_version": (".spz",), "spz_axes": (".spz",)}


def _contradiction(options: Namespace) -> str:
    """Why options do not go together; empty if they do."""
    moves = options.up or options.matrix or options.align
    uses_photos = options.measure or options.floaters or options.up or options.align or options.splats
    if options.up_from and not options.up:
        return "--up-from says where up is: add --up to say what it is to become"
    if options.floaters and not options.root:
        return "--floaters asks the photos: add --data.root"
    if options.align and not options.root:
        return "--align moves the cameras of a scene folder: add --data.root"
    if options.up and not (options.up_from or options.root):
        return "--up needs to know where up is now: add --data.root or --up-from (0 -1 0 in most files)"
    if options.root and not uses_photos and formats.suffix_of(options.output) != ".nsvq":
        return "--data.root says where to measure: add --measure"
    if options.measure and (moves or options.crop or options.floaters or options.splats or len(options.inputs) > 1):
        return "--measure compares with the input as it is: convert without it first"
    if options.measure and options.output.exists() and options.output.samefile(options.inputs[0]):
        return "--measure compares with the input, which would be overwritten: name another output"
    if len(options.inputs) > 1 and options.output.is_file():
        return f"{options.output} exists, and may be one of those to be joined: name another output, or remove it"
    if options.splats and len(options.inputs) > 1:
        return "--splats asks the pictures of one scene: thin each scene before they are joined"
    for name, suffixes in WRITER_OPTIONS.items():
        if getattr(options, name) is not None and formats.suffix_of(options.output) not in suffixes:
            return f"--{name.replace('_', '-')} is an option of {suffixes[0]} files, but the output is {options.output}"
    return ""


def _edited(scene: CompressedScene, options: Namespace) -> CompressedScene:
    """The scene within the box, without floaters, thinned, turned and moved, up to a degree, in this order."""
    before = len(scene)
    if options.crop:
        scene = placing.cropped(scene, np.array(options.crop[:3]), np.array(options.crop[3:]))
        if len(scene) == 0:
            named = ", ".join(map(str, options.inputs))
            raise ValueError(f"no splat of {named} is in the box {' '.join(map(str, options.crop))}")
        say(f"crop: {before - len(scene):,} of {before:,} splats are outside")
    if options.floaters:
        scene = _without_floaters(scene, options.root)
    left = splats_left(options.splats, len(scene))
    if left < len(scene):
        from nsvq_lightning.compression.viewpoints import VIEWS
        from nsvq_lightning.random import top_rows
        from nsvq_lightning.training.importance import contributions

        cameras = views_of(options.inputs[0], scene, VIEWS, options.root)
        scene = scene.take(top_rows(contributions(scene.tensors(), cameras, renderer(scene)), left).numpy())
    if options.up:
        scene = placing.rotated(scene, placing.turn_up(_up(options), options.up))
    if options.matrix:
        scene = placing.moved(scene, np.reshape(options.matrix, (3, 4)))
    if options.align:
        from nsvq_lightning.data.colmap import alignment
        from nsvq_lightning.data.transforms import read_poses

        scene = placing.moved(scene, alignment(read_poses(options.root), read_poses(options.align)))
    if options.sh_degree is not None and options.sh_degree < scene.sh_degree:
        scene = scene.with_degree(options.sh_degree)
    return scene.in_use() if len(scene) < before else scene


def _up(options: Namespace) -> Float64s:
    """Where up is in the input, a unit vector ``[3]``."""
    if options.up_from is None:
        from nsvq_lightning.rendering.poses import up_of

        return up_of(list(known_views(options.inputs[0], options.root)[0].values()))
    up = np.array(options.up_from)
    length = float(np.linalg.norm(up))
    if not 0 < length < np.inf:
        raise ValueError(f"--up-from {' '.join(map(str, options.up_from))} is no direction")
    return up / length


def _without_floaters(scene: CompressedScene, root: Path) -> CompressedScene:
    import torch

    from nsvq_lightning.data.scene import check_cameras, check_colors, load_scene, usable
    from nsvq_lightning.report.numbers import evaluate
    from nsvq_lightning.training.importance import floaters

    photos = usable(load_scene(root, origin=scene.origin))
    check_cameras(photos.cameras, scene.means, scene.cameras)
    check_colors(photos, scene.means, scene.values("sh0"))
    splats = scene.tensors()
    look = renderer(on_white(scene) if photos.white else scene)

    def psnr(keep: torch.Tensor) -> float:
        return evaluate(look, splats.take(keep), map(photos.view, photos.test))[0]

    removed = floaters(splats, lambda: map(photos.view, tqdm(photos.train, unit=" photos", mininterval=1)), look)
    before, after = psnr(torch.ones_like(removed)), psnr(~removed)
    count = int(removed.sum())
    say(f"floaters: {count:,} of {len(scene):,} splats; test photos at {before:.2f} dB before, {after:.2f} dB after")
    return scene.take((~removed).numpy())


def _measure(source: Path, output: Path, root: Path | None) -> None:
    """Say how pictures of two files differ."""
    from nsvq_lightning.compression.viewpoints import MEASURED, Measure

    original = formats.read_scene(source)
    measure = Measure(original.tensors(), views_of(source, original, MEASURED, root), renderer(original))
    written = formats.read_scene(output)
    if formats.suffix_of(output) == ".glb":  # which may have its origin in its positions
        written = written.relative_to(original.origin)
    say(f"  {measure.told(measure.error(written.tensors()), source.name)}")
