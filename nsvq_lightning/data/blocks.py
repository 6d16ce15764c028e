"""Large scenes in parts: each part is a scene of its own, with what its photos show of it and nothing else.

The ground is cut where the photos show as much on one side as on the other. A part's core has no gaps to the others,
and its surroundings are trained with it, so that seams lie within what both sides know. Photos are cropped to the part,
and masks leave out what is in front of it or behind: no splat is spent on that, and no memory.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.images import write_pixels
from nsvq_lightning.data.points import projected
from nsvq_lightning.data.scene import Scene
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.io.errors import Json
from nsvq_lightning.io.placing import turn_up
from nsvq_lightning.io.ply import write_elements
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.poses import up_of
from nsvq_lightning.splats.conventions import Bools, Float64s, Floats, Integers, Uint8s

BLOCK = "block.json"

# Rows of points, and the cell of a picture that each is in.
_Front = tuple[Integers, Integers]


@dataclass(frozen=True)
class Block:
    """A part of a scene: a box on its ground, without end where there is no neighbour.

    Attributes:
        axes: Directions in the world ``[2][3]`` of the two coordinates on the ground, of length 1.
        core: Where it begins and ends on both ``[2][2]``.
        around: The same with the surroundings that are trained with it.
        scene: Folder of the whole scene.
        parts: How many there are; 0 where an earlier version did not say.
        options: Of :func:`nsvq_lightning.data.scene.load_scene`, how the whole was read.
    """

    axes: Sequence[Sequence[float]]
    core: Sequence[Sequence[float]]
    around: Sequence[Sequence[float]]
    scene: str
    parts: int = 0
    options: Json = field(default_factory=dict)

    def contains(self, points: Floats, around: bool = False) -> Bools:
        """Which points ``[N, 3]`` are in its core, or in that with its surroundings.

        Cores have no point in common, and each point is in one.
        """
        ground = points @ np.array(self.axes).T
        low, high = self.around if around else self.core
        return ((ground >= low) & (ground < high)).all(1)  # type: ignore[no-any-return]

    @classmethod
    def read(cls, folder: Path) -> "Block":
        """The part in a folder.

        Raises:
            SceneError: The folder has none, or it is damaged.
        """
        try:
            return cls(**json.loads((folder / BLOCK).read_bytes()))
        except (OSError, ValueError, TypeError) as error:
            raise SceneError(f"{folder} is no part of a scene ({error}): make it anew with 'nsvq split'") from None


# Points up to so many times as far as the nearest one in the cell count as in front, too.
FRONT = 1.05


def points_in_front(points: Float64s, camera: Camera) -> _Front:
    """Rows of the points ``[P, 3]`` that no nearer ones hide from a camera, and the cell of its picture of each.

    Cells are numbered row by row.
    """
    columns, rows, size = _cells(camera)
    column, row, depth = projected(points, camera)
    column = np.floor(column / size)
    row = np.floor(row / size)
    seen = np.flatnonzero((column >= 0) & (column < columns) & (row >= 0) & (row < rows))
    cells = (row[seen] * columns + column[seen]).astype(np.intp)
    nearest = np.full(columns * rows, np.inf)
    np.minimum.at(nearest, cells, depth[seen])
    front = depth[seen] <= FRONT * nearest[cells]
    return seen[front], cells[front]


# Widths of a photo in cells; in each, the points that are in front tell what it shows.
CELLS = 50


def _cells(camera: Camera) -> tuple[int, int, int]:
    """Columns and rows of the cells of a picture, and their side in pixels."""
    size = max(4, camera.width // CELLS)
    return math.ceil(camera.width / size), math.ceil(camera.height / size), size


# Surroundings of a core beyond each seam, as a share of what photos show of the part, and of its width at most.
OVERLAP = 0.15
# How far the seam may move from where both sides have their share, to lie in the widest gap.
SLACK = 0.1
# Where a part without a neighbour ends.
_FAR = 1e30


def cut(scene: Scene, count: int, **options: Any) -> list[Block]:
    """Parts of a scene, of which photos show about the same amount.

    Args:
        scene: The whole.
        count: How many.
        options: How it was read, see :class:`Block`.

    Raises:
        SceneError: Photos show too few points for so many parts.
    """
    points = scene.points.double().numpy()
    shown = np.zeros(len(points))
    for index in scene.train:
        rows, cells = points_in_front(points, scene.cameras[index])
        shown[rows] += 1 / np.bincount(cells)[cells]  # a cell is shared by its points
    axes = np.linalg.inv(turn_up(up_of(scene.cameras), "minus-y")).T[[0, 2]]
    ground = points @ axes.T

    def parts(some: Bools, core: Float64s, around: Float64s, number: int) -> list[Block]:
        places = ground[some]
        weights = shown[some]
        if np.count_nonzero(weights) < 4 * number:
            raise SceneError(f"the photos show too few points of {scene.root} for {count} parts: ask for fewer")
        if number == 1:
            return [Block(axes.tolist(), core.tolist(), around.tolist(), str(scene.root.resolve()), count, options)]
        quantiles = partial(np.quantile, weights=weights, method="inverted_cdf")
        spread = [np.subtract(*quantiles(column, (0.95, 0.05))) for column in places.T]
        axis = np.argmax(spread)
        along = places[:, axis]
        first = number // 2
        shares = np.array([first - OVERLAP, first - SLACK, first + SLACK, first + OVERLAP]) / number
        lower, start, stop, upper = quantiles(along, shares)
        near = np.sort(along[(along >= start) & (along <= stop)])
        gap = np.diff(near, append=near[-1]).argmax()
        seam = near[gap : gap + 2].mean()
        reach = OVERLAP * spread[axis] / number
        below = ground[:, axis] < seam

        def side(inside: Bools, bound: int, end: float, share: int) -> list[Block]:
            """The parts on one side of the seam, where the core has this bound and its surroundings have an end."""
            inner = core.copy()
            inner[bound, axis] = seam
            outer = around.copy()
            outer[bound, axis] = end
            return parts(some & inside, inner, outer, share)

        low, high = max(lower, seam - reach), min(upper, seam + reach)
        return side(below, 1, high, first) + side(~below, 0, low, number - first)

    everywhere = np.array([[-_FAR] * 2, [_FAR] * 2])
    return parts(np.ones(len(points), bool), everywhere, everywhere, count)


# A point in a file: its position, then its colour.
_POINT = [(axis, "<f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
# A photo belongs to a part if it shows it in this share of its cells.
MIN_SHOWN = 0.05


def write_blocks(scene: Scene, blocks: Sequence[Block], folders: Sequence[Path]) -> list[tuple[int, int]]:
    """Write each part as a scene folder: cropped photos, masks, points, and a ``transforms.json`` with the cameras.

    Test photos stay test photos. ``block.json`` is written last.

    Returns:
        Number of train and of test photos of each part.

    Raises:
        SceneError: A photo cannot be decoded, or a part is in no train or no test photo.
        OSError: A file cannot be written.
    """
    points = scene.points.double().numpy()
    insides = [block.contains(points, around=True) for block in blocks]
    # Of each part, the train and the test photos, as frames of ``transforms.json``.
    frames: list[tuple[list[Json], list[Json]]] = [([], []) for _ in blocks]
    for index in sorted((*scene.train, *scene.test)):
        camera = scene.cameras[index]
        front = points_in_front(points, camera)
        masks = [shown(front, inside, camera) for inside in insides]
        showing = [part for part, mask in enumerate(masks) if mask.mean() >= MIN_SHOWN]
        if not showing:
            continue
        image, counting = scene.images[index]
        for part in showing:
            mask = masks[part]
            if counting is not None:
                mask &= counting.numpy()
            if mask.any():
                train, test = frames[part]
                frame = _write_photo(folders[part], index, image.numpy(), mask, camera)
                (test if index in scene.test else train).append(frame)
    colors = np.rint(255 * scene.colors.numpy())
    for block, folder, inside, (train, test) in zip(blocks, folders, insides, frames, strict=True):
        if not train or not test:
            raise SceneError(f"a part is in {len(train)} train and {len(test)} test photos: ask for fewer parts")
        columns = [*points[inside].T, *colors[inside].T]
        write_elements(folder / "points.ply", {"vertex": np.rec.fromarrays(columns, dtype=_POINT)})
        model = {
            "camera_model": "PINHOLE",
            "ply_file_path": "points.ply",
            "frames": train + test,
            "train_filenames": [frame["file_path"] for frame in train],
            "test_filenames": [frame["file_path"] for frame in test],
        }
        write_text(folder / "transforms.json", json.dumps(model, indent=1))
        write_text(folder / BLOCK, json.dumps(asdict(block), indent=1))
    return [(len(train), len(test)) for train, test in frames]


def shown(front: _Front, inside: Bools, camera: Camera) -> Bools:
    """Pixels ``[H, W]`` of a picture that show some points.

    Args:
        front: See :func:`points_in_front`.
        inside: Which of all points ``[P]``.
        camera: Camera of the picture.
    """
    points, cells = front
    columns, rows, size = _cells(camera)
    empty = np.ones((rows, columns), bool)
    empty.flat[cells] = False
    here = np.zeros((rows, columns), np.uint8)
    here.flat[cells[inside[points]]] = 1
    # A cell without points shows what the nearest one with points does.
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    grid = cv2.dilate(here[tuple(nearest)], None)  # by its neighbours, 3 x 3
    return np.asarray(grid.repeat(size, axis=0).repeat(size, axis=1)[: camera.height, : camera.width], bool)


def _write_photo(folder: Path, index: int, image: Uint8s, mask: Bools, camera: Camera) -> Json:
    """Write what a photo shows of a part, and its mask; returns its frame in ``transforms.json``."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    box = slice(top, top + height), slice(left, left + width)
    photo = f"images/{index:05}.png"
    write_pixels(folder / photo, image[box][..., ::-1])
    kept = f"masks/{index:05}.png"
    write_pixels(folder / kept, 255 * mask[box].astype(np.uint8))
    fx, fy, cx, cy = camera.intrinsics
    # The file has the inverse, y up, z backward.
    pose = np.linalg.inv(camera.viewmat.double().numpy()) * (1, -1, -1, 1)
    return {
        "file_path": photo,
        "mask_path": kept,
        "w": width,
        "h": height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx - left,
        "cy": cy - top,
        "transform_matrix": pose.tolist(),
    }
