"""Find out where photos were taken from, by COLMAP, and make a scene of them that can be trained.

Photos: 50 to 300, sharp, each overlapping the next by two thirds, zoom and exposure locked; they may lie in
SCENE/images already. Of a video, the sharpest frames are taken, evenly spread. An interrupted run is continued by the
same command.

Examples:
  nsvq prepare photos/ scenes/garden
  nsvq prepare walk.mp4 scenes/garden --frames 200
"""

import argparse
import json
import shutil
import sys
from functools import partial
from pathlib import Path

from tqdm import tqdm

from nsvq_lightning.commands.arguments import positive
from nsvq_lightning.io.atomic import write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what ``nsvq prepare`` takes."""
    add = parser.add_argument
    add("source", type=Path, metavar="SOURCE", help="folder of photos, or a video")
    add("scene", type=Path, metavar="SCENE", help="folder to make")
    add("--frames", type=positive(int), default=150, metavar="N", help="frames of a video; %(default)s by default")
    help_ = "longer side of the photos in which features are looked for; %(default)s by default, fewer are faster"
    add("--max-size", type=positive(int), default=1600, metavar="PIXELS", help=help_)
    add("--threads", type=int, default=-1, metavar="N", help="threads; one a core by default")
    add("--again", action="store_true", help="begin anew instead of continuing")


def run(options: argparse.Namespace) -> int:
    """Prepare a scene, check it as ``nsvq doctor`` does, and say what to type next.

    Returns:
        0, or 1 if the scene has a problem.

    Raises:
        ValueError: The photos do not make a scene, or the folder is somebody else's.
        OSError: There are none, or a file cannot be read or written.
    """
    from nsvq_lightning.commands.doctor import check_folder, shown
    from nsvq_lightning.data import reconstruct

    source, scene = options.source, options.scene
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file or folder of photos")
    is_video = source.is_file() and source.suffix.lower() in reconstruct.VIDEOS
    if source.is_file() and not is_video:
        raise ValueError(f"{source}: neither a folder of photos nor a video ({', '.join(reconstruct.VIDEOS)})")
    images = scene / "images"
    in_place = source.resolve() == images.resolve()
    if not is_video:
        reconstruct.photos_in(source)  # before anything is written
    _claim(options, is_video, in_place)
    bars: dict[str, tqdm] = {}

    def report(step: str, done: int, total: int) -> None:
        if step not in bars:
            bars[step] = tqdm(total=total, desc=step, mininterval=1)
        bars[step].update(done - bars[step].n)
        if done >= total:
            bars[step].close()

    # The frames were complete before features were looked for.
    if is_video and not (any(images.iterdir()) and (scene / "database.db").exists()):
        for old in images.iterdir():
            old.unlink()
        total = reconstruct.frame_count(source)
        show = partial(report, "choosing frames", total=total)
        chosen = reconstruct.write_frames(source, images, options.frames, show)
        sys.stdout.write(f"{len(chosen)} sharp frames of {total:,}\n")
    elif not (is_video or in_place):
        photos = reconstruct.photos_in(source)
        show = partial(report, "copying photos", total=len(photos))
        for path, reason in reconstruct.copy_photos(photos, images, show):
            sys.stdout.write(f"left out: {path.name} cannot be read ({reason})\n")
    names = [path.name for path in reconstruct.photos_in(images)]
    if len(names) < 2:
        raise ValueError(f"{source}: {len(names)} pictures are too few; a scene takes 50 to 300")
    verdict = reconstruct.reconstruct(scene, names, report, is_video, options.max_size, options.threads)
    sys.stdout.writelines(f"{line}\n" for line in verdict.told(images))
    sys.stdout.write("\nchecking the scene; every photo is read once\n")
    if shown(check_folder(scene))["problem"]:
        return 1
    sys.stdout.write(f"\nnext: nsvq fit --data.root {scene}   (its database.db has served, and may be deleted)\n")
    return 0


# File that shows that a folder was made by this command, and from what.
RECORD = "prepare.json"


def _claim(options: argparse.Namespace, is_video: bool, in_place: bool) -> None:
    """Take the folder of the scene; what another preparation has left in it is continued."""
    scene: Path = options.scene
    record = {"source": str(options.source.resolve()), "max_size": options.max_size}
    if is_video:
        record["frames"] = options.frames
    path, own = scene / RECORD, {"images"} if in_place else set()
    if path.is_file() and not options.again:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found != record:
            raise ValueError(f"{scene} was prepared from {found.get('source')} or otherwise: --again begins anew")
    elif scene.is_dir() and not path.is_file() and {each.name for each in scene.iterdir()} - own:
        raise ValueError(f"{scene} is not empty and was not made by this command: name a new folder")
    if options.again and path.is_file():
        made = {"images", "sparse", "mapping", "database.db", "database.db-shm", "database.db-wal", RECORD}
        for target in (scene / name for name in made - own):
            shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
    (scene / "images").mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(record, indent=2) + "\n")
