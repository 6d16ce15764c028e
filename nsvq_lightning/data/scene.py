"""A scene: registered views with pinhole cameras, sparse points, the split into train and test, and photos' detail."""

import math
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor
from tqdm import tqdm

from nsvq_lightning.compute.devices import to_device
from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.data.colmap import ColmapImage, ColmapModel, NoPhotosError, Pinhole, SceneError, larger_models
from nsvq_lightning.data.images import ImageSource, ImageStore, Picture, head_for, high_pass, is_cut, is_transparent
from nsvq_lightning.data.photo_files import find_masks, locate, photo_folder
from nsvq_lightning.data.points import in_picture, projected, random_points
from nsvq_lightning.data.transforms import read_poses
from nsvq_lightning.data.undistortion import rectify
from nsvq_lightning.io.atomic import StrPath
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.frame import EXTENT, Frame
from nsvq_lightning.splats.conventions import ZERO, Bools, Float32s, Float64s, Place, middle_of
from nsvq_lightning.top_level import log

T = TypeVar("T")

Factor = Literal[1, 2, 4, 8]
# Indices of views, ascending.
Rows = tuple[int, ...]

# So many cameras, and so many splats, are asked what cameras show, at most.
SOME_CAMERAS, SOME_SPLATS = 300, 20_000
# What is wrong with points and splats that are elsewhere (:func:`is_elsewhere`).
ELSEWHERE = (
    "are not where the photos show their colours: they are in other coordinates than the cameras; export both from one "
    "program, in one unit and with the same axes, poses from world to camera and quaternions wxyz"
)
# Fewer points than this only fill up what photos show, as those without colours do: before the others, 100 cost every
# sixth photo of bonsai255 0.9 dB.
FEW_POINTS = 500


def spread(rows: T, most: int) -> T:
    """At most so many of the rows of a list, an array or a tensor, evenly spread."""
    return rows[:: max(1, -(-len(rows) // most))]  # type: ignore[arg-type, index, no-any-return]  # no name for these


# Share of a scene's splats that its cameras show at least. On six scenes, their own cameras show 99 %; with y and z
# turned round or exchanged, 43 % at most.
MIN_SHOWN = 0.8
# Median distance of the cameras that a scene names from those that are found, as a share of their extent: more, and one
# of them has been moved.
MOVED = 0.1


def check_cameras(cameras: Sequence[Camera], means: Float32s, trained: Float64s | None = None) -> None:
    """Check that cameras show a scene: its splats, and each some of them; and that they are where it says.

    Another scale is not seen where a scene says nothing.

    Args:
        cameras: At least one.
        means: Positions ``[N, 3]``, N > 0.
        trained: Cameras of training that the scene itself names ``[C, 4]``, if it names any.

    Raises:
        ValueError: They are of another scene, or in other coordinates.
    """
    if trained is not None and len(trained):
        places = trained[:, :3]
        apart, _ = cKDTree([camera.packed_view[12:] for camera in cameras]).query(places)
        if np.median(apart) > MOVED * (np.ptp(places, axis=0).max() or 1):
            raise ValueError(f"{len(cameras)} cameras stand elsewhere than those that the scene was trained by")
    # Of a survey, each camera shows a place of its own.
    shown = seen_by(cameras, spread(means, 2000)).any(0).mean()
    shown = min(shown, seen_by(spread(cameras, SOME_CAMERAS), means).any(1).mean())
    if shown < MIN_SHOWN:
        others = "they are of another scene, or in other coordinates (x right, y down, z forward)"
        raise ValueError(f"{len(cameras)} cameras show {shown:.0%} of the scene's splats: {others}")


def seen_by(cameras: Sequence[Camera], means: Float32s) -> Bools:
    """Which of some of the positions ``[N, 3]`` are in the picture of which camera ``[C, P]``."""
    places = spread(means, SOME_SPLATS).astype(np.float64)
    return np.stack([in_picture(places, camera) for camera in cameras])


def check_photo(name: str, rgb: Tensor, *, nan: bool = False) -> None:
    """Refuse a photo of other numbers than uint8, or floats in [0, 1] or a little outside, as of a rendering.

    Args:
        name: What the error calls it.
        rgb: Photo ``[H, W, 3]``.
        nan: Whether some may be NaN.

    Raises:
        ValueError: It has others.
    """
    if rgb.dtype == torch.uint8:
        return
    low, high = rgb.float().aminmax()
    if not (rgb.is_floating_point() and (-0.5 < low <= high < 2 or (nan and rgb.isnan().any()))):
        raise ValueError(f"{name} is {rgb.dtype} of up to {high:g}, from {low:g}, not uint8 or float in [0, 1]")


@dataclass(frozen=True, eq=False)
class View:
    """One photo and its camera.

    Attributes:
        name: Name of the image in the COLMAP model.
        index: Position among all views of the scene, sorted by name.
        camera: Pinhole camera of the picture.
        image: ``[H, W, 3]`` uint8 RGB, black where it does not count; shared with the scene's cache, so read-only.
            One's own may be floats in [0, 1]; the loss of what is not finite skips its step.
        mask: Which pixels count ``[H, W]`` bool; None if all do.

    Raises:
        ValueError: The photo has other numbers.
    """

    name: str
    index: int
    camera: Camera
    image: Tensor
    mask: Tensor | None = None

    def __post_init__(self) -> None:
        check_photo(f"the photo {self.name}", self.image, nan=True)

    def to(self, device: torch.device | str, **kwargs: object) -> "View":
        """The view with its photo on another device, or itself if that is there already; Lightning moves batches by it.

        The camera stays: kernels take its numbers from the host.
        """
        image = to_device(self.image, device)
        if image is self.image:
            return self
        return replace(self, image=image, mask=None if self.mask is None else to_device(self.mask, device))

    def smaller(self, times: int) -> "View":
        """The view so many times smaller: each pixel is the mean of a square, and counts if all of the square does."""
        camera = self.camera.smaller(times)
        height, width = camera.height, camera.width

        def squares(pixels: Tensor) -> Tensor:
            return pixels[: height * times, : width * times].view(height, times, width, times, -1)

        levels = 255 if self.image.is_floating_point() else 1
        image = (squares(self.image).float().mean((1, 3)).clamp(0, 255 / levels) * levels).round().to(torch.uint8)
        mask = None if self.mask is None else squares(self.mask).all(3).all(1)[..., 0]
        return replace(self, camera=camera, image=image, mask=mask)


@dataclass(frozen=True, eq=False)
class Scene:
    """A posed photo set in the world frame of its files, which for training has another (:attr:`frame`).

    Attributes:
        root: Scene folder.
        names: Names of the views, sorted.
        cameras: Pinhole camera of each view, float32; scene units are those of the files.
        images: Pictures of the views, decoded at first use.
        points: Sparse points ``[P, 3]`` float32, scene units, except those at the centre of a camera or far away.
        colors: Their colours ``[P, 3]`` float32, RGB in [0, 1].
        train: Indices of the train views, ascending.
        test: Indices of the test views, ascending.
        extent: Of the cameras, scene units (:meth:`nsvq_lightning.rendering.frame.Frame.around`); 0 in one place.
        frame: Coordinates that it is trained in; those of the cameras by default, of an extent of about 5.
        split: Which views are the test views, in words.
        white: Whether the photos show objects in front of white, as those of NeRF-synthetic scenes do.
        grey: Whether the points have no colours: random ones, as there are none of SfM, or those of a program that does
            not look at the photos. They are grey then, as a splat that starts black stays black.
        cloud: Whether the points are those of another file or program than the cameras, and may be in other
            coordinates.
    """

    root: Path
    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    images: ImageStore
    points: Tensor
    colors: Tensor
    train: Rows
    test: Rows
    extent: float
    frame: Frame = Frame()  # noqa: RUF009  frozen
    split: str = "every 8th by name"
    white: bool = False
    grey: bool = False
    cloud: bool = False

    def __len__(self) -> int:
        return len(self.names)

    @property
    def train_cameras(self) -> list[Camera]:
        """Those of the train views."""
        return [self.cameras[index] for index in self.train]

    @cached_property
    def standard(self) -> "Scene":
        """The scene in its frame."""
        points = torch.from_numpy(self.frame.points(self.points.double().numpy())).float()
        cameras = tuple(map(self.frame.camera, self.cameras))
        return replace(self, cameras=cameras, points=points, extent=self.extent / self.frame.unit, frame=Frame())

    def thinned(self, most: int) -> "Scene":
        """The scene with at most so many of its points, evenly taken."""
        return replace(self, points=spread(self.points, most), colors=spread(self.colors, most))

    def covered(self) -> float:
        """Mean share of 8 x 8 cells of train photos in which points lie."""
        points, shares = spread(self.points, SOME_SPLATS).double().numpy(), []
        for camera in spread(self.train_cameras, SOME_CAMERAS):
            column, row, _ = projected(points, camera)
            cells, *_ = np.histogram2d(column, row, 8, [[0, camera.width], [0, camera.height]])
            shares.append((cells > 0).mean())
        return float(np.mean(shares))

    def with_random_points(self) -> "Scene":
        """The scene with random points in place of its own."""
        points = torch.from_numpy(random_points(spread(self.train_cameras, SOME_CAMERAS))).float()
        return replace(self, points=points, colors=torch.full_like(points, 0.5), grey=True)

    def view(self, index: int) -> View:
        """View ``index`` of all views.

        Raises:
            SceneError: Its image cannot be decoded.
        """
        return View(self.names[index], index, self.cameras[index], *self.images[index])


# Distance of the cameras from the origin, in extents, from which files have another: float32 would be too coarse.
_FARTHEST = 100
# A camera or a point so many times as far from the middle as four fifths of its kind has gone astray.
_CAMERA_ASTRAY = 10
_POINT_ASTRAY = 100
# Distance from a camera's centre, in extents, within which a point is a failed triangulation, not a surface.
_AT_CAMERA = 1e-6
# Cameras that are so near to each other, over the distance of points from them, are in one place.
_NO_PARALLAX = 1e-4
# So few points of a model are taken as they are.
_FEW_POINTS = 1000
ONE_PLACE = "are taken from one place, or points are in other coordinates: no depth shows; move while taking photos"


def load_scene(
    root: StrPath,
    factor: Factor | None = None,
    max_width: int | None = 1600,
    test_every: int = 8,
    cache_bytes: int = 4 << 30,
    images_folder: str = "images",
    model: str | None = None,
    masks: str | None = "masks",
    allow_outside: bool = False,
    origin: Place = ZERO,
) -> Scene:
    """Load a scene: photos, and the cameras of a COLMAP model (binary or text) or of a transforms file.

    The model is in ``sparse``, ``sparse/0`` or the folder itself; if there is none, ``transforms.json`` (nerfstudio,
    instant-ngp, Polycam) or ``transforms_train.json`` and ``transforms_test.json`` (NeRF-synthetic) take its place.
    They say where the photos are. Without these, the only COLMAP model anywhere in the folder is read. A folder without
    points gets random ones. Photos that cannot be read are left out, with a warning.

    Pixels that a mask excludes (see :func:`nsvq_lightning.data.photo_files.find_masks`) or that are transparent do not
    count: no loss and no metric depends on them. Only NeRF-synthetic scenes are shown in front of white instead.

    Pinhole images are used as they are; those of any other camera model are undistorted when they are decoded, like
    COLMAP's ``image_undistorter`` does.

    Args:
        root: Scene folder.
        factor: Divide the image size by 1, 2, 4 or 8, from the folder ``images_2`` (4, 8) where there is one. None
            scales images wider than ``max_width`` down to that width and leaves the others unchanged.
        max_width: Largest width in pixels where ``factor`` is None; None for no limit.
        test_every: Every ``test_every``-th of the sorted image names is a test view, starting with the first, unless
            the transforms files say which are.
        cache_bytes: Memory for decoded images in bytes, see :class:`~nsvq_lightning.data.images.ImageStore`.
        images_folder: Name of the image folder; a transforms file says itself where the photos are.
        model: Which model, see :func:`nsvq_lightning.data.transforms.read_poses`; None looks for one.
        masks: Name of the folder of masks, which need not exist; None ignores masks.
        allow_outside: Also read photos and masks that the model names outside the scene folder.
        origin: What positions are to be relative to, as those of splats are; where it is 0, that is the middle of the
            cameras if they are far away.

    Raises:
        NoPhotosError: All photos are missing; :func:`load_cameras` needs none.
        SceneError: The folder, the model or a photo is missing, the model is damaged, or the split leaves no train
            view.
        ValueError: An argument is out of range.
    """
    if factor is not None and factor not in get_args(Factor):
        raise ValueError(f"factor must be None, 1, 2, 4 or 8, got {factor}")
    if max_width is not None and max_width < 1:
        raise ValueError(f"max_width must be None or at least 1 pixel, got {max_width}")
    if not test_every or test_every < 2:
        raise ValueError(f"test_every must be at least 2 (1 leaves no train view), got {test_every}")
    root = Path(root).expanduser()
    poses = read_poses(root, model, allow_outside=allow_outside)
    if model is None and poses.source == "COLMAP" and (larger := larger_models(root)):
        log.warning(f"{root}: {larger}")
    names = [image.name for image in poses.images]
    train, test, split = _split(root, poses, names, test_every)
    if images_folder in (None, "images"):
        images_folder = poses.images_folder or "images"
    folder, divisor = photo_folder(root, images_folder, factor, names)
    found = locate(names, folder, f"the {poses.source} model of {root}", allow_outside)
    files = [found[name] for name in names]
    if lost := [name for name in names if not found[name].is_file()]:
        raise (NoPhotosError if len(lost) == len(names) else SceneError)(
            f"{len(lost)} of {len(names)} images of the model are not in {folder}, first {lost[0]}: "
            "copy the photos that COLMAP was run on into that folder, under the same names"
            f"{', or leave factor out' if divisor == 1 and factor else ''}"
        )
    mask_files: list[Path | None] = [None] * len(files)
    if masks is not None:
        mask_files = find_masks(poses.images, files, folder, root, [f"{masks}_{factor}", masks] if factor else [masks])
    sources = _image_sources(poses, files, mask_files, divisor, max_width if factor is None else None)
    poses, frame, near = _framed(poses, root, origin)
    cameras = tuple(_camera(image, source.pinhole, near) for image, source in zip(poses.images, sources, strict=True))
    points, colors, extent = _points(poses, frame)
    grey = poses.colors.size > 0 and not np.ptp(poses.colors)
    if grey:
        log.info(f"the points of {root} have no colours: they start grey, behind those that photos show")
        colors = torch.full_like(colors, 128 / 255)
    images = ImageStore(sources, cache_bytes)
    scene = Scene(
        root=root,
        names=tuple(names),
        cameras=cameras,
        images=images,
        points=points,
        colors=colors,
        train=train,
        test=test,
        extent=extent,
        frame=frame,
        split=split,
        white=poses.synthetic and _in_front_of_white(images),
        grey=grey,
        cloud=poses.cloud,
    )
    if not len(scene.points):
        scene = scene.with_random_points()
        log.info(f"{root} has no points: {len(scene.points)} random ones in what the cameras see take their place")
    return scene


def _split(root: Path, poses: ColmapModel, names: list[str], test_every: int) -> tuple[Rows, Rows, str]:
    """Indices of the train and of the test views, and in words which are the latter; warns of those of one camera.

    Raises:
        SceneError: There is no train or no test view.
    """
    views = range(len(names))
    if poses.test is None:
        test = tuple(views[::test_every])
        split = f"every {test_every}th by name"
        advice = "register more photos"
        last = [re.split(r"\D+", Path(name).stem)[-1] for name in names]
        if len(set(last[::test_every])) == 1 < min(len(test), len(set(last))):
            log.warning(
                f"all {len(test)} test photos end in {last[0]}, as those of one camera of a rig: what it shows is not "
                f"trained on; --data.test_every={test_every + 1} takes turns"
            )
    else:
        test = poses.test
        split = f"as {poses.source} says"
        advice = "check what it lists"
    train = tuple(sorted(set(views) - set(test)))
    if not train or not test:
        raise SceneError(
            f"{root}: {len(views)} registered image(s), test views {split}, leave {len(train)} train and {len(test)} "
            f"test views; at least 1 of each is needed: {advice}"
        )
    return train, test, split


def _points(poses: ColmapModel, frame: Frame) -> tuple[Tensor, Tensor, float]:
    """The points that are of use, their colours, and the extent of the cameras; warns of points that are not."""
    centres = np.stack([image.centre for image in poses.images])
    finite = np.isfinite(poses.points).all(1)
    usable = finite & ~astray(poses.points, _POINT_ASTRAY)
    distances, _ = cKDTree(centres).query(poses.points[finite])
    # What is left of one place by rounding is no parallax.
    parallax = np.ptp(centres, axis=0).max() > _NO_PARALLAX * np.median(np.append(distances, 0))
    extent = EXTENT * frame.unit if parallax else 0.0
    # At a camera's centre a point has no direction; splats there are in no view, or cover that camera's whole view.
    usable[finite] &= distances > _AT_CAMERA * extent
    if not usable.all():
        text = f"left out {np.sum(~usable)} of {len(usable)} points"
        log.warning(f"{text}: they are at the centre of a camera, or far from all others")
    points, colors = (torch.from_numpy(each[usable]).float() for each in (poses.points, poses.colors))
    return points, colors / 255, extent


def _in_front_of_white(images: ImageStore) -> bool:
    """Whether photos of objects have white behind these: transparent ones, and by its first row the first of others."""
    for index, source in enumerate(images.sources):
        with suppress(SceneError):  # it is left out later
            white = np.quantile(images[index].image[0], 0.75) > 250
            return bool(white) or (source.has_alpha and is_transparent(source.path))
    return False


OTHER_SHAPE = (
    "have another aspect ratio than their camera: they were cropped, rotated, undistorted (a few percent smaller or "
    "larger) or mixed up after COLMAP ran; copy the photos it ran on, or the model of these"
)


# With more distorted cameras than this (say, one per photo), the undistortion maps would take more than the images.
MAX_CAMERAS_WITH_MAPS = 8


def _image_sources(
    model: ColmapModel, paths: list[Path], masks: list[Path | None], divisor: int, max_width: int | None
) -> list[ImageSource]:
    """One source per view; views with the same camera and file size share their undistortion."""
    used = [model.cameras[image.camera_id] for image in model.images]
    sized = [(path, (camera.width, camera.height)) for path, camera in zip(paths, used, strict=True)]
    heads = [head_for(*each) for each in sized]
    if any(head.orientation != 1 for head in heads):
        # The program followed EXIF, so it did where that changes no shape, too.
        heads = [head_for(*each, as_shown=True) for each in sized]
        turned = sum(head.orientation != 1 for head in heads)
        log.info(f"{turned} of {len(heads)} photos are turned by their EXIF orientation, as their cameras are")
    elif lying := sum(head_for(path, size[::-1], as_shown=True).orientation != 1 for path, size in sized):
        log.warning(f"{lying} photos are stored on their side, so the scene is: nsvq prepare turns what is elsewhere")
    if others := sum(is_cut(head.size, size) for head, (_, size) in zip(heads, sized, strict=True)):
        log.warning(f"{others} of {len(heads)} photos {OTHER_SHAPE}")
    kinds = [(image.camera_id, head.size) for image, head in zip(model.images, heads, strict=True)]
    keep_maps = len(set(kinds)) <= MAX_CAMERAS_WITH_MAPS
    lenses, odd = {}, []
    for number, size in dict.fromkeys(kinds):
        full, undistortion = rectify(model.cameras[number], *size, keep_maps=keep_maps)
        odd += _odd_lens(number, full, size)
        lens = _scaled(full, divisor, max_width)
        if undistortion and 2 * lens.width < full.width:  # what is made half as large afterwards is sharp
            undistortion.scale_to(lens.scaled(2, 2))
        lenses[number, size] = undistortion, lens
    if odd:
        log.warning(f"{odd[0]}{f' ({len(odd) - 1} more are odd)' if odd[1:] else ''}")
    return [
        ImageSource(path, head.size, *lenses[kind], head.orientation, mask, head.has_alpha, model.synthetic)
        for path, head, kind, mask in zip(paths, heads, kinds, masks, strict=True)
    ]


def _odd_lens(number: int, lens: Pinhole, size: tuple[int, int]) -> list[str]:
    """What numbers lenses hardly have, or that undistortion leaves less than half of photos of a size, if so."""
    (fx, _, cx), (_, fy, cy) = lens.K[:2].tolist()
    is_usual = 0.5 * fy < fx < 2 * fy and 0.1 < cx / lens.width < 0.9 and 0.1 < cy / lens.height < 0.9
    is_usual &= 0.1 < fx / lens.width < 20  # pixels, not millimetres
    if is_usual and 2 * lens.width * lens.height >= math.prod(size):
        return []
    return [
        f"camera {number} is odd: focal lengths {fx:.4g} and {fy:.4g} pixels, centre ({cx:.4g}, {cy:.4g}), and "
        f"{lens.width}x{lens.height} of {size[0]}x{size[1]} pixels are left without distortion: were photos "
        "scaled, cropped or turned after it was calibrated?"
    ]


def _scaled(lens: Pinhole, divisor: int, max_width: int | None) -> Pinhole:
    scale = min(1 / divisor, (max_width or math.inf) / lens.width)
    return lens.scaled(scale, scale)


def load_cameras(
    root: StrPath, factor: Factor | None = None, max_width: int | None = 1600, model: str | None = None, **rest: Any
) -> dict[str, Camera]:
    """Cameras of a scene folder by the names of its photos, which need not be there; those of :func:`load_scene`.

    Options are those of that function, ``origin``, too; the others make no difference.

    Raises:
        SceneError: There is no model, or it is damaged; or it does not say how large the photos are.
    """
    root = Path(root)
    poses, _, near = _framed(read_poses(root, model, allow_outside=True), root, rest.get("origin", ZERO))
    lenses = {}
    for number, lens in poses.cameras.items():
        full, _ = rectify(lens, lens.width, lens.height, keep_maps=False)
        lenses[number] = _scaled(full, factor or 1, max_width if factor is None else None)
    return {image.name: _camera(image, lenses[image.camera_id], near) for image in poses.images}


S = TypeVar("S")


def in_parallel(function: Callable[[S], T], items: Sequence[S], title: str) -> list[T]:
    """What a function gives for each item, with a thread a core and a bar that disappears."""
    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(tqdm(pool.map(function, items), title, len(items), leave=False, disable=None))


def each_photo(scene: Scene, say: Callable[[Picture], T]) -> list[T | SceneError]:
    """What there is to say of the picture of each view, or why there is none: damaged photos, and wholly masked ones.

    All photos are decoded, several at a time, and kept as far as the memory for them lasts.
    """

    def look(index: int) -> T | SceneError:
        try:
            return say(scene.images[index])
        except SceneError as error:
            return error

    return in_parallel(look, range(len(scene)), "photos")


def colors_at(scene: Scene, places: Float64s, width: int, *, of_near: bool = False) -> tuple[Float64s, ...]:
    """Colours that train photos have at places ``[P, 3]``, walls disregarded.

    Args:
        scene: At most 300 of its train photos are decoded.
        places: In its coordinates.
        width: Of the square around a place whose mean colour it is, pixels.
        of_near: A photo counts in inverse proportion to a place's depth: between those far away are often walls.

    Returns:
        Their sums ``[P, 3]`` in bytes and their numbers ``[P, 1]``, both of pixels that count, and the numbers of all.
    """
    sums, photos, sightings = np.zeros_like(places), *np.zeros((2, len(places), 1))
    for index in spread(scene.train, SOME_CAMERAS) if places.size else ():
        (image, mask), camera = scene.images[index], scene.cameras[index]
        rows = np.flatnonzero(in_picture(places, camera))
        column, row, depth = projected(places[rows], camera)
        pixels = row.astype(np.intp), column.astype(np.intp)
        weights = 1 / depth[:, None] if of_near else np.ones((len(rows), 1))
        counts = weights if mask is None else weights * mask.numpy()[pixels][:, None]
        sums[rows] += counts * cv2.blur(image.numpy(), (width, width))[pixels]
        photos[rows] += counts
        sightings[rows] += weights
    return sums, photos, sightings


def exposures(scene: Scene) -> Tensor:
    """How bright each train photo is in red, green and blue, beside others that show the same points ``[V, 3]``.

    1 is usual. Photos without points, and all where points are few or random, have that, too.
    """
    if scene.grey or len(scene.points) < FEW_POINTS:
        return torch.ones(len(scene.train), 3)
    places, levels = spread(scene.points, 2000).double().numpy(), []
    for index in scene.train:
        sums, photos, _ = colors_at(replace(scene, train=(index,)), places, 5, of_near=True)
        photos[photos < np.quantile([*photos[photos > 0], 0], 2 / 3)] = np.nan  # what is far may be behind a wall
        levels.append(torch.from_numpy(sums + photos).float() / torch.from_numpy(photos).float())  # NaN where not shown
    logs = torch.stack(levels).log()
    return (logs - logs.nanmedian(0).values).nanmedian(1).values.nan_to_num(0).exp()


def uneven(scene: Scene) -> str:
    """What is wrong with the exposures of train photos, by some of them; nothing where they are even."""
    some = replace(scene, train=spread(scene.train, SOME_CAMERAS))
    low, high = exposures(some).mean(1).log().quantile(torch.tensor([0.16, 0.84])).tolist()
    # Half of it is the deviation but for a few photos, as of a lens cap. Six scenes have 0.1 at most; with two stops
    # more or less at random 0.29 to 0.41, with gammas of 0.6 to 1.6 0.17 to 0.49.
    if high - low < 0.28:
        return ""
    return f"differ in brightness by {50 * (high - low):.0f} %: see ExposureCompensation in docs/your_photos.md"


def is_elsewhere(scene: Scene) -> bool:
    """Whether points are not where the photos show them, as colours tell; intensities do not.

    Few points are taken as they are, unless they are of another file than the cameras.
    """
    if not (scene.cloud or len(scene.points) > _FEW_POINTS) or not scene.colors.diff().any():
        return False
    sums, photos, sightings = colors_at(scene, spread(scene.points, SOME_SPLATS).double().numpy(), 5, of_near=True)
    rows = np.flatnonzero(photos > sightings / 2)  # before and behind what masks leave, colours are not theirs
    if 500 * len(rows) < len(sums):  # of other coordinates, a few are in photos by chance
        return True
    both = sums[rows] / photos[rows], spread(scene.colors, SOME_SPLATS)[rows]
    shown, known = (colors - colors.mean(0) for colors in both)  # a cast, as under water, says nothing of places
    # On six scenes, points in their place have a correlation of 0.63 to 0.86, in 4 to 16 rooms 0.59 to 0.66; with axes
    # turned round or exchanged, or 1000 times as far away, 0.51 at most. A scene's own points have 0.40 at most with
    # poses from camera to world or quaternions xyzw.
    return not np.corrcoef(shown.ravel(), known.ravel())[0, 1] > (0.5 if scene.cloud else 0.42)


def check_colors(scene: Scene, means: Float32s, sh0: Float32s) -> None:
    """Check that splats, unless they are few, are where some of a scene's train photos show their colours.

    Another scale shows so (:func:`is_elsewhere`), and what is turned about its cameras, as in nerfstudio's frame.

    Args:
        scene: Its photos and cameras.
        means: Positions ``[N, 3]`` in its coordinates.
        sh0: Coefficients ``[N, 1, 3]``.

    Raises:
        ValueError: They are elsewhere.
    """
    points, colors = torch.from_numpy(means), torch.from_numpy(sh0).flatten(1).clamp(-2, 2)
    with suppress(SceneError):  # damaged and wholly masked photos say nothing
        # Of many rooms, fewer photos show too little: there, walls decide.
        if is_elsewhere(replace(scene, points=points, colors=colors, cloud=False, train=spread(scene.train, 60))):
            raise ValueError(f"splats {ELSEWHERE}")


def usable(scene: Scene) -> Scene:
    """The scene without the train and test views of which there is no picture (:func:`each_photo`); warns of them.

    Points of another file that are elsewhere (:func:`is_elsewhere`) make way for random ones; warns of others.

    Raises:
        SceneError: No train or no test view is left.
    """
    if wrong := {index: error for index, error in enumerate(each_photo(scene, lambda _: None)) if error}:
        first = next(iter(wrong.values()))
        train, test = (tuple(view for view in views if view not in wrong) for views in (scene.train, scene.test))
        if not train or not test:
            raise first
        log.warning(f"left out {len(wrong)} of {len(scene)} photos, first: {first}")
        scene = replace(scene, train=train, test=test)
    if is_elsewhere(scene):
        log.warning(f"the points of {scene.root} {ELSEWHERE}{'; random ones take their place' * scene.cloud}")
        if scene.cloud:
            return replace(scene.with_random_points(), extent=EXTENT * scene.frame.unit)
    return scene


# The near plane is at most so many times as far away as the nearest hundredth of the points is from its cameras, and at
# least so many times as far as it is where cameras go around what they show.
_NEAREST, _MIN_NEAR = 0.25, 1e-3


def _framed(model: ColmapModel, root: Path, origin: Place) -> tuple[ColmapModel, Frame, float]:
    """The model with an origin near its cameras, their frame, and their near plane; warns of cameras that went astray.

    Along a way, what is near is nearer than a share of the cameras' extent.
    """
    centres = np.stack([image.centre for image in model.images])
    frame = Frame.around(centres)
    lost = np.flatnonzero(astray(centres, _CAMERA_ASTRAY))
    if len(lost):
        first = model.images[lost[0]].name
        log.warning(f"{len(lost)} photos are far from all others, first {first}: check its pose, or leave it out")
    distance = np.linalg.norm(frame.middle) / (EXTENT * frame.unit)
    if not any(origin) and distance >= _FARTHEST:
        origin = frame.middle
        log.info(f"{root}: positions are relative to {origin}, as 0 is {distance:.0f} extents away")
    points = spread(model.points[np.isfinite(model.points).all(1)], SOME_SPLATS)
    nearest = np.quantile(cKDTree(centres).query(points)[0], 0.01) if len(points) else math.inf
    near = frame.near * float(np.clip(_NEAREST * nearest / frame.near, _MIN_NEAR, 1))
    if not any(origin):
        return model, frame, near
    views = np.stack([image.viewmat for image in model.images])
    views[:, :3, 3] += views[:, :3, :3] @ origin
    images = tuple(replace(image, viewmat=view) for image, view in zip(model.images, views, strict=True))
    return replace(model, images=images, points=model.points - origin), frame.relative_to(origin), near


def astray(places: Float64s, times: float) -> Bools:
    """Which places ``[P, 3]`` are much farther from the middle than the others; none of those that are not finite.

    Args:
        places: Some of which may not be finite.
        times: As far as four fifths of them, from where on they are astray.
    """
    finite = places[np.isfinite(places).all(1)]
    if not len(finite):
        return np.zeros(len(places), bool)
    middle, usual = middle_of(finite)
    with np.errstate(invalid="ignore"):
        distances = np.linalg.norm(places - middle, axis=1)
    return (distances > times * usual) & (usual > 0)  # type: ignore[no-any-return]


def _camera(image: ColmapImage, lens: Pinhole, near: float) -> Camera:
    pose = torch.from_numpy(image.viewmat)
    try:
        return Camera(torch.from_numpy(lens.K), pose, lens.width, lens.height, near).to(dtype=torch.float32)
    except ValueError as error:
        camera = f"camera {image.camera_id} of image {image.name}"
        raise SceneError(f"{camera}: {error}; run COLMAP again, or give angles in radians") from error


# High-pass value, of grey values up to 255, from which a pixel counts as detailed: well above the noise of a photo. In
# fog or in the dark it is a share of the standard deviation, above what rounding leaves.
_DETAIL, _CONTRAST, _ROUNDING = 20, 0.6, 6
# Photos that are looked at for the detail of a scene.
_SAMPLE = 32


def detailed_pixels(scene: Scene) -> float:
    """Pixels of a train photo that differ clearly from their neighbours, on average over the photos.

    Args:
        scene: At most 32 of its photos, evenly spaced, are decoded.

    Raises:
        SceneError: An image cannot be decoded.
    """
    counts = []
    for picture in (scene.images[index] for index in spread(scene.train, _SAMPLE)):
        counting = picture.image[... if picture.mask is None else picture.mask].numpy()
        least = np.clip(_CONTRAST * counting.std(), _ROUNDING, _DETAIL)
        counts.append(np.count_nonzero(np.abs(high_pass(*picture, cv2.CV_16S)) > least))
    return sum(counts) / len(counts)


def stretch(scene: Scene) -> float:
    """How much more there is to see than around one place, from 1 to 8: more along a walk.

    It is 1 where a fifth of the train photos or more show the usual point, or few points say so.
    """
    cameras, places = spread(scene.train_cameras, SOME_CAMERAS), spread(scene.points, SOME_SPLATS).double().numpy()
    apart = cdist([camera.packed_view[12:] for camera in cameras], places)
    apart[~seen_by(cameras, places)] = math.inf
    # What is more than twice as far away as in the nearest photo, as behind a wall, is not shown.
    shares = (apart < 2 * apart.min(0)).mean(0)
    shares = shares[shares > 0]
    return float(np.clip(0.2 / np.median(shares), 1, 8)) if len(shares) >= FEW_POINTS else 1.0
