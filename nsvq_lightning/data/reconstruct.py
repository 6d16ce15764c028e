"""Photos and frames of a video, and where they were taken from: COLMAP, in steps that can be continued."""

import contextlib
import itertools
import shutil
import sqlite3
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import PIL.ImageOps
from cv2.typing import MatLike

from nsvq_lightning.data.colmap import SceneError, check_name, import_pycolmap
from nsvq_lightning.data.images import DAMAGED, ORIENTATION, image_head, read_image
from nsvq_lightning.io.atomic import atomic_write, write_bytes


@dataclass(frozen=True)
class Verdict:
    """What came out.

    Attributes:
        registered: Names of the photos whose place was found.
        missing: Names of the others, with the number of photos that each has enough in common with.
        points: Number of 3D points.
        error: Mean reprojection error, pixels of the photos.
        track: Mean number of photos that see a point.
        models: Number of separate models, each with photos that no larger one has; the largest is the scene.
    """

    registered: tuple[str, ...]
    missing: dict[str, int]
    points: int
    error: float
    track: float
    models: int

    def told(self, images: Path) -> Iterator[str]:
        """What came out, and what to take again."""
        count, total = len(self.registered), len(self.registered) + len(self.missing)
        yield (
            f"{count} of {total} photos have found their place, {self.points:,} points, seen by {self.track:.1f} "
            f"photos each, error {self.error:.2f} pixels"
        )
        if self.error > 1.5:
            yield "  the error is large: was zoom or focus changing, or something moving?"
        if count < MIN_PHOTOS:
            yield f"  {count} photos are few: 50 and more make a scene that can be walked around"
        if self.models > 1:
            apart = f"  the photos fall apart into {self.models} scenes; sparse/0 is the largest: "
            yield f"{apart}take more photos between"
        if not self.missing:
            return
        some = self.registered[:: max(1, count // MIN_PHOTOS)]
        usual = sorted(sharpness(read_image(images / name)) for name in some)[len(some) // 2]
        yield "  without a place, better taken again:"
        listed = 8
        for name, partners in list(self.missing.items())[:listed]:
            if sharpness(read_image(images / name)) < 0.3 * usual:
                reason = "blurred"
            else:
                reason = f"shares enough with {partners} other photos" if partners else "overlaps no other"
            yield f"    {name}: {reason}"
        if len(self.missing) > listed:
            yield f"    and {len(self.missing) - listed} more"


# Photos below which a scene is likely to look good only from where they were taken.
MIN_PHOTOS = 20
# Called with a step, how much of it is done, and how much there is.
Report = Callable[[str, int, int], None]


def reconstruct(
    scene: Path, names: Sequence[str], report: Report, is_video: bool = False, max_size: int = 1600, threads: int = -1
) -> Verdict:
    """Find the cameras of the photos in ``scene/images`` and write them to ``scene/sparse/0``.

    Photos of one size are taken to be from one camera with a fixed zoom. What a call that was stopped has found is
    used by the next one.

    Args:
        scene: Folder of the scene.
        names: Files in ``scene/images``.
        report: Where to say how far it is.
        is_video: Whether they are frames in order.
        max_size: Longer side in pixels to which photos are reduced for finding features.
        threads: How many; −1 for one a core.

    Raises:
        SceneError: Too few photos belong together, or a name is not UTF-8, at which COLMAP would crash.
    """
    for name in (str(scene.resolve()), *names):
        check_name(name, "the scene to prepare", allow_outside=True)
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(0)
    database, images = scene / "database.db", scene / "images"
    _extract(database, images, names, report, max_size, threads)
    _compare(database, len(names), report, is_video, threads)
    models = _map(database, scene, len(names), report, threads)
    common = _partners(database)
    if not models:
        raise SceneError(
            f"{scene}: no two photos show enough of the same things from different places; each should overlap the "
            f"next by two thirds, be sharp, and show texture. Photos with a partner: {len(common)} of {len(names)}"
        )
    model = models[0]
    registered = _registered(model)
    return Verdict(
        tuple(sorted(registered)),
        {name: common.get(name, 0) for name in names if name not in registered},
        model.num_points3D(),
        model.compute_mean_reprojection_error(),
        model.compute_mean_track_length(),
        len(models),
    )


# Photos of one size from which on their camera has a lens model of four numbers, not one.
SHARED = 8


def _extract(database: Path, images: Path, names: Sequence[str], report: Report, max_size: int, threads: int) -> None:
    pycolmap = import_pycolmap()
    groups: defaultdict[tuple[int, int], list[str]] = defaultdict(list)
    for name in names:
        groups[image_head(images / name).size].append(name)
    options = pycolmap.FeatureExtractionOptions(max_image_size=max_size, num_threads=threads, use_gpu=False)
    done = 0
    for group in groups.values():
        reader = pycolmap.ImageReaderOptions(camera_model="OPENCV" if len(group) >= SHARED else "SIMPLE_RADIAL")
        # The first one alone makes the camera of its group. COLMAP passes over photos that have features already.
        for batch in (group[:1], *(group[start : start + 4] for start in range(1, len(group), 4))):
            cameras = dict(_rows(database, "select name, camera_id from images"))
            reader.existing_camera_id = next((cameras[name] for name in group if name in cameras), -1)
            pycolmap.extract_features(
                database,
                images,
                batch,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(batch)
            report("finding features", done, len(names))


# Photos up to which every pair is compared; frames of a video are compared with those near them from half of it on.
EXHAUSTIVE = 120
# Frames after each with which it is compared, and as many farther ones at distances that double.
OVERLAP = 12


def _compare(database: Path, count: int, report: Report, is_video: bool, threads: int) -> None:
    """Compare photos, and say now and then how many pairs are done."""
    pycolmap = import_pycolmap()
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    how = {"matching_options": matching, "device": pycolmap.Device.cpu}
    exhaustive = count <= (EXHAUSTIVE // 2 if is_video else EXHAUSTIVE)
    pairs = count * (count - 1) // 2 if exhaustive else 2 * OVERLAP * count
    ended = threading.Event()

    def poll() -> None:
        while not ended.wait(timeout=1.0):
            with contextlib.suppress(sqlite3.Error):
                done = _rows(database, "select count(*) from two_view_geometries")[0][0]
                report("comparing photos", min(done, pairs), pairs)

    polling = threading.Thread(target=poll, daemon=True)
    polling.start()
    try:
        if exhaustive:
            pycolmap.match_exhaustive(database, **how)
        else:
            pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True)
            pycolmap.match_sequential(database, pairing_options=pairing, **how)
    finally:
        ended.set()
        polling.join()
    report("comparing photos", pairs, pairs)


def _map(database: Path, scene: Path, count: int, report: Report, threads: int) -> list[Any]:
    """The models, the largest first, which are then in ``scene/sparse``."""
    pycolmap = import_pycolmap()
    work, sparse = scene / "mapping", scene / "sparse"
    if not (sparse / "0").is_dir():
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        placed = itertools.count(1)
        options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=0, min_model_size=3)
        found = pycolmap.incremental_mapping(
            database,
            scene / "images",
            work,
            options=options,
            next_image_callback=lambda: report("placing cameras", min(next(placed), count), count),
        )
        report("placing cameras", count, count)  # those without a place, too
        ordered = _adding(found.values())
        shutil.rmtree(work)
        if not ordered:
            return []
        for index, model in enumerate(ordered):
            (work / str(index)).mkdir(parents=True)
            model.write(work / str(index))
        work.rename(sparse)
    folders = sorted((path for path in sparse.iterdir() if path.name.isdecimal()), key=lambda path: int(path.name))
    return [pycolmap.Reconstruction(folder) for folder in folders]


def _adding(models: Iterable[Any]) -> list[Any]:
    """The largest model, and those with photos that no larger one has; COLMAP also leaves parts of larger ones."""
    adding: list[Any] = []
    placed: set[str] = set()
    for model in sorted(models, key=lambda model: -model.num_reg_images()):
        names = _registered(model)
        if not names <= placed:
            adding.append(model)
            placed |= names
    return adding


def _registered(model: Any) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def _partners(database: Path) -> dict[str, int]:
    """For each photo by name, the number of others that it shares enough points with; none are left out."""
    names = dict(_rows(database, "select image_id, name from images"))
    pairs = _rows(database, "select pair_id from two_view_geometries where rows >= 15")
    numbers = (number for (pair,) in pairs for number in (pair % 2147483647, pair // 2147483647))
    return Counter(names[number] for number in numbers if number in names)


def _rows(database: Path, query: str) -> list[tuple[Any, ...]]:
    """What a query finds in a database; nothing where there is none."""
    if not database.exists():
        return []
    with contextlib.closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True)) as connection:
        return connection.execute(query).fetchall()


# Suffixes of photos that both COLMAP and this package read.
PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
# Suffixes of videos.
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")


def photos_in(folder: Path) -> list[Path]:
    """The photos of a folder, sorted by name.

    Raises:
        SceneError: There are none, or some in a format that must be converted first.
    """
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    must_convert = (".heic", ".heif", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".dng")
    closed = [path.name for path in files if path.suffix.lower() in must_convert]
    if closed:
        raise SceneError(
            f"{folder}: {closed[0]} and {len(closed) - 1} more cannot be read: convert them to JPEG first, for example "
            f"with 'magick mogrify -format jpg *{Path(closed[0]).suffix}', or set the phone to \"most compatible\""
        )
    photos = [path for path in files if path.suffix.lower() in PHOTOS]
    if not photos:
        inside = next((path.parent for path in sorted(folder.glob("*/*")) if path.suffix.lower() in PHOTOS), None)
        advice = f"it must hold files that end in {', '.join(PHOTOS)}"
        if inside is not None:
            advice = f"there are some in {inside}: give that folder"
        raise SceneError(f"{folder}: no photos; {advice}")
    return photos


JPEG_QUALITY = 95


def copy_photos(photos: Sequence[Path], folder: Path, done: Callable[[int], None]) -> list[tuple[Path, str]]:
    """Copy photos into a folder, those with an EXIF orientation turned upright; copies that are there already stay.

    Args:
        photos: The files.
        folder: Where to, existing.
        done: Called with how many have been treated.

    Returns:
        Photos that cannot be read, and why; they are not copied.
    """
    damaged = []
    for count, path in enumerate(photos, 1):
        target = folder / path.name
        try:
            with PIL.Image.open(path) as image:
                image.load()
                if not target.exists():
                    with atomic_write(target) as copy:
                        if image.getexif().get(ORIENTATION, 1) == 1:
                            copy.write(path.read_bytes())
                        else:
                            upright = PIL.ImageOps.exif_transpose(image)
                            upright.save(copy, image.format, quality=JPEG_QUALITY, exif=upright.getexif().tobytes())
        except DAMAGED as error:
            damaged.append((path, str(error)))
        done(count)
    return damaged


def sharpness(picture: MatLike) -> float:
    """Variance of the Laplacian of a picture, reduced to the same width whatever its size: more is sharper."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
    factor = min(1.0, 480 / grey.shape[1])  # noise is no sharpness
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_64F).var())


# Mean difference, of 255, below which the camera has not moved between two frames.
STILL = 2.0


def write_frames(video: Path, folder: Path, count: int, done: Callable[[int], None]) -> list[Path]:
    """Write the sharpest frame of each of ``count`` equal parts of a video as a JPEG; still parts are left out.

    Args:
        video: The file; OpenCV turns its frames upright.
        folder: Where to, existing.
        count: Number of parts.
        done: Called with the number of frames that have been read.

    Returns:
        The pictures, named after the frames, in order.

    Raises:
        SceneError: The file is not a video that can be read.
    """
    total = frame_count(video)
    parts = min(count, total)
    written: list[Path] = []
    last: MatLike | None = None
    for _, part in itertools.groupby(_frames(video, done), key=lambda frame: frame[0] * parts // total):
        number, picture = max(part, key=lambda frame: sharpness(frame[1]))
        tiny = cv2.resize(picture, (48, 27), interpolation=cv2.INTER_AREA).astype(np.float32)
        if last is not None and float(np.abs(tiny - last).mean()) < STILL:
            continue
        path = folder / f"frame_{number:06d}.jpg"
        write_bytes(path, cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
        written.append(path)
        last = tiny
    return written


def frame_count(video: Path) -> int:
    """Number of frames of a video.

    Raises:
        SceneError: The file is not a video that can be read.
    """
    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    reader.release()
    if total <= 0:  # some containers do not say
        total = sum(1 for _ in _frames(video, lambda _: None))
    if not total:
        raise SceneError(f"{video}: no frame can be read; convert it with 'ffmpeg -i {video.name} converted.mp4'")
    return total


def _frames(video: Path, done: Callable[[int], None]) -> Iterator[tuple[int, MatLike]]:
    """The frames with their numbers; ``done`` is called with how many have been used."""
    reader = cv2.VideoCapture(str(video))
    try:
        for index in itertools.count():
            found, picture = reader.read()
            if not found:
                return
            yield index, picture
            done(index + 1)
    finally:
        reader.release()
