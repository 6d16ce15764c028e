"""Pictures of other sizes, and from other distances, than those of training."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import oracle
import pytest
import torch
from oracle import run
from splat_scenes import front_camera, random_splats

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.rendering.sampling import MAX_CAMERAS, Sampling, fewer_cameras, focal_of, trained_by
from nsvq_lightning.splats.splats import RawSplats

assert_same = partial(oracle.assert_same, "cpu")


def distances(splats: RawSplats, camera: Camera) -> torch.Tensor:
    return (splats.means - camera.position).norm(dim=1)


@pytest.mark.parametrize("log_scale", [-5.0, -3.5, -2.0])
@pytest.mark.parametrize("times", [0.25, 0.7, 1.5, 4.0])
def test_sampling_is_that_of_the_oracle(times: float, log_scale: float) -> None:
    """Of a scene that was trained at another size, and seen from nearer and from farther by some of its cameras."""
    splats, camera = random_splats(300, log_scale=log_scale), front_camera()
    away = distances(splats, camera)
    sampling = Sampling(torch.stack([away * torch.linspace(0.5, 1.5, 300), 1.2 * away]), [focal_of(camera) / times])
    ours, _ = assert_same(splats, camera, sampling=sampling, tolerance=2e-4)
    assert (render(splats, camera).image - ours.image).abs().max() > 0.01


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_pictures_like_those_of_training_do_not_change(backend: str) -> None:
    splats, camera = random_splats(300, log_scale=-3.5), front_camera()
    away = distances(splats, camera)
    within = Sampling(torch.stack([0.99 * away, 1.01 * away]), [3.0, 1.005 * focal_of(camera), 1e4])
    (plain, expected), (ours, gradients) = (
        run(splats, camera, backend, torch.float32, **options) for options in ({}, {"sampling": within})
    )
    if backend == "cpu":
        assert torch.equal(ours.image, plain.image)
    torch.testing.assert_close((ours.image, gradients), (plain.image, expected), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("times", "share"), [(0.25, 0.2), (0.5, 0.25), (2.0, 0.3)])
def test_pictures_of_any_size_are_those_of_training(times: float, share: float) -> None:
    """Smaller ones are the mean of the pixels of training, and that of larger ones is the picture of training."""
    splats, camera = random_splats(400, log_scale=-4.2), front_camera(64, 48)
    stretch = torch.diag(torch.tensor([times, times, 1.0]))
    other = Camera(stretch @ camera.K, camera.viewmat, int(64 * times), int(48 * times))
    away = distances(splats, camera)
    sampling = Sampling(away.expand(2, -1), [focal_of(camera)])

    def error(**options: object) -> float:
        pictures = [render(splats, camera).image, render(splats, other, **options).image]  # type: ignore[arg-type]
        small = min(camera.width, other.width)
        few, many = ((picture.view(48 * small // 64, -1, small, len(picture[0]) // small, 3)) for picture in pictures)
        return float((few.mean((1, 3)) - many.mean((1, 3))).abs().mean())

    assert error(sampling=sampling) < share * error()


def test_sampling_as_pixels_per_unit() -> None:
    splats, camera = random_splats(50), front_camera()
    here = focal_of(camera) / distances(splats, camera)
    half = render(splats, camera, sampling=2 * here).image
    sampling = Sampling(distances(splats, camera).expand(2, -1), [2 * focal_of(camera)])
    torch.testing.assert_close(half, render(splats, camera, sampling=sampling).image)
    assert torch.equal(render(splats, camera, sampling=here).image, render(splats, camera).image)
    one = render(splats, camera, sampling=30.0).image
    assert torch.equal(one, render(splats, camera, sampling=torch.full((50,), 30.0)).image)


@pytest.mark.parametrize(
    ("sampling", "message"),
    [
        (0.0, "above 0"),
        (math.nan, "above 0"),
        (torch.ones(3), r"that of 10 splats, got \[2, 3\]"),
        (torch.ones(10, 2), r"one a splat, got \[10, 2\]"),
        (Sampling(torch.ones(2, 9), [1.0]), r"got \[2, 9\]"),
    ],
)
def test_sampling_of_other_splats_is_refused(sampling: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render(random_splats(10), front_camera(), sampling=sampling)


def test_the_distances_of_cameras() -> None:
    cameras = np.array([[0.0, 0, 0, 50], [2.0, 0, 0, 70], [4.0, 0, 0, 50]])
    means = torch.tensor([[0.0, 0, 0], [2.0, 3.0, 0], [9.0, 0, 0]])
    (nearest, farthest), focals = Sampling.of(means, cameras)
    torch.testing.assert_close(nearest, torch.tensor([0.0, 1.5, 3.0]))  # half of 3, and 5, by a gap of 2 less
    torch.testing.assert_close(farthest, torch.tensor([6.0, 13**0.5 + 2, 11.0]))
    assert focals == [50, 70]
    alone = Sampling.of(means, cameras[:1])
    torch.testing.assert_close(*alone.distances)
    many = np.c_[2.0 * np.arange(30), np.zeros((30, 2)), np.full(30, 50.0)]
    for place in (0.0, 2.0**13):
        (nearest, _), _ = Sampling.of(torch.tensor([[-5.0, place, place]]), many + np.array([0, place, place, 0]))
        torch.testing.assert_close(nearest, torch.tensor([3.0]))


def test_few_cameras_stand_for_many() -> None:
    cameras = []
    for angle in np.linspace(0, 6, 500):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([10 * math.cos(angle), 0.0, 10 * math.sin(angle)])
        cameras.append(Camera(front_camera().K, viewmat, 8, 8))
    kept = trained_by(cameras)
    assert 10 < len(kept) <= MAX_CAMERAS
    assert kept[0, 3] == focal_of(cameras[0])
    places = -np.array([camera.viewmat[:3, 3].numpy() for camera in cameras])
    assert np.linalg.norm(places[:, None] - kept[None, :, :3], axis=2).min(1).max() < 3
    assert trained_by([]).shape == (0, 4)
    assert len(trained_by(cameras[:1] * 5)) == 1


def test_places_along_a_way_and_every_lens_are_kept() -> None:
    corridor = np.c_[np.linspace(0, 200, 201), np.zeros((201, 2)), np.full(201, 500.0)]
    kept = fewer_cameras(corridor)
    wall = torch.tensor([[30.0, 1.5, 0.0], [71.0, 1.5, 0.0]])
    (nearest, _), _ = Sampling.of(wall, kept)
    assert float(nearest.max()) < 7
    corridor[[20, 77]] += [0.1, 0, 0, 800]
    assert set(fewer_cameras(corridor)[:, 3]) == {500, 1300}
    assert set(fewer_cameras(np.array([[1.0, 2, 3, 500], [1, 2, 3, 1300], [1, 2, 3, 500]]))[:, 3]) == {500, 1300}
