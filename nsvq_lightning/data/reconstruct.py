"""Photos and frames of a video, and where they were taken from: COLMAP, in steps that can be continued."""

import itertools
import json
import locale
import os
import re
import sqlite3
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import chdir, closing, suppress
from importlib import import_module
from io import BytesIO
from pathlib import Path, PurePath
from shutil import rmtree
from statistics import median_high
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any, NamedTuple

import cv2
import numpy as np
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base

from nsvq_lightning.data.colmap import SceneError, check_name, import_pycolmap
from nsvq_lightning.data.images import DAMAGED, ImageHead, exif_of, is_transparent, read_image, read_mask, write_pixels
from nsvq_lightning.data.photo_files import CONVERTED, PHOTOS, RAW, masks_in, photos_below
from nsvq_lightning.io.atomic import make_folder_of, sync, write_bytes, write_text
from nsvq_lightning.io.errors import as_defect
from nsvq_lightning.splats.conventions import Uint8s
from nsvq_lightning.top_level import log

# Photos that are named; of the others, their number is.
MAX_NAMED = 8
DATABASE = "database.db"
STAMPS = "photos.json"
# Called with a step, how much of it is done, and how much there is.
Report = Callable[[str, int, int], None]
# What the heads of photos say, by their names.
Heads = Mapping[str, ImageHead]
# Names of files, by the reason why they are left out.
LeftOut = dict[str, list[str]]
JPEG_QUALITY = 95


class Verdict(NamedTuple):
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
        count = len(self.registered)
        yield (
            f"{count} of {count + len(self.missing)} photos have found their place, {self.points:,} points, seen by "
            f"{self.track:.1f} photos each, error {self.error:.2f} pixels"
        )
        if self.error > 1.5:
            yield "  the error is large: was zoom or focus changing, or something moving?"
        if count < MIN_PHOTOS:
            yield f"  {count} photos are few: 50 and more make a scene that can be walked around"
        if self.models > 1:
            apart = f"  the photos fall apart into {self.models} scenes; sparse/0 is the largest: "
            yield f"{apart}take more photos between"
        sharp = {name: sharpness(read_image(images / name)) for name in self.registered}
        limit = 0.3 * median_high(sharp.values())
        if blurred := [name for name in sharp if sharp[name] < limit]:
            yield f"  blurred, the scene is better without: {some(blurred)}"
        if not self.missing:
            return
        yield "  without a place, better taken again:"
        for name, partners in itertools.islice(self.missing.items(), MAX_NAMED):
            reason = f"shares enough with {partners} other photos" if partners else "overlaps no other"
            if sharpness(read_image(images / name)) < limit:
                reason = "blurred"
            yield f"    {name}: {reason}"
        if len(self.missing) > MAX_NAMED:
            yield f"    and {len(self.missing) - MAX_NAMED} more"


# Photos below which a scene is likely to look good only from where they were taken.
MIN_PHOTOS = 20
# Files in a scene: what of it was made; features and matches; which photos were used.
RECORD = "prepare.json"


def reconstruct(
    scene: Path, photos: Heads, report: Report, is_video: bool = False, max_size: int = 1600, threads: int = -1
) -> Verdict:
    """Find the cameras of the photos in ``scene/images`` and write them to ``scene/sparse/0``.

    Photos of one folder, size and lens are taken to be from one camera with a fixed zoom. What an earlier call has
    found in the same photos is used again; a model of others stays until it can be replaced.

    Args:
        scene: Folder of the scene.
        photos: Heads of the files in ``scene/images`` by name, with ``/`` in those of its subfolders.
        report: Where to say how far it is.
        is_video: Whether they are frames in order.
        max_size: Longer side in pixels to which photos are reduced for finding features.
        threads: How many; −1 for one a core.

    Raises:
        SceneError: Too few photos belong together, or a name is not UTF-8, at which COLMAP would crash.
    """
    for name in (str(scene.resolve()), *photos):
        check_name(name, "the scene to prepare", allow_outside=True)
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.set_random_seed(0)
    # COLMAP takes names for those of the code page: so that they are UTF-8, and from the scene, as it still mistakes
    # letters of the folders on the way.
    if os.name == "nt":
        locale.setlocale(locale.LC_CTYPE, ".UTF-8")
    with chdir(scene):
        here = Path() if os.name == "nt" else Path.cwd()
        stamps = _extract(here, photos, report, max_size, threads)
        _compare(here, photos, report, is_video, threads)
        models = _map(here, stamps, report, threads)
        common = dict(_rows(here, _PARTNERS, json.dumps(list(photos))))
    if not models:
        why = "; ".join(oddities(photos)) or _NOTHING_IN_COMMON
        kept = "; the scene of before is as it was" if (scene / "sparse").is_dir() else ""
        raise SceneError(f"{scene}: {why}. Photos with a partner: {len(common)} of {len(photos)}{kept}")
    model = models[0]
    registered = _registered(model)
    return Verdict(
        tuple(sorted(registered)),
        {name: common.get(name, 0) for name in photos if name not in registered},
        model.num_points3D(),
        model.compute_mean_reprojection_error(),
        model.compute_mean_track_length(),
        len(models),
    )


_NOTHING_IN_COMMON = (
    "no two photos show enough of the same things from different places; each should overlap the next by two thirds, "
    "be sharp, and show texture; the camera must move, not the object, or masks leave out what stands still"
)


def oddities(photos: Heads) -> Iterator[str]:
    """What is unusual about photos and makes it unlikely that their cameras are found.

    Args:
        photos: Their heads by name.
    """
    if len(photos) <= 3:
        yield f"{len(photos)} photos are hardly enough for a scene: take 50 to 300 from different places"
    wide = [name for name, head in photos.items() if head.size[0] == 2 * head.size[1]]
    # A few thumbnails, or pictures for the web, may be cut so; larger ones among photos bend the cameras of all.
    if 2 * len(wide) > len(photos) or any(photos[name].size[0] >= 1000 for name in wide):
        yield (
            f"{some(wide)} are twice as wide as high: 360° panoramas must be cut into ordinary views first, for "
            "example with 'ffmpeg -i panorama.jpg -vf v360=e:flat:yaw=90 view.jpg' for each direction"
        )


# Photos of one camera from which on it has a lens model of four numbers, not one.
MIN_SHARED = 8


def _extract(scene: Path, photos: Heads, report: Report, max_size: int, threads: int) -> dict[str, str]:
    """Find features in photos that have none yet, outside their masks; returns the stamp of each photo."""
    pycolmap = import_pycolmap()
    images = scene / "images"
    groups = defaultdict(list)
    for name, head in photos.items():
        path = images / name
        groups[path.parent, head.size, _lens_of(path)].append(name)
    kept = TemporaryDirectory()
    masks = _write_masks(scene, photos, Path(kept.name))
    stamps = {}
    for group in groups.values():
        model = "OPENCV" if len(group) >= MIN_SHARED else "SIMPLE_RADIAL"
        for name in group:
            stamps[name] = f"{model} {zlib.crc32((images / name).read_bytes(), masks.get(name, 0)):08x}"
    known = stamps_in(scene)
    if not (scene / DATABASE).exists() or any(known.get(name, stamp) != stamp for name, stamp in stamps.items()):
        remove_database(scene)
        known = {}
    # With those of photos that have gone, whose features stay in the database; they may come back.
    write_text(scene / STAMPS, json.dumps(known | stamps))
    options = pycolmap.FeatureExtractionOptions(max_image_size=max_size, num_threads=threads, use_gpu=False)
    done = 0
    for group in groups.values():
        reader = pycolmap.ImageReaderOptions(camera_model=stamps[group[0]].split()[0])
        reader.mask_path = kept.name if masks else ""
        # The first one alone makes the camera of its group. COLMAP passes over photos that have features already.
        for batch in (group[:1], *(group[start : start + 4] for start in range(1, len(group), 4))):
            cameras = dict(_rows(scene, "select name, camera_id from images"))
            reader.existing_camera_id = next((cameras[name] for name in group if name in cameras), -1)
            pycolmap.extract_features(
                scene / DATABASE,
                images,
                batch,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(batch)
            report("finding features", done, len(photos))
    kept.cleanup()  # which an error leaves to the end of this object
    return stamps


def _write_masks(scene: Path, photos: Heads, folder: Path) -> dict[str, int]:
    """Write the masks of a scene as COLMAP takes them, one for each photo and of its size; returns their checksums.

    What is transparent in a photo does not count either, as in training.

    Raises:
        SceneError: A mask is damaged or of another shape, or two fit a photo.
    """
    files = [scene / "images" / name for name in photos]
    found = masks_in(scene / "masks", [(name, name) for name in photos], files, beside=False)
    for number, (file, head) in enumerate(zip(files, photos.values(), strict=True)):
        if not found[number] and head.has_alpha and is_transparent(file):
            found[number] = file
    sums: dict[str, int] = {}
    for (name, head), mask in zip(photos.items(), found if any(found) else (), strict=False):
        counts = read_mask(mask, head.size) if mask else np.ones(head.size[::-1], np.bool_)
        write_pixels(folder / f"{name}.png", 255 * counts.astype(np.uint8))
        sums[name] = zlib.crc32(counts.tobytes())
    return sums


def _lens_of(path: Path) -> str:
    """What EXIF says of the camera and the lens of a photo."""
    tags, how = Image.Exif(), {}
    with Image.open(path) as image, suppress(*DAMAGED):
        tags = exif_of(image)
        how = tags.get_ifd(IFD.Exif)
    zoom = how.get(Base.DigitalZoomRatio)
    lens = [tags.get(Base.Model), how.get(Base.FocalLength), how.get(Base.FocalLengthIn35mmFilm)]
    # As text: the number 0/0, which some write, is not equal to itself.
    return str(lens if zoom in (None, 0, 1) else [*lens, zoom])


def stamps_in(folder: Path) -> dict[str, str]:
    """What the features or models in a folder were found in: for each photo lens model and checksum."""
    path = folder / STAMPS
    return dict(json.loads(path.read_bytes())) if path.is_file() else {}


def remove_database(scene: Path) -> None:
    """Remove features and matches, with what a killed process has left of them."""
    for path in scene.glob(f"{DATABASE}*"):
        path.unlink()


# Photos up to which every pair is compared; frames of a video are compared with those near them from half of it on.
MAX_EXHAUSTIVE = 120
# How far apart the others are that are compared. In two folders by their file names, so that those of two cameras
# alternate; in more, neighbours of one folder would be too far apart.
STEPS = (1, 2, 3, 4, 5, 6, 8, 12, 16, 32, 64, 128)


def _compare(scene: Path, photos: Heads, report: Report, is_video: bool, threads: int) -> None:
    """Compare photos, and say now and then how many pairs are done."""
    count = len(photos)
    pycolmap = import_pycolmap()
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    how = {"matching_options": matching, "device": pycolmap.Device.cpu}
    exhaustive = count * (1 + is_video) <= MAX_EXHAUSTIVE
    pairs = count * (count - 1) // 2 if exhaustive else sum(max(count - step, 0) for step in STEPS)
    ended = Event()

    # By COLMAP's own SQLite: Python's takes no notice of its locks, which are of the same process, and empties the
    # index of its log, at which COLMAP crashes or loses pairs where the disk is slow.
    database = pycolmap.Database.open(scene / DATABASE)

    def poll() -> None:
        while not ended.wait(timeout=1.0):
            report("comparing photos", min(database.num_verified_image_pairs(), pairs), pairs)

    polling = Thread(target=poll, daemon=True)
    polling.start()
    try:
        if exhaustive:
            # Ctrl-C is heard between blocks of photos only; small ones take a tenth longer.
            blocks = pycolmap.ExhaustivePairingOptions(block_size=10)
            pycolmap.match_exhaustive(scene / DATABASE, pairing_options=blocks, **how)
        elif any(re.search("^#| ", name) for name in photos):  # a list of pairs cannot have such names
            pairing = pycolmap.SequentialPairingOptions(overlap=len(STEPS), quadratic_overlap=True)
            pycolmap.match_sequential(scene / DATABASE, pairing_options=pairing, **how)
        else:
            alternate = len({PurePath(name).parent for name in photos}) == 2
            names = sorted(photos, key=lambda name: (_numbered(PurePath(name).name if alternate else name), name))
            listed = "".join(f"{a} {b}\n" for step in STEPS for a, b in zip(names, names[step:], strict=False))
            with TemporaryDirectory() as folder:
                write_text(Path(folder) / "pairs.txt", listed)
                listing = pycolmap.ImportedPairingOptions(match_list_path=Path(folder) / "pairs.txt", block_size=100)
                pycolmap.match_image_pairs(scene / DATABASE, pairing_options=listing, **how)
    finally:
        ended.set()
        polling.join()
        database.close()
    report("comparing photos", pairs, pairs)


def _numbered(name: str) -> str:
    """What to sort a name by, so that 10 comes after 9."""
    return re.sub(r"\d+", lambda number: number[0].zfill(20), name)


def _map(scene: Path, stamps: dict[str, str], report: Report, threads: int) -> list[Any]:
    """The models, the largest first, which are then in ``scene/sparse``; one of other photos there is replaced."""
    pycolmap = import_pycolmap()
    work = scene / "mapping"
    sparse = scene / "sparse"
    if stamps_in(sparse) != stamps:
        rmtree(work, ignore_errors=True)
        work.mkdir()
        placed = itertools.count(1)
        count = len(stamps)
        options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=0, min_model_size=3)
        options.image_names = list(stamps)
        found = pycolmap.incremental_mapping(
            scene / DATABASE,
            scene / "images",
            work,
            options=options,
            next_image_callback=lambda: report("placing cameras", min(next(placed), count), count),
        )
        report("placing cameras", count, count)  # those without a place, too
        ordered = _adding(found.values())
        rmtree(work, ignore_errors=True)  # on exFAT, a Mac's ._files go with those that they are of
        if not ordered:
            return []
        for index, model in enumerate(ordered):
            (work / str(index)).mkdir(parents=True)
            model.write(work / str(index))
        for file in work.rglob("*.bin"):  # COLMAP flushes none, and the stamps say that they are complete
            sync(file, os.O_RDWR)
        write_text(work / STAMPS, json.dumps(stamps))
        rmtree(sparse, ignore_errors=True)
        work.rename(sparse)
    folders = sorted((path for path in sparse.iterdir() if path.name.isdecimal()), key=lambda path: int(path.name))
    return [pycolmap.Reconstruction(folder) for folder in folders]


def _adding(models: Iterable[Any]) -> list[Any]:
    """The largest model, and those with photos that no larger one has; COLMAP also leaves parts of larger ones."""
    adding = []
    placed = set[str]()
    for model in sorted(models, key=lambda model: -model.num_reg_images()):
        names = _registered(model)
        if not names <= placed:
            adding.append(model)
            placed |= names
    return adding


def _registered(model: Any) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


# Photos by name, and how many of them share enough points with each; COLMAP numbers a pair by its images' numbers.
_PARTNERS = """
    with photos as (select * from images where name in (select value from json_each(?)))
    select one.name, count(*) from photos one join photos other join two_view_geometries
    on pair_id = 2147483647 * min(one.image_id, other.image_id) + max(one.image_id, other.image_id)
    where one.image_id != other.image_id and rows >= 15 group by one.name
"""


def _rows(scene: Path, query: str, *parameters: str) -> list[tuple[Any, ...]]:
    """What a query finds in the database of a scene; nothing where there is none."""
    database = scene / DATABASE
    if not database.exists():
        return []
    remedy = "if it is damaged, as after a power loss, remove it: features are found again"
    with closing(sqlite3.connect(database)) as connection, as_defect(str(database), sqlite3.DatabaseError, remedy):
        return connection.execute(query, parameters).fetchall()


# Suffixes of videos.
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
# Names of folders that hold something else than photos, or the same photos again, and of files that are such.
OTHER = re.compile(
    r"\..*|__MACOSX|@eaDir|#recycle|\$RECYCLE\.BIN|(.*_)?(masks?|depths?|normals?|semantics)|conf(idence)?|depth_?maps|"
    r"(un)?distorted|dense|corrected_images|\.?thumb.*|images_\d+|[248]x|sparse|runs",
    re.IGNORECASE,
)
OTHER_FILES = re.compile(r"thumbnail|(thumb|conf|depth|mask)_\d+|.*(\d_(mask|depth|normal)(_\d+)?|\.mask)", re.I)


def photos_in(folder: Path) -> tuple[list[Path], LeftOut]:
    """The photos of a folder, or if it has none those of the folders in it, and what is left out.

    Of files that differ in the suffix alone, such as the JPEG and the raw file of a camera, one is taken.

    Raises:
        SceneError: There are none.
    """
    suffixes = PHOTOS + CONVERTED + RAW
    files = photos_below(folder, suffixes)
    other = {path for path in files if _is_other(path.relative_to(folder)) or path.with_suffix("").is_file()}
    files.sort(key=lambda path: (path in other, path.parent != folder, suffixes.index(path.suffix.lower()), path))
    taken: dict[str, Path] = {}
    left = defaultdict(list)
    for path in files:
        inside = path.relative_to(folder)
        if any((folder / parent / RECORD).is_file() for parent in inside.parents[:-1]):
            continue  # a scene, made of photos that are here
        if path in other:
            reason = "no photos by their names, or that of their folder"
        elif path.parent != files[0].parent == folder:
            reason = "in a folder beside the photos: give it alone, or put all photos into folders"
        elif taken.setdefault(str(inside.with_suffix("")).casefold(), path) != path:
            reason = "another file of that name is taken"
        else:
            continue
        left[reason].append(str(inside))
    if not taken:
        holds = f"it must hold files that end in {', '.join(PHOTOS)}, or folders of them; a video is given by itself"
        raise SceneError(f"{folder}: no photos; {holds}")
    return sorted(taken.values()), left


def _is_other(inside: Path) -> bool:
    return bool(any(map(OTHER.fullmatch, inside.parts[:-1])) or OTHER_FILES.fullmatch(inside.stem))


def copy_photos(photos: Sequence[Path], source: Path, folder: Path, report: Report) -> tuple[list[str], LeftOut]:
    """Copy photos into a folder, upright and as files that COLMAP reads; copies that are there already stay.

    Photos that lie in that folder already are only converted if COLMAP cannot read them.

    Args:
        photos: The files.
        source: The folder that they, or the folders with them, are in.
        folder: Where to, existing.
        report: Where to say how far it is.

    Returns:
        The names of the copies in ``folder``, and which photos cannot be read.
    """
    names = []
    left = defaultdict(list)
    for count, path in enumerate(photos, 1):
        inside = path.relative_to(source)
        try:
            names.append(_copy(path, folder / inside).relative_to(folder).as_posix())
        except DAMAGED as error:
            known = path.suffix.lower() in PHOTOS
            why = re.split(" ['\"]", str(error))[0]  # Pillow's names the file
            left[f"cannot be read ({why})" if known else TO_CONVERT].append(str(inside))
        report("copying photos", count, len(photos))
    return names, left


TO_CONVERT = (
    "cannot be read: convert to JPEG, for example with 'magick mogrify -format jpg *.heic', or set the phone to \"most "
    "compatible\"; HEIC is read after 'pip install pillow-heif'"
)
# What Pillow calls the formats of photos that stay without losses when they are converted, and those that COLMAP reads.
LOSSLESS = ("PNG", "TIFF", "BMP")
COLMAP_READS = ("JPEG", "MPO", *LOSSLESS)


def _copy(path: Path, target: Path) -> Path:
    """Copy a photo to ``target``, whose suffix may change; returns where it is."""
    with suppress(ImportError):
        import_module("pillow_heif").register_heif_opener()
    in_place = path == target
    with Image.open(path) as image:
        if image.format == "TIFF" and path.suffix.lower() not in PHOTOS:
            raise ValueError("the preview in a raw file")
        is_plain = image.getexif().get(Base.Orientation, 1) == 1 and image.mode[0] not in "IF"
        as_is = image.format in COLMAP_READS and (in_place or is_plain)
        is_lossless = image.format in LOSSLESS or image.has_transparency_data
        kind, suffixes = ("PNG", (".png",)) if is_lossless else ("JPEG", (".jpg", ".jpeg"))
        if path.suffix.lower() not in (PHOTOS if as_is else suffixes):
            target = target.with_suffix(suffixes[0])
        if not in_place and target.exists():
            old, new = target.stat(), path.stat()
            same_size = not as_is or old.st_size == new.st_size  # on Windows, a change shows in nothing else
            if old.st_mtime == new.st_mtime and old.st_ctime >= new.st_ctime and same_size:  # written after a change
                return target
        image.load()
        content = path.read_bytes() if as_is else _converted(image, path, kind)
    if target != path:
        make_folder_of(target)
        write_bytes(target, content)
        os.utime(target, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))
    elif not as_is:
        raise ValueError("it is of another format than its name says: rename it")
    return target


def _converted(image: Image.Image, path: Path, kind: str) -> bytes:
    """A photo upright and in 8 bits, as a file of another kind."""
    if image.mode[0] in "IF":  # 16 bits or more, which Pillow would cut off
        image = Image.fromarray(read_image(path))
    try:
        image.getexif().tobytes()
    except DAMAGED:  # some tags are of another type than they must be
        image.info.pop("exif", None)
    upright = ImageOps.exif_transpose(image)
    colours = upright.convert("RGBA" if upright.has_transparency_data else "RGB")
    file = BytesIO()
    profile = upright.info.get("icc_profile") if upright.mode in ("RGB", "RGBA", "P") else None
    colours.save(file, kind, quality=JPEG_QUALITY, exif=upright.getexif(), icc_profile=profile)
    return file.getvalue()


def some(names: Sequence[str], most: int = MAX_NAMED) -> str:
    """The first of many names, and how many more there are."""
    shown = ", ".join(names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown


def sharpness(picture: Uint8s) -> float:
    """Variance of the Laplacian of a BGR picture ``[H, W, 3]``, at most 480 pixels wide: more is sharper."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    factor = min(1.0, 480 / grey.shape[1])  # noise is no sharpness
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_64F).var())


# Mean difference, of 255, below which the camera has not moved between two frames.
STILL = 2.0


def write_frames(video: Path, folder: Path, count: int, report: Report) -> list[str]:
    """Write the sharpest frame of each of ``count`` equal parts of a video as a JPEG; still parts are left out.

    Args:
        video: The file; OpenCV turns its frames upright.
        folder: Where to, existing.
        count: Number of parts.
        report: Where to say how far it is.

    Returns:
        The names of the pictures, after the numbers of the frames.

    Raises:
        SceneError: The file is not a video that can be read.
    """
    total = int(cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT))
    if total <= 0:  # some containers do not say
        total = sum(1 for _ in _frames(video, lambda _: None))
    names = []
    last = None
    number = 0
    frames = _frames(video, lambda done: report("choosing frames", done, total))
    for _, part in itertools.groupby(frames, key=lambda frame: frame[0] * min(count, total) // total):
        number, picture = max(part, key=lambda frame: sharpness(frame[1]))
        tiny = cv2.resize(picture, (48, 27), interpolation=cv2.INTER_AREA).astype(np.float32)
        if last is not None and np.abs(tiny - last).mean() < STILL:
            continue
        names.append(f"frame_{number:06d}.jpg")
        written = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        write_bytes(folder / names[-1], written.tobytes())
        last = tiny
    if not names:
        raise SceneError(f"{video}: no frame can be read; convert it with 'ffmpeg -i {video.name} converted.mp4'")
    if number + total / count < 0.9 * total:
        log.warning(f"{video} ends near frame {number} of {total}: copy it again, or convert it with ffmpeg")
    return names


def _frames(video: Path, done: Callable[[int], None]) -> Iterator[tuple[int, Uint8s]]:
    """The frames with their numbers; ``done`` is called with how many have been used."""
    reader = cv2.VideoCapture(str(video))
    for index in itertools.count():
        found, picture = reader.read()
        if not found:
            return
        yield index, picture
        done(index + 1)
