"""Points that SfM does not find: where the photos have detail, from the flow between neighbours, and far away."""

import math
from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.linalg import norm
from scipy.spatial import cKDTree
from torch import Tensor

from nsvq_lightning.data.images import edges_of, resized
from nsvq_lightning.data.scene import Scene, colors_at, in_parallel
from nsvq_lightning.random import draw_rows, generator
from nsvq_lightning.rendering.frame import EXTENT
from nsvq_lightning.splats.conventions import Bools, Float32s, Float64s, Uint8s

# Largest error in pixels, of the flow there and back again and of the triangulated point.
MAX_ERROR = 0.7
# Triangulated pixels: positions ``[M, 3]``, colours ``[M, 3]`` and detail ``[M]``, both in bytes.
_Points = tuple[Float64s, Uint8s, Uint8s]


class _Photo(NamedTuple):
    """A train photo at the size of its flow, and its pinhole camera.

    Attributes:
        detail: Strength of the edges ``[h, w]``.
        counts: Which pixels count ``[h, w]``; None for all.
        rotation: World to camera ``[3, 3]``.
        depth: Median depth of the SfM points in front of the camera, scene units.
        features: Pixels ``[F, 2]`` and descriptors ``[F, 128]``, whole numbers of about the same norm; none where there
            are points of SfM.
    """

    image: Uint8s
    grey: Uint8s
    detail: Uint8s
    counts: Bools | None
    focal: Float64s
    centre: Float64s
    rotation: Float64s
    position: Float64s
    depth: float
    features: tuple[Float64s, Float32s]

    def project(self, points: Float64s) -> tuple[Float64s, Float64s]:
        """Pixels ``[M, 2]`` and depths ``[M]`` of points ``[M, 3]``."""
        local = (points - self.position) @ self.rotation.T
        return local[:, :2] / local[:, 2:] * self.focal + self.centre, local[:, 2]

    def rays(self, pixels: Float64s) -> Float64s:
        """Unit directions ``[M, 3]`` in the world of pixels ``[M, 2]``."""
        local = np.c_[(pixels - self.centre) / self.focal, np.ones(len(pixels))]
        return local / norm(local, axis=1, keepdims=True) @ self.rotation  # type: ignore[no-any-return]


# Candidates over all flows; of more pixels than that, every third, fourth, ... row and column is taken.
MAX_CANDIDATES = 12_000_000
# Edge of a cell over the median depth of the scene, and how many flows must find something in it.
CELL = 0.01
MIN_AGREEING = 3
# Detail of a flat pixel; and by which power of the number of points in its cell a point counts less.
MIN_DETAIL = 0.05
CROWDED = 0.7


def dense_points(scene: Scene, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Points on the surfaces that the train photos show, denser where these have detail.

    The flow between each photo and its nearest neighbours (DIS, Kroeger et al. 2016) is followed there and back again,
    and the pixels that return are triangulated. From what several flows agree on, points are drawn in proportion to
    the photos' detail. Where the scene comes without points, features are found again, too, also where photos are too
    far apart for the flow; where that finds nothing, they come first. Test photos are not looked at. The same scene,
    count and seed give the same bits, on any number of cores.

    Args:
        scene: Its train photos, cameras and SfM points; these say how far away things are.
        count: Most points.
        seed: Of the draw.

    Returns:
        Positions ``[P, 3]``, scene units, and colours ``[P, 3]``, RGB in [0, 1], float32; empty where flow finds
        nothing.

    Raises:
        SceneError: An image cannot be decoded.
    """
    known = scene.points.double().numpy()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # with several, DIS works in stripes, and its bits depend on how many
    try:
        photos = in_parallel(lambda index: _photo(scene, index, known), scene.train, "dense start: photos")
        pairs = _neighbours(photos, *NEAR)
        pixels = max(photo.grey.size for photo in photos)
        stride = max(2, math.ceil(math.sqrt(2 * len(pairs) * pixels / MAX_CANDIDATES)))
        found = in_parallel(lambda pair: _flows(*pair, stride), pairs, "dense start: flows")
        by_flow = sum(len(points) for points, *_ in chain(*found))
        pairs = _neighbours(photos, *WIDE) if scene.grey else []
        found.append(in_parallel(lambda pair: _matched(*pair), pairs, "dense start: features"))
    finally:
        cv2.setNumThreads(threads)
    if not any(found):
        return torch.empty(0, 3), torch.empty(0, 3)
    edge = CELL * np.median([photo.depth for photo in photos])
    del photos, pairs
    positions, colors, detail = (np.concatenate(parts) for parts in zip(*chain(*found), strict=True))
    found.clear()
    # Cells by one number each: 2^21 along an axis.
    cells = np.zeros(len(positions), np.int64)
    for axis in positions.T:
        cells = cells << 21 | np.floor(axis / edge).astype(np.int64) & (1 << 21) - 1
    _, cell, counts = np.unique(cells, return_inverse=True, return_counts=True)
    crowd = counts[cell]
    weight = np.where(crowd >= MIN_AGREEING, (detail / 255 + MIN_DETAIL) / crowd**CROWDED, 0)
    # Several points of features where the flow finds nothing come first, whatever the draw.
    weight[(np.bincount(cell[:by_flow], minlength=len(counts))[cell] == 0) & (crowd > 1)] = 1e30
    drawn = draw_rows(torch.from_numpy(weight), count, generator(seed, 0, "dense start")).numpy()
    return torch.from_numpy(positions[drawn]).float(), torch.from_numpy(colors[drawn]).float() / 255


# Photos are looked at with at most so many pixels on their longer side.
MAX_SIDE = 800
# Most features of a photo (SIFT, Lowe 2004), those of the strongest contrast.
MAX_FEATURES = 4000


def _photo(scene: Scene, index: int, known: Float64s) -> _Photo:
    camera = scene.cameras[index]
    image, mask = scene.images[index]
    scale = min(1.0, MAX_SIDE / max(camera.size))
    width, height = (round(side * scale) for side in camera.size)
    pixels, counts = resized(image.numpy(), None if mask is None else mask.numpy(), (width, height))
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    features = np.empty((0, 2)), np.empty((0, 128), np.float32)
    if scene.grey:
        sift = cv2.SIFT.create(MAX_FEATURES, contrastThreshold=0, enable_precise_upscale=True)
        points, descriptors = sift.detectAndCompute(grey, None if counts is None else counts.view(np.uint8))
        if points:
            features = np.array([point.pt for point in points]) + 0.5, descriptors
    edges = edges_of(torch.from_numpy(pixels), None if counts is None else torch.from_numpy(counts))
    view = camera.viewmat.double().numpy()
    rotation, translation = view[:3, :3], view[:3, 3]
    size = np.array([width / camera.width, height / camera.height])
    depths = known @ rotation[2] + translation[2]
    ahead = depths[depths > 0]
    return _Photo(
        image=pixels,
        grey=grey,
        detail=cv2.GaussianBlur((edges.strength() * 255).byte().numpy(), (0, 0), 1.5),
        counts=counts,
        focal=size * camera.intrinsics[:2],
        centre=size * camera.intrinsics[2:],
        rotation=rotation,
        position=-rotation.T @ translation,
        depth=float(np.median(ahead)) if len(ahead) else 0.0,
        features=features,
    )


# Largest distance of two cameras over the depth of what the first one sees, largest angle between their axes in
# degrees, and most neighbours of a photo: for the flow, and for features.
NEAR, WIDE = (0.35, 25.0, 3), (2.0, 60.0, 8)


def _neighbours(photos: list[_Photo], baseline: float, turned: float, most: int) -> list[tuple[_Photo, _Photo]]:
    """Each photo with those nearest to it that see the same from another place, each pair once."""
    positions = np.array([photo.position for photo in photos])
    axes = np.array([photo.rotation[2] for photo in photos])
    pairs = set()
    for i, photo in enumerate(photos):
        base = norm(positions - photo.position, axis=1)
        angle = np.degrees(np.arccos(np.clip(axes @ axes[i], -1, 1)))
        # Any nearer, there is no parallax.
        usable = (base > 0.02 * photo.depth) & (base < baseline * photo.depth) & (angle < turned)
        nearest = np.argsort(np.where(usable, base + 0.01 * photo.depth * angle, np.inf), kind="stable")
        pairs |= {(min(i, j), max(i, j)) for j in nearest[: min(most, usable.sum())].tolist()}
    return [(photos[i], photos[j]) for i, j in sorted(pairs)]


def _flows(a: _Photo, b: _Photo, stride: int) -> list[_Points]:
    """What two photos show of each other: the pixels of the first, then those of the second."""
    height, width = np.maximum(a.grey.shape, b.grey.shape)
    first, second = (
        cv2.copyMakeBorder(grey, 0, height - grey.shape[0], 0, width - grey.shape[1], cv2.BORDER_REPLICATE)
        for grey in (a.grey, b.grey)
    )
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there = dis.calc(first, second, None)
    back = dis.calc(second, first, None)
    return [_followed(a, b, there, back, stride), _followed(b, a, back, there, stride)]


def _followed(a: _Photo, b: _Photo, there: Float32s, back: Float32s, stride: int) -> _Points:
    """The pixels of ``a``, every ``stride``-th, that the flow leads to ``b`` and back again, triangulated."""
    height, width = a.grey.shape
    every = np.s_[:height:stride, :width:stride]
    flow = there[every]
    starts = np.moveaxis(np.mgrid[every][::-1], 0, 2).astype(np.float32)
    ends = starts + flow
    returned = flow + cv2.remap(back, ends, None, cv2.INTER_LINEAR)
    inside = (ends > 1) & (ends < np.array(b.grey.shape[::-1]) - 2)
    good = (norm(returned, axis=2) < MAX_ERROR) & inside.all(2)
    if a.counts is not None:
        good &= a.counts[every]
    if b.counts is not None:
        good &= cv2.remap(b.counts.view(np.uint8), ends, None, cv2.INTER_NEAREST) > 0
    return _triangulated(a, b, starts[good].astype(np.float64) + 0.5, ends[good].astype(np.float64) + 0.5)


def _matched(a: _Photo, b: _Photo) -> _Points:
    """Features of two photos that are most like each other, triangulated: some are not the same thing."""
    (start, ours), (end, theirs) = a.features, b.features
    alike = ours @ theirs.T  # exact, as all numbers are whole
    first, second = np.nonzero((alike == alike.max(1, keepdims=True, initial=0)) & (alike == alike.max(0, initial=0)))
    return _triangulated(a, b, start[first], end[second])


# Least angle of the two rays in degrees.
MIN_PARALLAX = 1.0
# Least and largest depth of a point over the median depth of what SfM found in the photo.
DEPTHS = (0.1, 20.0)


def _triangulated(a: _Photo, b: _Photo, start: Float64s, end: Float64s) -> _Points:
    """What is at pixels ``start [M, 2]`` of one photo and ``end [M, 2]`` of another, where that is one place."""
    u, v = a.rays(start), b.rays(end)
    apart = (u * v).sum(1) < np.cos(np.radians(MIN_PARALLAX))
    start, end, u, v = (each[apart] for each in (start, end, u, v))
    # The point nearest to both rays.
    cosine = (u * v).sum(1)
    between = b.position - a.position
    along_u, along_v = u @ between, v @ between
    s = (along_u - cosine * along_v) / (1 - cosine**2)
    t = (cosine * along_u - along_v) / (1 - cosine**2)
    points = 0.5 * (a.position + s[:, None] * u + b.position + t[:, None] * v)
    pixels_a, depths_a = a.project(points)
    pixels_b, depths_b = b.project(points)
    least, largest = (share * a.depth for share in DEPTHS)
    kept = (depths_a > least) & (depths_b > least) & (depths_a < largest)
    for pixels, expected in ((pixels_a, start), (pixels_b, end)):
        kept &= norm(pixels - expected, axis=1) < MAX_ERROR
    columns, rows = start[kept].astype(np.intp).T
    return points[kept], a.image[rows, columns], a.detail[rows, columns]


# Far points all around for each of the others, and how many times as far away they are as nearly all of these.
FAR_SHARE = 0.02
FAR = 2.0
# Share that is nearly all.
NEARLY_ALL = 0.95
# Width in pixels of the square around a far point whose mean colour it has in a photo; and of how many neighbouring
# points it has the mean then.
BLUR = 51
ALIKE = 8


def far_points(scene: Scene, points: Tensor) -> tuple[Tensor, Tensor]:
    """Points evenly on a sphere around a scene and its cameras, in the colours that train photos have there.

    Where few photos look, there may be nothing behind the things that they show. Black then becomes a colour of the
    scene, and other views see it through the gaps. What no photo shows has the colours next to it. There are none
    around what was cut out of its photos: where they are transparent, or masks leave less than half of them.

    Args:
        scene: Its train photos and cameras, in the coordinates of its frame.
        points: What is known to be there ``[P, 3]``.

    Returns:
        Positions ``[F, 3]`` and colours ``[F, 3]``, RGB in [0, 1], float32; maybe none.

    Raises:
        SceneError: An image cannot be decoded.
    """
    count = 0 if scene.white else round(FAR_SHARE * len(points))
    radius = FAR * max(EXTENT, np.nanquantile(points.norm(dim=1).numpy(), NEARLY_ALL))
    steps = np.arange(count) + 0.5
    height, turn = 1 - 2 * steps / max(count, 1), math.pi * (1 + math.sqrt(5)) * steps
    circle = np.sqrt(1 - height**2)
    places = radius * np.stack([circle * np.cos(turn), circle * np.sin(turn), height], axis=1)
    sums, photos, sightings = colors_at(scene, places, BLUR)
    if photos.sum() <= sightings.sum() / 2:
        return torch.empty(0, 3), torch.empty(0, 3)
    shown = np.flatnonzero(photos)
    _, alike = cKDTree(places[shown]).query(places, range(1, min(ALIKE, len(shown)) + 1))
    colors = (sums[shown] / photos[shown] / 255)[alike].mean(axis=1)
    return torch.from_numpy(places).float(), torch.from_numpy(colors).float()
