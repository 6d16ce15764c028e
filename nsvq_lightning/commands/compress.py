"""Make a splat file small: codebooks by k-means, entropy coding. Photos are not needed.

The error is the root mean square difference between pictures of the scene before and after, for channels in [0, 1]:
0.01 is 40 dB, 0.003 is 50 dB. Pictures are the train views of --data.root, or views from where the scene shows most
detail, as it does where its photos were taken.
Training with photos keeps to the limit: if the trained file misses it, OUT is the untrained file, and the trained one
stays in the folder of the run.

Examples:
  nsvq compress scene.ply scene.nsvq
  nsvq compress scene.ply scene.nsvq --max-error 0.01
  nsvq compress scene.ply scene.nsvq --target-bytes 2000000
  nsvq compress scene.ply scene.nsvq --data.root photos --max-steps 3000     # codebooks trained with the photos
"""

import argparse
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from nsvq_lightning.commands.arguments import positive
from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.nsvq.precision import DEFAULT_LEVEL, LEVELS, Storage

if TYPE_CHECKING:
    from nsvq_lightning.compression.presets import Candidate
    from nsvq_lightning.io.compressed import CompressedScene
    from nsvq_lightning.rendering.camera import Camera

log = logging.getLogger("nsvq_lightning.compress")

SIZES = ("16k", "8k", "4k", "2k", "1k", "0.5k", "128k", "64k", "32k", "none")
DEFAULT_TUNING = 400
# Largest number of views in which a scene is tuned.
VIEWS = 96


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what ``nsvq compress`` takes."""
    add, aim = parser.add_argument, parser.add_mutually_exclusive_group().add_argument
    add("input", type=Path, metavar="SCENE", help="splat file: .ply, .nsvq, .sog, .spz or .splat")
    add("output", type=Path, metavar="OUT.nsvq", help="file to write")
    aim("--codebooks", choices=SIZES, default=SIZES[0], help=f"codebook sizes; {SIZES[0]} by default")
    aim("--max-error", type=positive(float), metavar="E", help="the smallest file with an error of at most E")
    aim("--target-bytes", type=positive(int), metavar="B", help="the best file of at most B bytes")
    add("--level", choices=LEVELS, default=DEFAULT_LEVEL, help=f"{DEFAULT_LEVEL} by default")
    add("--seed", type=int, default=0, help="seed of k-means")
    help_ = "COLMAP folder with the photos: errors are those in its views, and its photos train the codebooks"
    add("--data.root", dest="root", type=Path, metavar="FOLDER", help=help_)
    help_ = "steps that make codebooks, opacities and positions fit the scene's own pictures: "
    help_ += f"{DEFAULT_TUNING} by default, 0 for none"
    add("--tune", type=positive(int, zero=True), default=DEFAULT_TUNING, metavar="N", help=help_)
    help_ = "training iterations: 3000 by default; 0 only measures"
    add("--max-steps", type=positive(int, zero=True), metavar="N", help=help_)


def run(options: argparse.Namespace) -> int:
    """Compress a file.

    Returns:
        0, or the status of a training that has failed.

    Raises:
        argparse.ArgumentError: Options do not go together.
        ValueError: The scene cannot be used, or a limit cannot be met.
        OSError: A file cannot be read or written.
    """
    wrong = ""
    if options.output.suffix.lower() != ".nsvq":
        wrong = f"{options.output}: the compressed scene is a .nsvq file; 'nsvq convert' writes other formats"
    elif options.max_steps is not None and options.root is None:
        wrong = "--max-steps trains with photos: give their COLMAP folder with --data.root"
    elif options.max_steps and options.codebooks == "none":
        wrong = "--max-steps trains codebooks, and there are none with --codebooks=none"
    if wrong:
        raise argparse.ArgumentError(None, wrong)
    from nsvq_lightning.compression.presets import Compressor
    from nsvq_lightning.compression.viewpoints import decibels, views_of
    from nsvq_lightning.io.formats import read_scene
    from nsvq_lightning.io.nsvq.header import with_origin
    from nsvq_lightning.training.run_folder import claim_version

    source: Path = options.input
    scene = read_scene(source).finite()
    if len(scene) == 0:
        raise ValueError(f"{source} holds no finite splat; there is nothing to compress")
    cameras = views_of(scene.decode(), options.root, VIEWS)
    candidate, pictures = _candidate(options, scene, cameras)
    data, error, settings = candidate.data, candidate.error, candidate.preset.name
    options.output.parent.mkdir(parents=True, exist_ok=True)
    trains = options.root is not None and options.max_steps != 0
    if trains and not candidate.preset.codebooks:
        log.info("nothing to train: %s has no codebooks", settings)
    elif trains:
        folder = claim_version(options.output.parent / f"{options.output.stem}_training")
        if status := _train(options, candidate, folder):
            return status
        trained = with_origin((folder / "scene.nsvq").read_bytes(), scene.origin)
        # A new one: keeping the pictures of the original would fill the memory during training.
        found = Compressor(scene, cameras, candidate.storage).error(trained)
        missed = ""
        if options.target_bytes is not None and len(trained) > options.target_bytes:
            missed = f"has {len(trained):,} bytes, more than --target-bytes={options.target_bytes}"
        elif options.max_error is not None and found > options.max_error:
            missed = f"has an error of {found:.4g}, more than --max-error={options.max_error:g}"
        if missed:
            text = "the trained file %s %s: %s is the untrained one; raise the limit for a trained one"
            log.warning(text, folder / "scene.nsvq", missed, options.output)
            settings += ", without training"
        else:
            data, error, settings = trained, found, f"{settings}, trained with photos"
    with atomic_write(options.output) as file:
        file.write(data)
    before, after = source.stat().st_size, len(data)
    sys.stdout.write(
        f"{options.output}: {len(scene):,} splats in {after:,} bytes, {before / after:.1f} times smaller than "
        f"{source.name}\n  {settings}, error {error:.4g} ({decibels(error):.2f} dB against the original in {pictures} "
        "pictures)\n"
    )
    return 0


def _candidate(
    options: argparse.Namespace, scene: "CompressedScene", cameras: "list[Camera]"
) -> "tuple[Candidate, int]":
    """The scene as the options ask for it, and the number of pictures in which its error was measured."""
    from nsvq_lightning.compression import presets

    compressor = presets.Compressor(scene, cameras, Storage(options.level), options.seed, options.tune)
    if options.max_error is not None:
        candidate = presets.smallest_within(compressor, options.max_error)
    elif options.target_bytes is not None:
        candidate = presets.finest_within(compressor, options.target_bytes)
    else:
        named = {preset.name: preset for preset in presets.PRESETS} | {"none": presets.PLAIN}
        candidate = compressor.at(named[options.codebooks])
    return candidate, len(compressor.cameras)


def _train(options: argparse.Namespace, candidate: "Candidate", folder: Path) -> int:
    """Train the candidate's codebooks with photos: only the quantize and fine-tune phases, from the given splats.

    Returns:
        Exit status of ``nsvq fit``, which writes a run into ``folder``.
    """
    from nsvq_lightning.commands.main import main

    codebooks = ", ".join(f"{name}: {codes}" for name, codes in candidate.preset.codebooks.items())
    return main(
        [
            "fit",
            "--config=paper",
            f"--data.root={options.root}",
            f"--model.init_from={options.input}",
            f"--model.sh_degree={candidate.scene.sh_degree}",
            f"--model.codebooks={{{codebooks}}}",
            "--model.quantizer=TrainedStraightThrough",
            "--model.rates.means=1.6e-6",  # the rate of a trained scene has already decayed
            f"--model.antialiased={str(candidate.scene.antialiased).lower()}",
            f"--model.seed={options.seed}",
            f"--model.storage.level={candidate.storage.level}",
            *(f"--model.storage.precision.{name}={n}" for name, n in vars(candidate.storage.precision).items()),
            "--callbacks.phases.warmup_end=0",
            "--callbacks.phases.prune_end=0",
            "--callbacks.canonical=CanonicalCovariance",
            "--callbacks.codebook_init.weights=contribution",
            "--callbacks.export.formats=[nsvq]",
            f"--trainer.max_steps={3000 if options.max_steps is None else options.max_steps}",
            f"--trainer.run_folder={folder}",
        ]
    )
