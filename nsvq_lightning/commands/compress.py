"""``nsvq compress``: make an existing splat file small, without photos or fine-tuned with them."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nsvq_lightning.commands.arguments import Parser, positive
from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.nsvq.precision import DEFAULT_LEVEL, LEVELS, Storage

if TYPE_CHECKING:
    from nsvq_lightning.compression.ladder import Candidate
    from nsvq_lightning.io.compressed import CompressedScene
    from nsvq_lightning.rendering.camera import Camera

__all__ = ["main"]

log = logging.getLogger("nsvq_lightning.compress")

DEFAULT_CODEBOOKS = "16k"
DEFAULT_TUNING = 400
VIEWS = 96
"""Largest number of views in which a scene is tuned."""

EPILOG = """\
The error is the root mean square difference between pictures of the scene before and after, for channels in [0, 1]:
0.01 is 40 dB, 0.003 is 50 dB. Pictures are the train views of --data.root, or views from where the scene shows most
detail, as it does where its photos were taken.
Training with photos keeps to the limit: if the trained file misses it, OUT is the untrained file, and the trained one
stays in the folder of the run.

examples:
  nsvq compress scene.ply scene.nsvq
  nsvq compress scene.ply scene.nsvq --max-error 0.01
  nsvq compress scene.ply scene.nsvq --target-bytes 2000000
  nsvq compress scene.ply scene.nsvq --data.root photos --max-steps 3000     # codebooks trained with the photos
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Compress a file.

    Args:
        argv: Arguments after ``nsvq compress``; those of the process if None.

    Returns:
        0, or 1 after an error in the user's files or a limit that cannot be met. Wrong arguments end the process
        with status 2.
    """
    parser = _parser()
    options = parser.parse_args(argv)
    if options.output.suffix.lower() != ".nsvq":
        parser.error(f"{options.output}: the compressed scene is a .nsvq file; 'nsvq convert' writes other formats")
    if options.max_steps is not None and options.root is None:
        parser.error("--max-steps trains with photos: give their COLMAP folder with --data.root")
    if options.max_steps is not None and options.max_steps < 0:
        parser.error(f"--max-steps must be at least 0, got {options.max_steps}")
    if options.tune < 0:
        parser.error(f"--tune must be at least 0, got {options.tune}")
    if options.max_steps and options.codebooks == "none":
        parser.error("--max-steps trains codebooks, and there are none with --codebooks=none")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("nsvq_lightning").setLevel(logging.INFO)
    try:
        return _compress(options)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"nsvq compress: {error}\n")
        return 1


@dataclass(frozen=True)
class Result:
    """A compressed file.

    Attributes:
        settings: How it was made, for the user.
        data: Its bytes.
        error: Root mean square difference between its pictures and those of the original, for channels in [0, 1].
    """

    settings: str
    data: bytes
    error: float


def _compress(options: argparse.Namespace) -> int:
    from nsvq_lightning.compression.ladder import Compressor
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
    options.output.parent.mkdir(parents=True, exist_ok=True)
    result = Result(candidate.rung.name, candidate.data, candidate.error)
    if options.root is not None and options.max_steps != 0:
        if not candidate.rung.codebooks:
            log.info("nothing to train: %s has no codebooks", candidate.rung.name)
        else:
            folder = claim_version(options.output.parent / f"{options.output.stem}_training")
            status = _train(options, candidate, folder)
            if status != 0:
                return status
            path = folder / "scene.nsvq"
            data = with_origin(path.read_bytes(), scene.origin)
            # A new one: keeping the pictures of the original would fill the memory during training.
            error = Compressor(scene, cameras, candidate.storage).error(data)
            result = _within_aim(options, result, Result(f"{result.settings}, trained with photos", data, error), path)
    with atomic_write(options.output) as file:
        file.write(result.data)
    before, after = source.stat().st_size, len(result.data)
    sys.stdout.write(
        f"{options.output}: {len(scene):,} splats in {after:,} bytes, {before / after:.1f} times smaller than "
        f"{source.name}\n  {result.settings}, error {result.error:.4g} ({decibels(result.error):.2f} dB against the "
        f"original in {pictures} pictures)\n"
    )
    return 0


def _within_aim(options: argparse.Namespace, untrained: Result, trained: Result, path: Path) -> Result:
    """The trained file, read from ``path``, unless it misses the limit that the untrained one meets."""
    if options.target_bytes is not None and len(trained.data) > options.target_bytes:
        missed = f"has {len(trained.data):,} bytes, more than --target-bytes={options.target_bytes}"
    elif options.max_error is not None and trained.error > options.max_error:
        missed = f"has an error of {trained.error:.4g}, more than --max-error={options.max_error:g}"
    else:
        return trained
    log.warning(
        "the trained file %s %s: %s is the untrained one; raise the limit for a trained one",
        *(path, missed, options.output),
    )
    return replace(untrained, settings=f"{untrained.settings}, without training")


def _candidate(options: argparse.Namespace, scene: CompressedScene, cameras: list[Camera]) -> tuple[Candidate, int]:
    """The scene as the options ask for it, and the number of pictures in which its error was measured."""
    from nsvq_lightning.compression.ladder import LADDER, PLAIN, Compressor, finest_within, smallest_within

    compressor = Compressor(scene, cameras, Storage(options.level), options.seed, options.tune)
    if options.max_error is not None:
        candidate = smallest_within(compressor, options.max_error)
    elif options.target_bytes is not None:
        candidate = finest_within(compressor, options.target_bytes)
    else:
        candidate = compressor.at(({rung.name: rung for rung in LADDER} | {"none": PLAIN})[options.codebooks])
    return candidate, compressor.pictures


def _train(options: argparse.Namespace, candidate: Candidate, folder: Path) -> int:
    """Train the candidate's codebooks with photos: only the quantize and fine-tune phases, from the given splats.

    Returns:
        Exit status of ``nsvq fit``, which writes a run into ``folder``.
    """
    from nsvq_lightning.commands.main import main as run
    from nsvq_lightning.compression.importance import INVISIBLE

    steps = 3000 if options.max_steps is None else options.max_steps
    precision = vars(candidate.storage.precision)
    codebooks = ", ".join(f"{name}: {codes}" for name, codes in candidate.rung.codebooks.items())
    return run(
        [
            "fit",
            f"--data.root={options.root}",
            f"--model.init_from={options.input}",
            f"--model.sh_degree={candidate.scene.sh_degree}",
            f"--model.codebooks={{{codebooks}}}",
            "--model.quantizer=TrainedStraightThrough",
            "--model.quantizer.start=spread",
            "--model.rates.means=1.6e-6",  # the rate of a trained scene has already decayed
            f"--model.antialiased={str(candidate.scene.antialiased).lower()}",
            f"--model.seed={options.seed}",
            f"--model.storage.level={candidate.storage.level}",
            *(f"--model.storage.precision.{name}={value}" for name, value in precision.items()),
            "--callbacks.phases.warmup_end=0",
            "--callbacks.phases.prune_end=0",
            "--callbacks.canonical.mode=auto",
            f"--callbacks.canonical.floor={INVISIBLE}",
            "--callbacks.codebook_init.weights=contribution",
            "--callbacks.export.formats=[nsvq]",
            f"--trainer.max_steps={steps}",
            f"--trainer.run_folder={folder}",
        ]
    )


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsvq compress",
        description="Make a splat file small: codebooks by k-means, entropy coding. Photos are not needed.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("input", type=Path, metavar="SCENE", help="splat file: .ply, .nsvq, .sog, .spz or .splat")
    parser.add_argument("output", type=Path, metavar="OUT.nsvq", help="file to write")
    aim = parser.add_mutually_exclusive_group()
    names = ("16k", "8k", "4k", "2k", "1k", "0.5k", "128k", "64k", "32k", "none")
    aim.add_argument(
        "--codebooks", choices=names, default=DEFAULT_CODEBOOKS, help=f"codebook sizes; {DEFAULT_CODEBOOKS} by default"
    )
    aim.add_argument(
        "--max-error", type=positive(float), metavar="E", help="the smallest file with an error of at most E"
    )
    aim.add_argument("--target-bytes", type=positive(int), metavar="B", help="the best file of at most B bytes")
    parser.add_argument("--level", choices=LEVELS, default=DEFAULT_LEVEL, help=f"{DEFAULT_LEVEL} by default")
    parser.add_argument("--seed", type=int, default=0, help="seed of k-means")
    parser.add_argument(
        "--data.root",
        dest="root",
        type=Path,
        metavar="FOLDER",
        help="COLMAP folder with the photos: errors are those in its views, and its photos train the codebooks",
    )
    parser.add_argument(
        "--tune",
        type=int,
        default=DEFAULT_TUNING,
        metavar="N",
        help=f"steps that make codebooks, opacities and positions fit the scene's own pictures: {DEFAULT_TUNING} by "
        "default, 0 for none",
    )
    parser.add_argument(
        "--max-steps", type=int, metavar="N", help="training iterations: 3000 by default; 0 only measures"
    )
    return parser
