from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
import torch

from nsvq_lightning.data import dense_start
from nsvq_lightning.data.dense_start import dense_points, far_points
from nsvq_lightning.data.images import Picture
from nsvq_lightning.data.scene import Scene
from nsvq_lightning.rendering.camera import Camera

# A wall through z = 4, which comes nearer to the right.
NORMAL = np.array([0.3, 0.1, 1.0]) / np.linalg.norm([0.3, 0.1, 1.0])
DISTANCE = 4 * NORMAL[2]


def wall(width: int = 256, height: int = 192, focal: float = 230.0, *, x: float, flat: float = 0.0) -> Any:
    """Camera at ``(x, 0, 0)`` that looks along z, and its photo; ``flat``: share of the wall that is grey."""
    noise = np.random.default_rng(0).integers(0, 256, (80, 80, 3)).astype(np.uint8)
    texture = cv2.resize(noise, (800, 800), interpolation=cv2.INTER_CUBIC)
    texture[:, round(800 * (1 - flat)) :] = 128
    rows, columns = np.mgrid[:height, :width]
    rays = np.stack([(columns + 0.5 - width / 2) / focal, (rows + 0.5 - height / 2) / focal, np.ones(rows.shape)], -1)
    points = rays * ((DISTANCE - NORMAL[0] * x) / (rays @ NORMAL))[..., None] + [x, 0, 0]
    places = ((points[..., :2] + 4) * 100).astype(np.float32)
    photo = cv2.remap(texture, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(K, viewmat, width, height), Picture(torch.from_numpy(photo), None)


def scene_of(views: Sequence[Any], test: tuple[int, ...] = ()) -> Scene:
    cameras, pictures = zip(*views, strict=True)
    return Scene(
        root=Path("wall"),
        names=tuple(map(str, range(len(views)))),
        cameras=cameras,
        images=cast(Any, pictures),
        points=torch.tensor([[0.0, 0.0, 4.0]]),
        colors=torch.zeros(1, 3),
        train=tuple(sorted(set(range(len(views))) - set(test))),
        test=test,
        extent=1.0,
    )


def off_the_wall(points: torch.Tensor) -> np.ndarray:
    return np.abs(points.numpy() @ NORMAL - DISTANCE)


PLACES = (0.0, 0.25, 0.5, 0.75, 1.0)


def test_points_lie_on_the_surface_and_have_its_colour() -> None:
    views = [wall(x=x) for x in PLACES]
    points, colors = dense_points(scene_of(views), 3000, seed=0)
    assert points.shape == colors.shape == (3000, 3)
    assert points.dtype == colors.dtype == torch.float32
    assert np.quantile(off_the_wall(points), 0.95) < 0.03  # of a depth of 4, which is 58 pixels of disparity 0.25 apart
    assert off_the_wall(points).max() < 0.2
    camera, picture = views[2]
    pixel = (points - camera.position)[:, :2] / points[:, 2:] * 230 + torch.tensor([128.0, 96.0])
    inside = ((pixel > 1) & (pixel < torch.tensor([255.0, 191.0]))).all(1)
    assert inside.float().mean() > 0.5
    column, row = pixel[inside].long().T
    assert (picture.image[row, column] / 255 - colors[inside]).abs().mean() < 0.03


def test_points_are_where_the_detail_is() -> None:
    views = [wall(x=x, flat=0.5) for x in PLACES]
    points, _ = dense_points(scene_of(views), 1000, seed=0)
    assert len(points) == 1000
    assert (points[:, 0] > 0.1).float().mean() < 0.02


def test_the_same_bits_on_any_number_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of([wall(x=x) for x in PLACES])
    first, _ = dense_points(scene, 500, seed=0)
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(7)
        monkeypatch.setattr("nsvq_lightning.data.scene.usable_cores", lambda: 5)
        assert torch.equal(dense_points(scene, 500, seed=0)[0], first)
        assert cv2.getNumThreads() == 7
    finally:
        cv2.setNumThreads(threads)
    assert not torch.equal(dense_points(scene, 500, seed=1)[0], first)


def test_test_photos_are_not_looked_at() -> None:
    views = [wall(x=x) for x in PLACES]
    camera, _ = views[2]
    hidden = [*views[:2], (camera, None), *views[3:]]
    points, _ = dense_points(scene_of(hidden, test=(2,)), 500, seed=0)
    assert len(points) == 500


def test_pixels_that_do_not_count_give_no_points() -> None:
    views = []
    for x in PLACES:
        camera, picture = wall(x=x)
        columns = torch.arange(256) + 0.5
        mask = ((columns - 128) / 230 * 4 + x < 0.3).expand(192, 256).clone()  # the left of the wall, about
        views.append((camera, Picture(picture.image * mask[..., None], mask)))
    points, _ = dense_points(scene_of(views), 1000, seed=0)
    assert len(points) > 300
    assert points[:, 0].max() < 0.5
    assert off_the_wall(points).max() < 0.3


def test_photos_of_several_cameras_and_of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense_start, "MAX_SIDE", 200)
    sizes = [(256, 192, 230.0), (200, 150, 185.0), (256, 200, 230.0), (240, 192, 220.0), (320, 240, 290.0)]
    views = [wall(*size, x=x) for x, size in zip(PLACES, sizes, strict=True)]
    points, _ = dense_points(scene_of(views), 1000, seed=0)
    assert len(points) > 500
    assert np.quantile(off_the_wall(points), 0.9) < 0.06


# Farther apart than the flow is followed: 58 pixels of disparity at 0.25, 350 here.
FAR_APART = (0.0, 1.5, 3.0)


def test_without_points_features_are_found_where_photos_are_far_apart() -> None:
    scene = scene_of([wall(512, 384, 230.0, x=x) for x in FAR_APART])
    assert len(dense_points(scene, 1000, seed=0)[0]) == 0
    points, colors = dense_points(replace(scene, grey=True), 10_000, seed=0)
    assert 10_000 > len(points) == len(colors) > 1000
    assert np.quantile(off_the_wall(points), 0.95) < 0.03
    assert torch.equal(dense_points(replace(scene, grey=True), 10_000, seed=1)[0], points)  # all of them


def test_of_few_points_those_of_features_come_first() -> None:
    near, far = ([wall(512, 384, 230.0, x=x) for x in places] for places in ((-2.25, -2.0), (-0.5, 1.0, 2.5)))
    scene = replace(scene_of([*near, *far]), grey=True)
    by_flow = dense_points(replace(scene, grey=False), 10_000, seed=0)[0]
    points = dense_points(scene, 10_000, seed=0)[0]
    assert len(by_flow) == len(points) == 10_000
    beyond = 2.5  # what the second photo shows
    assert by_flow[:, 0].max() < beyond
    expected = (points[:, 0] > beyond).float().mean()
    # They crowd out those of the flow, not the other way round.
    assert 0 < expected < (dense_points(scene, 1000, seed=0)[0][:, 0] > beyond).float().mean()


def test_photos_without_features_do_without_them() -> None:
    views = [wall(x=x, flat=1.0) for x in PLACES]
    assert len(dense_points(replace(scene_of(views), grey=True), 1000, seed=0)[0]) == 0


@pytest.mark.parametrize("places", [(0.0,), (0.0, 0.01, 0.02), (0.0, 9.0, 18.0)])
def test_photos_without_neighbours_give_none(places: tuple[float, ...]) -> None:
    points, colors = dense_points(scene_of([wall(x=x) for x in places]), 1000, seed=0)
    assert points.shape == colors.shape == (0, 3)


def test_photos_without_detail_give_none() -> None:
    points, _ = dense_points(scene_of([wall(x=x, flat=1.0) for x in PLACES]), 1000, seed=0)
    assert len(points) == 0


def painted(x: float, color: tuple[int, int, int]) -> Any:
    """Camera of :func:`wall` and a photo of one colour."""
    camera, _ = wall(x=x)
    return camera, Picture(torch.tensor(color, dtype=torch.uint8).expand(camera.height, camera.width, 3), None)


@pytest.mark.parametrize(("distance", "radius"), [(3.0, 10.0), (40.0, 80.0)])
def test_far_points_lie_around_all_others(distance: float, radius: float) -> None:
    known = torch.tensor([[0.0, 0.0, distance]]).repeat(5000, 1)
    known[:200] = torch.tensor([[0.0, 1e6, 0.0]])  # a few may be anywhere, or nowhere
    known[200:210] = torch.nan
    points, colors = far_points(scene_of([painted(0.0, (51, 102, 204)), painted(0.5, (51, 102, 204))]), known)
    assert points.shape == colors.shape == (100, 3)
    torch.testing.assert_close(points.norm(dim=1), torch.full((100,), radius))
    # Evenly: none is far from the next, and their middle is that of the sphere.
    next_one = torch.cdist(points, points).fill_diagonal_(torch.inf).min(1).values / radius
    assert float(next_one.min()) > 0.25
    assert float(next_one.max()) < 0.4
    assert float(points.mean(0).norm()) < 0.02 * radius


def test_far_points_have_the_colours_that_train_photos_have_there() -> None:
    views = [painted(0.0, (200, 0, 0)), painted(0.1, (100, 50, 0)), painted(0.2, (0, 0, 255))]
    points, colors = far_points(scene_of(views, test=(2,)), torch.tensor([[0.0, 0.0, 4.0]]).repeat(50_000, 1))
    seen = points[:, 2] > 0.95 * 10.0
    torch.testing.assert_close(colors[seen], torch.tensor([150.0, 25, 0]).div(255).expand(int(seen.sum()), 3))
    # Those behind the cameras have that of the next ones before them, at the edge of one photo or of both.
    behind = colors[points[:, 2] < 0]
    assert len(behind) > 400
    assert float(behind[:, 0].min()) > 0.39
    assert float(behind[:, 2].max()) == 0


def test_there_are_no_far_points_where_no_photo_looks_and_none_of_few() -> None:
    views = [painted(0.0, (0, 0, 0))]
    for count in (10, 100):
        points, colors = far_points(scene_of(views), torch.tensor([[0.0, 0.0, 4.0]]).repeat(count, 1))
        assert points.shape == colors.shape == (0, 3)


@pytest.mark.parametrize(
    ("width", "white", "count"), [(256, False, 100), (140, False, 100), (110, False, 0), (256, True, 0)]
)
def test_there_are_no_far_points_around_what_was_cut_out(width: int, white: bool, count: int) -> None:
    camera, picture = painted(0.0, (10, 20, 30))
    mask = (torch.arange(camera.width) < width).expand(camera.height, -1)
    scene = replace(scene_of([(camera, Picture(picture.image, mask))]), white=white)
    points, _ = far_points(scene, torch.tensor([[0.0, 0.0, 4.0]]).repeat(50 * 100, 1))
    assert len(points) == count
