"""Where the photos and masks of a scene are: under the names that its model gives, or under the nearest ones."""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from glob import glob
from pathlib import Path, PurePosixPath
from unicodedata import normalize

from nsvq_lightning.data.colmap import ColmapImage, NoPhotosError, SceneError, check_name, is_outside
from nsvq_lightning.top_level import log

# Suffixes of photos that both COLMAP and this package read.
PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
# Suffixes of photos that are converted if Pillow reads them, and of raw files.
CONVERTED = (".jfif", ".jpe", ".avif", ".heic", ".heif", ".hif", ".jxl", ".jp2", ".gif")
RAW = (".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2", ".srw", ".gpr", ".pef")

# What names of folders of masks have in them.
_OF_MASKS = re.compile("(?<!un)mask", re.IGNORECASE)
# The same of folders whose pictures are no photos, unless a model names them.
_NO_PHOTOS = re.compile(f"{_OF_MASKS.pattern}|depth|normal", re.IGNORECASE)


def locate(
    names: Sequence[str], folder: Path, source: str, allow_outside: bool = False, others: Iterable[Path] = ()
) -> dict[str, Path]:
    """The file of each photo or mask.

    A name that is no file is taken for the one that differs least: in capitals or Unicode form, then in its suffix.
    Where no name fits, folders at its beginning are disregarded, such as those of another machine.

    Args:
        names: What a model calls them.
        folder: Where they are.
        source: The model, for messages.
        allow_outside: Also read files that are not in the scene folder.
        others: Files that are something else, however near their names are.

    Returns:
        Paths by name, of which those of missing files do not exist.

    Raises:
        SceneError: Two files fit a name, two names fit a file, or a name leads out of the scene folder.
    """
    paths = {name: folder / name for name in names}
    exact = {name for name, path in paths.items() if (allow_outside or not is_outside(name)) and path.is_file()}
    if len(exact) == len(paths):
        return paths
    taken = {*others, *(paths[name] for name in exact)}
    free = [path for path in photos_below(folder) if path not in taken]
    if not any(map(_NO_PHOTOS.search, names)):
        free = [path for path in free if not _NO_PHOTOS.search(str(path.parent.relative_to(folder)))]
    files = _Files(folder, free, whole=bool(exact))
    used: dict[Path, str] = {}
    for name in sorted(paths.keys() - exact):
        fitting = files.nearest(name) or files.nearest(_stem(name, CONVERTED + RAW))  # what it was converted to
        if not fitting:
            check_name(name, source, allow_outside)
            continue
        path, *rivals = fitting
        if rivals:
            raise SceneError(f"{source} names {name}, which may be {path} or {rivals[0]}: remove or rename one")
        if path in used:
            raise SceneError(f"{source} names {used[path]} and {name}, but there is only {path}: copy both")
        used[path] = name
    stems = {path.with_suffix("") for path in taken | used.keys()}
    kinds = {_kind(path.name) for path in free if path not in used and path.with_suffix("") in stems}
    # Not of another kind that lies beside all photos, such as the depth map of a photo that is gone.
    used = {path: name for path, name in used.items() if _kind(path.name) not in kinds - {_kind(name)}}
    paths |= {name: path for path, name in used.items()}
    if used:
        path, name = next(iter(used.items()))
        log.info(f"{len(used)} of {len(paths)} files have other names than in {source}: {name} is {path}")
    return paths


class _Files:
    """Files by their path without suffix, or also by its last parts, as :func:`_key` compares them.

    Args:
        folder: What paths are relative to.
        paths: Files in it.
        whole: Compare whole paths only.
    """

    def __init__(self, folder: Path, paths: Iterable[Path], whole: bool = True) -> None:
        self._whole = whole
        self._found = defaultdict[str, list[Path]](list)
        for path in paths:
            for key in self._keys(path.relative_to(folder).as_posix()):
                self._found[key].append(path)

    def _keys(self, name: str) -> list[str]:
        parts = PurePosixPath(_key(_stem(name))).parts
        return ["/".join(parts[start:]) for start in range(1 if self._whole else len(parts))]

    def nearest(self, name: str) -> list[Path]:
        """The files that fit a name best, by most of its parts, in the fewest folders, with its suffix."""
        wanted = _kind(name)

        def closeness(path: Path) -> tuple[int, bool]:
            return -len(path.parts), _kind(path.name) == wanted

        fitting = next((self._found[key] for key in self._keys(name) if key in self._found), [])
        best = max(map(closeness, fitting), default=None)
        return [path for path in fitting if closeness(path) == best]


def _key(name: str) -> str:
    """A path as it is compared: with slashes, composed letters and no capitals."""
    return normalize("NFC", name.replace("\\", "/")).casefold()


def _stem(name: str, suffixes: Sequence[str] = PHOTOS) -> str:
    """A path without one of the suffixes."""
    stem, dot, suffix = name.rpartition(".")
    return stem if dot + suffix.lower() in suffixes else name


def _kind(name: str) -> str:
    """The suffix of a file, of which some have two spellings."""
    return name.lower().rpartition(".")[2].replace("jpeg", "jpg").replace("tiff", "tif")


def photos_below(folder: Path, suffixes: Sequence[str] = PHOTOS) -> list[Path]:
    """The files in a folder and the folders in it, linked ones too, that end as photos do, sorted."""
    found = map(folder.joinpath, glob("**", root_dir=folder, recursive=True, include_hidden=True))
    return sorted(path for path in found if path.suffix.lower() in suffixes and path.name[0] != "." and path.is_file())


def photo_folder(root: Path, name: str, factor: int | None, names: Sequence[str]) -> tuple[Path, int]:
    """The folder to read photos from, and the divisor of their size that is still to be applied.

    Args:
        root: Scene folder.
        name: What the folder should be called; if there is none, the only one that has the photos.
        factor: Divisor that is asked for.
        names: The photos.

    Raises:
        NoPhotosError: None has the photos.
        SceneError: Several have.
    """
    divisor = 1 if name.endswith(f"_{factor}") else factor or 1
    scaled = root / f"{name}_{factor}"
    if factor and factor > 1 and scaled.is_dir():
        log.info(f"photos are read from {scaled}, as they are")
        return scaled, 1
    if (root / name).is_dir():
        return root / name, divisor
    plain = [given.replace("\\", "/") for given in names]
    folders = [path for depth in ("*", "*/*") for path in sorted(root.glob(depth)) if not _NO_PHOTOS.search(path.name)]
    found = [path for path in (root, *folders) if all((path / given).is_file() for given in plain)]
    if len(found) != 1:
        others = " and ".join(str(path.relative_to(root)) for path in found)
        raise (SceneError if found else NoPhotosError)(
            f"image folder {root / name} does not exist: copy the photos there, set images_folder (or factor, for "
            f"{name}_2, _4 and _8), or name COLMAP's folder of undistorted ones, such as {root / 'dense/0'}, as the "
            f"scene; they are in {others or 'no other folder up to two levels down'}"
        )
    log.info(f"{root / name} does not exist: photos are read from {found[0]}")
    return found[0], factor or 1


def find_masks(
    images: Sequence[ColmapImage], files: Sequence[Path], photos: Path, root: Path, folders: Sequence[str]
) -> list[Path | None]:
    """The mask of each photo: the one that its model names, or the one of its name in a folder.

    Of ``cam/1.jpg`` that is ``cam/1.jpg.png`` (as COLMAP has it), ``cam/1.png`` (as nerfstudio has it) or
    ``cam/1_mask.png``, with any suffix of a photo. Without the usual folder, masks are taken from the only place that
    has some: a folder whose name says so, or beside the photos.

    Args:
        images: The photos.
        files: Their files.
        photos: Folder that these are in.
        root: Scene folder.
        folders: Names of folders of masks in it; the first one that exists counts.

    Raises:
        SceneError: A mask that the model names does not exist, or two files fit a photo.
    """
    given = [image.mask for image in images]
    lost = dict.fromkeys(path for path in given if path and not path.is_file())
    if lost and folders[-1] == "masks":
        raise SceneError(f"{len(lost)} masks do not exist, first {next(iter(lost))}: copy them, or remove mask_path")
    given = [None if path in lost else path for path in given]
    relative = [str(path.relative_to(photos)) if path.is_relative_to(photos) else path.name for path in files]
    named = [(image.name, name) for image, name in zip(images, relative, strict=True)]
    has_own = any(given) and folders[-1] == "masks"  # another folder is meant in their place
    usual = [root / name for name in folders if (root / name).is_dir()][:1]
    places = usual
    if not usual and not has_own and folders[-1] == "masks":
        photos, top = photos.absolute(), root.absolute()
        around = {top, photos, *(place for place in photos.parents if place.is_relative_to(top))}
        below = sorted({path for place in around for path in place.glob("*")})
        places = [path for path in below if _OF_MASKS.search(path.name) and path.is_dir()]
        places.append(photos)
    found = {place: masks for place in places if any(masks := masks_in(place, named, files, place == photos))}
    shown = " and ".join(map(str, found or usual or places[:-1]))
    if len(found) == 1:
        if not usual:
            log.info(f"masks are read from {shown}")
        (masks,) = found.values()
        first, second = (given, masks) if has_own else (masks, given)
        return [one or other for one, other in zip(first, second, strict=True)]
    if found:
        log.warning(f"masks in {shown} are not used: choose a folder (--data.masks)")
    elif shown and not has_own:
        name = Path(relative[0])
        png = name.with_suffix(".png")
        log.warning(f"{shown} has no mask of any photo: that of {name} would be {name}.png or {png}; not used")
    elif not places and not has_own:
        log.warning(f"there is no folder {root / folders[-1]}: no photo has a mask")
    elif any(path.name.startswith("dynamic_mask_") for path in photos.glob("*")):
        log.warning(f"dynamic_mask_* in {photos} are not used: white leaves out in them; put inverted ones in masks/")
    return given


# What masks are called beside the stem of their photo, which may have been converted from a kind that is not in PHOTOS.
_MASK_NAMES = ("{}_mask", "{}.mask", "mask_{}", "{}.heic", "{}.heif", "{}.avif")


def masks_in(folder: Path, named: Sequence[tuple[str, str]], photos: Sequence[Path], beside: bool) -> list[Path | None]:
    """The masks in a folder of photos by either name: no photos; ``beside`` these, none has the name of its photo."""
    files = _Files(folder, sorted({*photos_below(folder)} - {*photos}))
    found: list[Path | None] = []
    for names in named:
        wanted = [f"{name}.png" for name in names]
        stems = [PurePosixPath(_stem(_key(name))) for name in names]
        wanted += [] if beside else map(str, stems)
        whole = map(PurePosixPath, names)  # DSC_0001.jpg.mask.png of RealityScan
        wanted += [str(name.with_name(form.format(name.name))) for name in (*stems, *whole) for form in _MASK_NAMES]
        fitting = next(filter(None, map(files.nearest, wanted)), [])
        if len(fitting) > 1:
            raise SceneError(f"{fitting[0]} and {fitting[1]} are masks of {names[0]}: remove one of them")
        found += fitting or [None]
    return found
