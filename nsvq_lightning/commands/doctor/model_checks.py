"""Checks of a model: cameras, points, and how the views overlap."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from nsvq_lightning.commands.doctor.finding import Finding, good, note, problem
from nsvq_lightning.data.colmap import ColmapModel
from nsvq_lightning.data.point_cloud import RANDOM_POINTS

__all__ = ["check_cameras", "check_overlap", "check_points", "corner_shift", "shared_points"]

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
FEW_POINTS = 1000
FAR = 10.0
"""An outlier is this many times farther from the median than four fifths of the points are."""
MANY_OUTLIERS = 0.02
SEEN_BY, SEEN_WELL = 3, 0.5
"""A point seen by two views may be a wrong match; three confirm each other. At least this share should have three."""
COMMON, LITTLE_OVERLAP = 15, 0.3
"""Points that two views must share to count as connected, and the least share of its points with its best partner."""
SHOWN = 3


def check_cameras(model: ColmapModel) -> Iterator[Finding]:
    """Number, models and sizes of the cameras, and what distortion does to the corners."""
    used = Counter(image.camera_id for image in model.images)
    cameras = [model.cameras[number] for number in used]
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    names = sorted({camera.model_name for camera in cameras})
    text = f"{len(cameras)} of {'/'.join(names)}, {_sizes(sizes)}, for {len(model.images)} registered photos"
    values = {"cameras": len(cameras), "models": names, "sizes": sizes, "photos": len(model.images)}
    if model.source == "COLMAP" and len(cameras) > max(1, len(model.images) // 2) and len(sizes) <= 2:
        help_ = "if one lens took them, COLMAP with --ImageReader.single_camera 1 calibrates it more exactly"
        yield note("cameras", f"{text}: nearly every photo has a camera of its own; {help_}", **values)
    else:
        yield good("cameras", text, **values)
    yield _distortion([camera for camera in cameras if camera.model_name not in PINHOLES])


def _sizes(sizes: list[tuple[int, int]]) -> str:
    first, last = (f"{width}x{height}" for width, height in (sizes[0], sizes[-1]))
    return first if len(sizes) == 1 else f"{len(sizes)} sizes from {first} to {last}"


def _distortion(distorted: list[Any]) -> Finding:
    if not distorted:
        return good("distortion", "none: photos are used as they are")
    shifts = [corner_shift(camera) for camera in distorted]
    if not np.isfinite(shifts).all():
        text = "the model of a camera has no values at the corners of its photos; they will be black"
        return note("distortion", f"{text}: undistort with COLMAP first and check the result")
    text = f"moves corners by up to {max(shifts):.1f} px; photos are undistorted when they are decoded"
    return good("distortion", text, largest_shift=max(shifts))


def corner_shift(camera: Any) -> float:
    """Largest distance in pixels by which a camera's model moves a corner of its pinhole picture; NaN if undefined."""
    K = np.asarray(camera.calibration_matrix())
    corners = np.array([(x, y) for x in (0.0, camera.width) for y in (0.0, camera.height)])
    rays = np.column_stack([(corners - K[:2, 2]) / (K[0, 0], K[1, 1]), np.ones(4)])
    return float(np.linalg.norm(np.asarray(camera.img_from_cam(rays)) - corners, axis=1).max())


def check_points(model: ColmapModel) -> Iterator[Finding]:
    """Number of points, outliers, and how many views saw them."""
    points = model.points
    if not len(points):
        help_ = "name a point cloud (ply_file_path in the file), or run COLMAP"
        text = f"none in {model.source}: {RANDOM_POINTS:,} random ones take their place, and training has more to do"
        yield note("points", f"{text}; {help_}" if not model.synthetic else text, points=0)
        return
    finite = points[np.isfinite(points).all(1)]
    if not len(finite):
        yield problem("points", f"none is finite: run {'COLMAP' if model.source == 'COLMAP' else 'the export'} again")
        return
    distances = np.linalg.norm(finite - np.median(finite, axis=0), axis=1)
    far = float(np.mean(distances > FAR * max(float(np.quantile(distances, 0.8)), 1e-12)))
    text = f"{len(points):,}, {100 * far:.2g} % far outliers"
    values = {"points": len(points), "not_finite": len(points) - len(finite), "outliers": far}
    if len(finite) < len(points):
        text += f", {len(points) - len(finite)} not finite (left out)"
    if len(points) < FEW_POINTS:
        help_ = "training starts from them; take more photos with more overlap, or match more features"
        yield note("points", f"{text}: fewer than {FEW_POINTS:,}; {help_}", **values)
    elif far > MANY_OUTLIERS:
        yield note("points", f"{text}: they become floaters; filter them with `colmap point_filtering`", **values)
    else:
        yield good("points", text, **values)
    yield _tracks(model)


def _tracks(model: ColmapModel) -> Finding:
    pairs = model.observations
    if pairs is None or not len(pairs):
        return note("tracks", f"{model.source} has no observations, so the overlap of views is unknown")
    lengths = np.bincount(pairs[:, 0], minlength=len(model.points))
    share = float(np.mean(lengths >= SEEN_BY))
    text = f"{100 * share:.0f} % of the points were seen by {SEEN_BY} views or more, {lengths.mean():.1f} on average"
    values = {"seen_by_three": share, "mean": float(lengths.mean())}
    if share < SEEN_WELL:
        return note("tracks", f"{text}: many points are uncertain; take photos closer to each other", **values)
    return good("tracks", text, **values)


def check_overlap(model: ColmapModel) -> Iterator[Finding]:
    """Whether each view shares points with another, and all are connected."""
    if model.observations is None or not len(model.observations):
        return
    common = shared_points(model.observations, len(model.images))
    own = common.diagonal().copy()
    names = [image.name for image in model.images]
    np.fill_diagonal(common, 0)
    best = common.max(axis=1) / np.maximum(own, 1)
    groups, group_of = connected_components(common >= COMMON, directed=False)
    weak = np.flatnonzero(best < LITTLE_OVERLAP)
    values = {"median": float(np.median(best)), "least": float(best.min()), "groups": int(groups)}
    usual, least = (f"{100 * share:.0f} %" for share in (np.median(best), best.min()))
    text = f"a photo shares {usual} of its points with its best partner, at least {least}"
    if groups > 1:
        rest = [names[i] for i in np.flatnonzero(group_of != np.bincount(group_of).argmax())]
        help_ = f"take photos between them and the others, or leave them out: {_some(rest)}"
        yield note(
            "overlap", f"{text}; {len(rest)} hardly share points (under {COMMON}) with the rest; {help_}", **values
        )
    elif len(weak):
        help_ = "take photos in between"
        yield note("overlap", f"{text}; little for {_some([names[i] for i in weak])}: {help_}", **values)
    else:
        yield good("overlap", text, **values)


def _some(names: list[str]) -> str:
    return ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")


def shared_points(observations: NDArray[np.int64], views: int) -> NDArray[np.int64]:
    """Number of points that two views both saw ``[V, V]``; on the diagonal, those that one view saw.

    Args:
        observations: Point row and view row of each observation ``[O, 2]``, each pair once, O > 0.
        views: V.
    """
    ones = np.ones(len(observations), np.int64)
    shape = int(observations[:, 0].max()) + 1, views
    seen = csr_array((ones, (observations[:, 0], observations[:, 1])), shape=shape)
    counts: NDArray[np.int64] = (seen.T @ seen).toarray()
    return counts
