"""The photos of a scene: whether they can be read, fit their cameras, and were exposed alike."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsvq_lightning.commands.doctor.finding import Finding, good, note, problem
from nsvq_lightning.data.colmap import ColmapModel
from nsvq_lightning.data.images import image_head
from nsvq_lightning.data.scene import OTHER_SHAPE, Scene, SceneError, same_shape
from nsvq_lightning.rendering.camera import Camera

__all__ = ["Photo", "check_exposure", "check_masks", "check_photos", "check_sizes", "exposure_of", "read_photos"]

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
GAMMA = 2.2
LOWEST = 4.0
"""Grey level below which noise and black clipping say nothing about exposure."""
ENOUGH = 30
"""Points that a view must see for their median brightness to give its exposure."""
MOSTLY = 0.7
"""Share of excluded pixels from which on masks may be inverted."""
UNEVEN = 0.5
"""Stops between the darkest and brightest tenth of the photos above which colours visibly disagree."""


@dataclass(frozen=True, eq=False)
class Photo:
    """What is kept of a decoded photo.

    Attributes:
        error: Why it could not be decoded, None if it could.
        brightness: Mean grey level, 0 to 255.
        exposure: How much brighter than in other photos its points are, in stops; None where it saw too few.
        counts: Share of its pixels that no mask excludes.
    """

    error: str | None = None
    brightness: float = 0.0
    exposure: float | None = None
    counts: float = 1.0


def read_photos(scene: Scene, model: ColmapModel) -> list[Photo]:
    """Decode all photos, in parallel, and keep the figures."""

    def read(index: int) -> Photo:
        try:
            image, mask = scene.images.sources[index].load()
        except (SceneError, OSError) as error:
            return Photo(error=str(error))
        counting = image if mask is None else image[mask]
        return Photo(
            None,
            float(counting.float().mean()),
            exposure_of(image, scene.cameras[index], model, rows.get(index)),
            1.0 if mask is None else float(mask.float().mean()),
        )

    rows = _rows_by_view(model)
    with ThreadPoolExecutor(max_workers=torch.get_num_threads()) as pool:
        return list(pool.map(read, range(len(scene))))


def _rows_by_view(model: ColmapModel) -> Mapping[int, NDArray[np.int64]]:
    if model.observations is None:
        return {}
    return {view: model.observations[model.observations[:, 1] == view, 0] for view in range(len(model.images))}


def exposure_of(image: Tensor, camera: Camera, model: ColmapModel, rows: NDArray[np.int64] | None) -> float | None:
    """Median over points of log2(light in this photo / light of the point's colour, its mean over all photos).

    Args:
        image: The photo ``[H, W, 3]`` uint8 RGB.
        camera: Its camera.
        model: The model that has the points.
        rows: Points of the model that the photo saw.

    Returns:
        Stops; None if it saw too few points that are neither black nor outside the picture.
    """
    if rows is None:
        return None
    points = torch.from_numpy(model.points[rows]).double()
    local = points @ camera.viewmat[:3, :3].T.double() + camera.viewmat[:3, 3].double()
    fx, fy, cx, cy = camera.intrinsics
    local, rows = local[local[:, 2] > 0], rows[(local[:, 2] > 0).numpy()]
    x, y = (fx * local[:, 0] / local[:, 2] + cx).floor(), (fy * local[:, 1] / local[:, 2] + cy).floor()
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    here = image[y[inside].long(), x[inside].long()].double().mean(1)
    usual = torch.from_numpy(model.colors[rows[inside.numpy()]]).double().mean(1)
    clear = (here > LOWEST) & (usual > LOWEST)
    if int(clear.sum()) < ENOUGH:
        return None
    return float(GAMMA * (here[clear] / usual[clear]).log2().median())


def check_photos(scene: Scene, photos: list[Photo], folder: Path) -> Iterator[Finding]:
    """Unreadable photos, and those in the folder that the model does not have."""
    broken = [photo.error for photo in photos if photo.error is not None]
    if broken:
        yield problem("photos", f"{len(broken)} of {len(photos)} cannot be used; first: {broken[0]}", errors=broken)
    else:
        yield good("photos", f"all {len(photos)} registered photos can be read")
    known = {Path(name).with_suffix("") for name in scene.names}
    # The folder of a NeRF-synthetic scene also holds maps and further views.
    found = folder.rglob("*") if folder != scene.root else ()
    files = [path.relative_to(folder) for path in found if path.suffix.lower() in SUFFIXES]
    extra = sorted(str(path) for path in files if path.with_suffix("") not in known)
    if extra:
        help_ = "they are not used; if many, photos lack overlap or sharpness"
        yield note(
            "registered", f"{len(extra)} of {len(files)} files in {folder} are not in the model: {help_}", files=extra
        )


def check_sizes(scene: Scene, model: ColmapModel) -> Iterator[Finding]:
    """Whether files have the size that the model says."""
    kinds = Counter[str]()
    for image, source in zip(model.images, scene.images.sources, strict=True):
        camera, (width, height) = model.cameras[image.camera_id], source.size
        if (width, height) != (camera.width, camera.height):
            kinds["scaled" if same_shape(camera, width, height) else "of another aspect ratio"] += 1
    used = Counter(f"{source.pinhole.width}x{source.pinhole.height}" for source in scene.images.sources)
    text = f"trained at {', '.join(size for size, _ in used.most_common(2))}{' and others' if len(used) > 2 else ''}"
    if kinds["of another aspect ratio"]:
        yield problem("sizes", f"{text}; {kinds['of another aspect ratio']} {OTHER_SHAPE}", **kinds)
    elif kinds["scaled"]:
        yield good("sizes", f"{text}; {kinds['scaled']} files are scaled, cameras are scaled with them", **kinds)
    else:
        yield good("sizes", f"{text}; files are of the size that {model.source} says")
    yield from _check_orientation(scene)


def _check_orientation(scene: Scene) -> Iterator[Finding]:
    """Say what becomes of photos that a phone stored lying on their side."""
    lying = [image_head(source.path).lies_on_its_side for source in scene.images.sources]
    turned = sum(source.orientation != 1 for source in scene.images.sources)
    stored = sum(lying) - turned
    if turned:
        yield good("orientation", f"{turned} photos are turned by their EXIF orientation, as their cameras are")
    if stored:
        text = f"{stored} photos are used as stored, not as their EXIF orientation says, like COLMAP did"
        yield good(
            "orientation", f"{text}: pictures of the report lie on their side, the scene does not", stored=stored
        )


def check_masks(scene: Scene, photos: list[Photo]) -> Iterator[Finding]:
    """How much of the photos masks and transparency exclude."""
    masked = [(photo.counts, name) for photo, name in zip(photos, scene.names, strict=True) if photo.counts < 1]
    if not masked:
        return
    share = 1 - float(np.mean([counts for counts, _ in masked]))
    text = f"{len(masked)} of {len(photos)} photos have pixels that do not count, {100 * share:.0f} % of them"
    values = {"masked": len(masked), "excluded": share}
    least = min(masked)
    if share > MOSTLY:
        help_ = "masks are white where the photo counts; if yours are black there, invert them"
        yield note("masks", f"{text}, most in {least[1]}; {help_}", **values)
    else:
        yield good("masks", text, **values)


def check_exposure(scene: Scene, photos: list[Photo]) -> Iterator[Finding]:
    """Whether photos were exposed alike: splats have one colour for all of them."""
    brightness = np.array([photo.brightness for photo in photos if photo.error is None])
    if not len(brightness):
        return
    middle = f"mean grey level {np.quantile(brightness, 0.1):.0f} to {np.quantile(brightness, 0.9):.0f}"
    stops = np.array([photo.exposure for photo in photos if photo.exposure is not None])
    if len(stops) < len(brightness) / 2:
        yield good("exposure", f"{middle}; without observations, exposure and content of a photo cannot be separated")
        return
    low, high = np.quantile(stops, 0.1), np.quantile(stops, 0.9)
    values = {"stops": [float(low), float(high)], "grey": [float(b) for b in brightness]}
    text = f"{middle}; the same points are {low:+.2f} to {high:+.2f} stops from their usual brightness"
    if high - low > UNEVEN:
        worst = max((p.exposure, name) for p, name in zip(photos, scene.names, strict=True) if p.exposure is not None)
        help_ = "lock exposure and white balance, or equalize the photos"
        yield note("exposure", f"{text} (brightest {worst[1]}): colours disagree; {help_}", **values)
    else:
        yield good("exposure", text, **values)
