"""``nsvq prepare``: from photos or a video to a scene that can be trained."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsvq_lightning.commands.arguments import Parser, positive
from nsvq_lightning.commands.progress import Progress

if TYPE_CHECKING:
    from nsvq_lightning.data.reconstruct import Verdict

__all__ = ["main"]

RECORD = "prepare.json"
"""File that shows that a folder was made by this command, and from what."""
MADE = ("images", "sparse", "mapping", "database.db", "database.db-shm", "database.db-wal", RECORD)
"""What this command makes in a scene."""
FRAMES = 150
MAX_SIZE = 1600
FEW = 20
"""Photos below which a scene is likely to look good only from where they were taken."""
LARGE_ERROR = 1.5
"""Reprojection error in pixels from which poses are worth a second look."""
BLURRED = 0.3
"""Share of the median sharpness below which a photo is called blurred."""
LISTED = 8
"""Photos that are named at most."""

EPILOG = """\
Photos: 50 to 300, sharp, each overlapping the next by two thirds, zoom and exposure locked; they may lie in
SCENE/images already. Of a video, the sharpest frames are taken, evenly spread. An interrupted run is continued by the
same command.

examples:
  nsvq prepare photos/ scenes/garden
  nsvq prepare walk.mp4 scenes/garden --frames 200
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Prepare a scene.

    Args:
        argv: Arguments after ``nsvq prepare``; those of the process if None.

    Returns:
        0, or 1 if the photos do not make a scene. Wrong arguments end the process with status 2.
    """
    options = _parser().parse_args(argv)
    try:
        return _prepare(options)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"nsvq prepare: {error}\n")
        return 1


def _prepare(options: argparse.Namespace) -> int:
    from nsvq_lightning.data.frames import VIDEOS, photos_in
    from nsvq_lightning.data.reconstruct import reconstruct

    source, scene = options.source, options.scene
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file or folder of photos")
    is_video = source.is_file() and source.suffix.lower() in VIDEOS
    if source.is_file() and not is_video:
        raise ValueError(f"{source}: neither a folder of photos nor a video ({', '.join(VIDEOS)})")
    _claim(options, is_video)
    images = scene / "images"
    if is_video:
        _take_frames(source, images, options.frames)
    elif not _in_place(source, scene):
        _take_photos(source, images)
    names = [path.name for path in photos_in(images)]
    if len(names) < 2:
        raise ValueError(f"{source}: {len(names)} pictures are too few; a scene takes 50 to 300")
    verdict = reconstruct(scene, names, _Steps().report, is_video, options.max_size, options.threads)
    sys.stdout.write(_told(verdict, images))
    return _check(scene)


def _claim(options: argparse.Namespace, is_video: bool) -> None:
    """Take the folder of the scene; what another preparation has left in it is continued."""
    scene: Path = options.scene
    record = {"source": str(options.source.resolve()), "max_size": options.max_size}
    if is_video:
        record["frames"] = options.frames
    path, own = scene / RECORD, {"images"} if _in_place(options.source, scene) else set()
    if path.is_file() and not options.again:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found != record:
            raise ValueError(f"{scene} was prepared from {found.get('source')} or with other options: add --again")
    elif scene.is_dir() and not path.is_file() and {each.name for each in scene.iterdir()} - own:
        raise ValueError(f"{scene} is not empty and was not made by this command: name a new folder")
    if options.again and path.is_file():
        for name in set(MADE) - own:
            target = scene / name
            shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
    (scene / "images").mkdir(parents=True, exist_ok=True)
    from nsvq_lightning.io.atomic import write_text

    write_text(path, json.dumps(record, indent=2) + "\n")


def _in_place(source: Path, scene: Path) -> bool:
    """Whether the photos lie where the scene has them."""
    return source.resolve() == (scene / "images").resolve()


def _take_frames(video: Path, images: Path, count: int) -> None:
    from nsvq_lightning.data.frames import frame_count, write_frames

    if any(images.iterdir()) and (images.parent / "database.db").exists():
        return  # the frames were complete before features were looked for
    for old in images.iterdir():
        old.unlink()
    total = frame_count(video)
    shown = Progress(total, "choosing frames")
    chosen = write_frames(video, images, count, shown.show)
    sys.stdout.write(f"{len(chosen)} sharp frames of {total:,}\n")


def _take_photos(folder: Path, images: Path) -> None:
    from nsvq_lightning.data.frames import copy_photos, photos_in

    photos = photos_in(folder)
    damaged = copy_photos(photos, images, Progress(len(photos), "copying photos").show)
    for path, reason in damaged:
        sys.stdout.write(f"left out: {path.name} cannot be read ({reason})\n")


class _Steps:
    """Shows one step after another."""

    def __init__(self) -> None:
        self._step = ""
        self._shown: Any = None

    def report(self, step: str, done: int, total: int) -> None:
        """Say how much of a step is done."""
        if step != self._step:
            self._step, self._shown = step, Progress(total, step)
        self._shown.show(done)


def _told(verdict: Verdict, images: Path) -> str:
    """What came out, and what to take again."""
    count, total = len(verdict.registered), len(verdict.registered) + len(verdict.missing)
    lines = [
        f"{count} of {total} photos have found their place, {verdict.points:,} points, seen by {verdict.track:.1f} "
        f"photos each, error {verdict.error:.2f} pixels"
    ]
    if verdict.error > LARGE_ERROR:
        lines.append("  the error is large: was zoom or focus changing, or something moving?")
    if count < FEW:
        lines.append(f"  {count} photos are few: 50 and more make a scene that can be walked around")
    if verdict.models > 1:
        lines.append(
            f"  the photos fall apart into {verdict.models} scenes; sparse/0 is the largest: take more photos between"
        )
    if verdict.missing:
        lines += _missing(verdict, images)
    return "\n".join(lines) + "\n"


def _missing(verdict: Verdict, images: Path) -> list[str]:
    from nsvq_lightning.data.frames import sharpness
    from nsvq_lightning.data.images import read_image

    shown = verdict.registered[:: max(1, len(verdict.registered) // FEW)]
    usual = sorted(sharpness(read_image(images / name)) for name in shown)[len(shown) // 2]
    lines = ["  without a place, better taken again:"]
    for name, partners in list(verdict.missing.items())[:LISTED]:
        blurred = sharpness(read_image(images / name)) < BLURRED * usual
        reason = (
            "blurred" if blurred else f"shares enough with {partners} other photos" if partners else "overlaps no other"
        )
        lines.append(f"    {name}: {reason}")
    if len(verdict.missing) > LISTED:
        lines.append(f"    and {len(verdict.missing) - LISTED} more")
    return lines


def _check(scene: Path) -> int:
    """The doctor's checks of the folder, and what to type next."""
    from nsvq_lightning.commands.doctor import check_folder

    sys.stdout.write("\n")
    problems = 0
    for finding in check_folder(scene):
        problems += finding.verdict == "problem"
        sys.stdout.write(f"{finding}\n")
        sys.stdout.flush()
    if not problems:
        sys.stdout.write(f"\nnext: nsvq fit --config fast.yaml --data.root {scene}\n")
    return 1 if problems else 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsvq prepare",
        description="Find out where photos were taken from, by COLMAP, and make a scene of them that can be trained.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", type=Path, metavar="SOURCE", help="folder of photos, or a video")
    parser.add_argument("scene", type=Path, metavar="SCENE", help="folder to make")
    parser.add_argument(
        "--frames", type=positive(int), default=FRAMES, metavar="N", help=f"frames of a video; {FRAMES} by default"
    )
    parser.add_argument(
        "--max-size",
        type=positive(int),
        default=MAX_SIZE,
        metavar="PIXELS",
        help=f"longer side of the photos in which features are looked for; {MAX_SIZE} by default, fewer are faster",
    )
    parser.add_argument("--threads", type=int, default=-1, metavar="N", help="threads; one a core by default")
    parser.add_argument("--again", action="store_true", help="begin anew instead of continuing")
    return parser
