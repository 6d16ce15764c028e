"""Points where the photos have detail, from the optical flow between neighbouring train photos."""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from nsvq_lightning.compute.environment import usable_cores
from nsvq_lightning.compute.memory import trim
from nsvq_lightning.data.edges import edges_of
from nsvq_lightning.data.images import resized_mask
from nsvq_lightning.data.scene import Scene
from nsvq_lightning.random import draw_rows, generator
from nsvq_lightning.splats.conventions import Bools, Float32s, Float64s, Uint8s


class _Photo(NamedTuple):
    """A train photo at the size of its flow, and its pinhole camera."""

    image: Uint8s
    grey: Uint8s
    detail: Uint8s
    """Strength of the edges ``[h, w]``."""
    counts: Bools | None
    """Which pixels count ``[h, w]``; None for all."""
    focal: Float64s
    centre: Float64s
    rotation: Float64s
    """World to camera ``[3, 3]``."""
    position: Float64s
    depth: float
    """Median depth of the SfM points in front of the camera, scene units."""

    def project(self, points: Float64s) -> tuple[Float64s, Float64s]:
        """Pixels ``[M, 2]`` and depths ``[M]`` of points ``[M, 3]``."""
        x = (points - self.position) @ self.rotation.T
        return x[:, :2] / x[:, 2:] * self.focal + self.centre, x[:, 2]

    def rays(self, pixels: Float64s) -> Float64s:
        """Unit directions ``[M, 3]`` in the world of pixels ``[M, 2]``."""
        local = np.concatenate([(pixels - self.centre) / self.focal, np.ones((len(pixels), 1))], 1)
        return np.asarray(local / np.linalg.norm(local, axis=1, keepdims=True) @ self.rotation, np.float64)


# Triangulated pixels: positions ``[M, 3]``, colours ``[M, 3]`` and detail ``[M]``, both in bytes.
_Points = tuple[Float64s, Uint8s, Uint8s]


# Candidates over all flows; of more pixels than that, every third, fourth, ... row and column is taken.
MOST_CANDIDATES = 12_000_000
# Edge of a cell over the median depth of the scene, and how many flows must find something in it.
CELL, AGREEING = 0.01, 3
# Detail of a flat pixel; and by which power of the number of points in its cell a point counts less.
LEAST_DETAIL, CROWDED = 0.05, 0.7


def dense_points(scene: Scene, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Points on the surfaces that the train photos show, denser where these have detail.

    The flow between each photo and its nearest neighbours (DIS, Kroeger et al. 2016) is followed there and back again,
    and the pixels that return are triangulated. From what several flows agree on, points are drawn in proportion to
    the photos' detail. Test photos are not looked at. The same scene, count and seed give the same bits, on any number
    of cores.

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
    known = scene.points.numpy().astype(np.float64)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # with several, DIS works in stripes, and its bits depend on how many
    try:
        with ThreadPoolExecutor(usable_cores()) as pool:
            looked = pool.map(lambda index: _photo(scene, index, known), scene.train)
            photos = list(tqdm(looked, "dense start: photos", len(scene.train), leave=False, disable=None))
            pairs = _neighbours(photos)
            pixels = 2 * len(pairs) * photos[0].grey.size
            stride = max(2, int(np.ceil(np.sqrt(pixels / MOST_CANDIDATES))))
            flows = pool.map(lambda pair: _triangulated(pair, stride), pairs)
            bar = tqdm(flows, "dense start: flows", len(pairs), leave=False, disable=None)
            found = [each for two in bar for each in two]
    finally:
        cv2.setNumThreads(threads)
    if not found:
        return torch.empty(0, 3), torch.empty(0, 3)
    edge = CELL * np.median([photo.depth for photo in photos])
    del photos, pairs
    positions, colors, detail = (np.concatenate(parts) for parts in zip(*found, strict=True))
    found.clear()
    # Cells by one number each: 2^21 along an axis.
    cells = np.zeros(len(positions), np.int64)
    for axis in positions.T:
        cells = cells << 21 | np.floor(axis / edge).astype(np.int64) & (1 << 21) - 1
    _, cell, crowd = np.unique(cells, return_inverse=True, return_counts=True)
    crowd = crowd[cell]
    weight = np.where(crowd >= AGREEING, (detail / 255 + LEAST_DETAIL) / crowd**CROWDED, 0)
    drawn = draw_rows(torch.from_numpy(weight), count, generator(seed, 0, "dense start")).numpy()
    chosen = torch.from_numpy(positions[drawn]).float(), torch.from_numpy(colors[drawn]).float() / 255
    del positions, colors, detail, cells, cell, crowd, weight
    trim()
    return chosen


# Photos are looked at with at most so many pixels on their longer side.
LONGEST = 800


def _photo(scene: Scene, index: int, known: Float64s) -> _Photo:
    camera, (image, mask) = scene.cameras[index], scene.images[index]
    scale = min(1.0, LONGEST / max(camera.width, camera.height))
    width, height = round(camera.width * scale), round(camera.height * scale)
    pixels, counts = image.numpy(), None if mask is None else mask.numpy()
    if scale < 1:
        pixels = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        if counts is not None:
            counts = resized_mask(counts, (width, height))
    view = camera.viewmat.numpy().astype(np.float64)
    rotation, translation = view[:3, :3], view[:3, 3]
    size = np.array([width / camera.width, height / camera.height])
    fx, fy, cx, cy = camera.intrinsics
    depths = known @ rotation[2] + translation[2]
    edges = edges_of(torch.from_numpy(pixels), None if counts is None else torch.from_numpy(counts))
    return _Photo(
        image=pixels,
        grey=np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8),
        detail=np.asarray(cv2.GaussianBlur((edges.strength() * 255).byte().numpy(), (0, 0), 1.5), np.uint8),
        counts=counts,
        focal=size * (fx, fy),
        centre=size * (cx, cy),
        rotation=rotation,
        position=-rotation.T @ translation,
        depth=float(np.median(depths[depths > 0])) if (depths > 0).any() else 0.0,
    )


# Distance of the cameras over the depth of what they see, angle between their axes in degrees, how many for a photo.
BASELINE, MOST_TURNED, NEIGHBOURS = (0.02, 0.35), 25.0, 3


def _neighbours(photos: list[_Photo]) -> list[tuple[_Photo, _Photo]]:
    """Each photo with those nearest to it that see the same from another place, each pair once."""
    positions, axes = np.array([photo.position for photo in photos]), np.array([photo.rotation[2] for photo in photos])
    pairs = set()
    for i, photo in enumerate(photos):
        base = np.linalg.norm(positions - photo.position, axis=1)
        angle = np.degrees(np.arccos(np.clip(axes @ axes[i], -1, 1)))
        usable = (base > BASELINE[0] * photo.depth) & (base < BASELINE[1] * photo.depth) & (angle < MOST_TURNED)
        nearest = np.argsort(np.where(usable, base + 0.01 * photo.depth * angle, np.inf), kind="stable")
        pairs |= {(min(i, j), max(i, j)) for j in nearest[: min(NEIGHBOURS, usable.sum())].tolist()}
    return [(photos[i], photos[j]) for i, j in sorted(pairs)]


def _triangulated(pair: tuple[_Photo, _Photo], stride: int) -> list[_Points]:
    """What two photos show of each other: the pixels of the first, then those of the second."""
    a, b = pair
    height, width = np.maximum(a.grey.shape, b.grey.shape)
    grey = [
        cv2.copyMakeBorder(p.grey, 0, height - p.grey.shape[0], 0, width - p.grey.shape[1], cv2.BORDER_REPLICATE)
        for p in pair
    ]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = dis.calc(grey[0], grey[1], None), dis.calc(grey[1], grey[0], None)
    return [_followed(a, b, there, back, stride), _followed(b, a, back, there, stride)]


# Largest error in pixels, of the flow there and back again and of the triangulated point; least angle of its two rays
# in degrees; depths over the median depth of what SfM found in the photo.
MOST_ERROR, LEAST_PARALLAX, DEPTHS = 0.7, 1.0, (0.1, 20.0)


def _followed(a: _Photo, b: _Photo, there: Float32s, back: Float32s, stride: int) -> _Points:
    """The pixels of ``a``, every ``stride``-th, that the flow leads to ``b`` and back again, triangulated."""
    height, width = a.grey.shape
    places = np.mgrid[:height, :width][::-1].astype(np.float32)
    ends = places.transpose(1, 2, 0) + there[:height, :width]
    returned = there[:height, :width] + cv2.remap(back, ends, None, cv2.INTER_LINEAR)
    inside = (ends > 1) & (ends < np.array(b.grey.shape[::-1]) - 2)
    good = (np.linalg.norm(returned, axis=2) < MOST_ERROR) & inside.all(2)
    for photo, at in ((a, places), (b, ends.transpose(2, 0, 1))):
        if photo.counts is not None:
            good &= cv2.remap(photo.counts.view(np.uint8), at[0], at[1], cv2.INTER_NEAREST) > 0
    rows, columns = (stride * x for x in np.nonzero(good[::stride, ::stride]))
    start, end = (np.asarray(x, np.float64) + 0.5 for x in (places[:, rows, columns].T, ends[rows, columns]))
    u, v = a.rays(start), b.rays(end)
    apart = (u * v).sum(1) < np.cos(np.radians(LEAST_PARALLAX))
    rows, columns, start, end, u, v = (x[apart] for x in (rows, columns, start, end, u, v))
    # The point nearest to both rays.
    between, cosine = b.position - a.position, (u * v).sum(1)
    along_u, along_v = u @ between, v @ between
    s, t = np.stack([along_u - cosine * along_v, cosine * along_u - along_v]) / (1 - cosine**2)
    points = 0.5 * (a.position + s[:, None] * u + b.position + t[:, None] * v)
    (pixel_a, depth_a), (pixel_b, depth_b) = a.project(points), b.project(points)
    error = np.maximum(np.linalg.norm(pixel_a - start, axis=1), np.linalg.norm(pixel_b - end, axis=1))
    nearest, farthest = (share * a.depth for share in DEPTHS)
    kept = (error < MOST_ERROR) & (depth_a > nearest) & (depth_b > nearest) & (depth_a < farthest)
    return points[kept], a.image[rows[kept], columns[kept]], a.detail[rows[kept], columns[kept]]
