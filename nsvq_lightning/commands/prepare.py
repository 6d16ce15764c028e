"""Find out where photos were taken from, by COLMAP, and make a scene of them that can be trained.

Photos: 50 to 300, sharp, each overlapping the next by two thirds, zoom and exposure locked; they may lie in
SCENE/images already, or in folders, one for each camera. Of a video, the sharpest frames are taken, evenly spread. An
interrupted run is continued by the same command, and so is a scene to which photos were added.

Examples:
  nsvq prepare photos/ scenes/garden
  nsvq prepare walk.mp4 scenes/garden --frames 200
"""

import json
import os
import shutil
from argparse import ArgumentParser, Namespace
from pathlib import Path

from tqdm import tqdm

from nsvq_lightning.commands import join, say
from nsvq_lightning.commands.arguments import positive
from nsvq_lightning.io.atomic import write_text


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq prepare`` takes."""
    add = parser.add_argument
    add("source", type=Path, metavar="SOURCE", help="folder of photos, or a video")
    add("scene", type=Path, metavar="SCENE", help="folder to make")
    add("--frames", type=positive(int), default=150, metavar="N", help="frames of a video; %(default)s by default")
    help_ = "longer side of the photos in which features are looked for; %(default)s by default, fewer are faster"
    add("--max-size", type=positive(int), default=1600, metavar="PIXELS", help=help_)
    add("--threads", type=positive(int), default=-1, metavar="N", help="threads; one a core by default")
    add("--again", action="store_true", help="begin anew instead of continuing")


def run(options: Namespace) -> int:
    """Prepare a scene, check it as ``nsvq doctor`` does, and say what to type next.

    Returns:
        0, or 1 if the scene has a problem.

    Raises:
        ValueError: The photos do not make a scene, or the folder is somebody else's.
        OSError: There are none, or a file cannot be read or written.
    """
    from nsvq_lightning.commands.doctor import check_folder, shown
    from nsvq_lightning.data import reconstruct
    from nsvq_lightning.data.images import ON_ITS_SIDE, image_head
    from nsvq_lightning.data.transforms import has_poses

    source, scene = options.source, options.scene
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file or folder of photos")
    is_video = source.is_file()
    if is_video and source.suffix.lower() not in reconstruct.VIDEOS:
        raise ValueError(f"{source}: neither a folder of photos nor a video ({', '.join(reconstruct.VIDEOS)})")
    if not is_video:
        photos, left_out = reconstruct.photos_in(source)  # before anything is written
    images = scene / "images"
    in_place = source.resolve() == images.resolve()
    _claim(options, is_video, in_place)
    from nsvq_lightning.training.run_folder import hold  # with Lightning, for which no error waits

    hold(scene)
    bars = {}

    def report(step: str, done: int, total: int) -> None:
        if step not in bars:
            bars[step] = tqdm(total=total, desc=step, mininterval=1)
        bars[step].update(done - bars[step].n)
        if done >= total:
            bars[step].close()

    remarks = []
    if not is_video:
        names, closed = reconstruct.copy_photos(photos, source, source if in_place else images, report)
        for reason, files in (left_out | closed).items():
            remarks.append(f"left out: {reconstruct.some(files)}: {reason}")
    elif (scene / reconstruct.DATABASE).exists():  # frames were complete before features were looked for
        names = [name for name in reconstruct.stamps_in(scene) if (images / name).exists()]
    else:
        names = reconstruct.write_frames(source, images, options.frames, report)
        say(f"{len(names)} sharp frames")
    if len(names) < 2:
        raise ValueError("; ".join([f"{source}: {len(names)} pictures are too few, a scene takes 50 to 300", *remarks]))
    if has_poses(source):
        remarks.append(f"{source} has cameras already: nsvq fit --data.root {join([source.as_posix()])} uses them")
    heads = {name: image_head(images / name) for name in names}
    if in_place and max(head.orientation for head in heads.values()) >= ON_ITS_SIDE:
        remarks.append("some photos are stored on their side, as the scene will be: give them from another folder")
    say(*remarks, *reconstruct.oddities(heads))
    if shutil.disk_usage(scene).free < 2e6 * len(heads):
        say(f"the disk of {scene} is nearly full: COLMAP takes about 2 MB a photo, and may end without saying why")
    before = {*reconstruct.stamps_in(scene), *reconstruct.stamps_in(scene / "sparse")}
    verdict = reconstruct.reconstruct(scene, heads, report, is_video, options.max_size, options.threads)
    if not in_place:
        for name in before.difference(names):
            (images / name).unlink(missing_ok=True)
    say(*verdict.told(images))
    say("\nchecking the scene: every photo is read once, then steps of training are timed")
    if shown(check_folder(scene))["problem"]:
        return 1
    database = scene / reconstruct.DATABASE
    say(
        f"\n{database} ({database.stat().st_size / 1e6:.0f} MB) saves time when photos are added, and may be deleted",
        f"next: nsvq fit --data.root {join([scene.as_posix()])}",
        "(--minutes 5 stops after five minutes of training)",
    )
    return 0


def _claim(options: Namespace, is_video: bool, in_place: bool) -> None:
    """Take the folder of the scene; what another preparation has left in it is continued."""
    from nsvq_lightning.data import reconstruct

    scene = options.scene
    record = {"source": str(options.source.resolve()), "max_size": options.max_size}
    if is_video:
        record["frames"] = [options.frames, options.source.stat().st_size]
    path = scene / reconstruct.RECORD
    found = json.loads(path.read_bytes()) if path.is_file() else None
    if found is None:
        own = {"masks", "Thumbs.db", "desktop.ini", *(["images"] if in_place else [])}
        if {each.name for each in scene.glob("[!.]*")} - own:
            raise ValueError(f"{scene} is not empty and was not made by this command: name a new folder")
    elif not in_place and found.get("source") == str((scene / "images").resolve()):
        raise ValueError(f"{scene / 'images'} holds photos themselves, no copies: name a new folder for the scene")
    elif options.again:
        reconstruct.remove_database(scene)
        for copy in () if in_place else (scene / "images").rglob("*.*"):
            os.utime(copy)  # to be copied anew, whatever their dates say
        # The model stays until there is another, and is of no photo as it is now.
        if outdated := dict.fromkeys(reconstruct.stamps_in(scene / "sparse"), ""):
            write_text(scene / "sparse" / reconstruct.STAMPS, json.dumps(outdated))
    elif found != record:
        raise ValueError(f"{scene} was prepared from {found.get('source')} or otherwise: --again begins anew")
    (scene / "images").mkdir(parents=True, exist_ok=True)
    write_text(path, f"{json.dumps(record, indent=2)}\n")
