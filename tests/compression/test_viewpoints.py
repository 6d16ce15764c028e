"""Views of a scene without photos."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nsvq_lightning.compression.viewpoints import Measure, likely_cameras, own_scene, showing
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import RawSplats


def painting(behind: bool = True) -> RawSplats:
    """A wall of small splats of many colours in the plane z = 0, with a large grey one behind it."""
    rng = np.random.default_rng(0)
    across, down = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    means = np.stack([across.ravel(), down.ravel(), np.zeros(1600)], axis=1)
    scales, sh0 = np.full((1600, 3), np.log(0.02)), 2 * rng.standard_normal((1600, 1, 3))
    if behind:
        means = np.concatenate([means, [[0.0, 0.0, 0.2]]])
        scales = np.concatenate([scales, [[np.log(2.0), np.log(2.0), np.log(0.02)]]])
        sh0 = np.concatenate([sh0, np.zeros((1, 1, 3))])
    tensors = (means, np.tile([1.0, 0, 0, 0], (len(means), 1)), scales, np.full(len(means), 6.0), sh0)
    means, quats, scales, opacities, sh0 = (torch.from_numpy(array.astype(np.float32)) for array in tensors)
    return RawSplats(means, quats, scales, opacities, sh0, torch.zeros(len(means), 0, 3))


def eye(camera: Camera) -> np.ndarray:
    view = camera.viewmat.double().numpy()
    return -view[:3, :3].T @ view[:3, 3]


def test_cameras_stand_where_the_detail_is_seen() -> None:
    """Oracle: the side of the wall that nothing covers."""
    cameras = likely_cameras(painting(), 12, 64, 48)
    assert len(cameras) == 12
    assert {(camera.width, camera.height) for camera in cameras} == {(64, 48)}
    free = likely_cameras(painting(behind=False), 12, 64, 48)
    in_front = [np.mean([eye(camera)[2] < 0 for camera in views]) for views in (cameras, free)]
    # At a slant, splats behind one another may be drawn in another order.
    assert in_front[0] >= 0.65
    assert 0.25 <= in_front[1] <= 0.6


@pytest.mark.parametrize("is_room", [True, False])
def test_a_room_is_seen_from_inside(is_room: bool) -> None:
    """Oracle: colours of a sphere that change along the lines of sight of its middle, or across them."""
    out = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)))
    lines = out if is_room else torch.nn.functional.normalize(torch.linalg.cross(out, torch.tensor([[0.0, 1.0, 0.0]])))
    harmonics = (lines[:, [1, 2, 0]] * torch.tensor([-1.0, 1.0, -1.0]))[:, :, None].expand(-1, -1, 3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(500, 1)
    ball = RawSplats(out, quats, torch.full((500, 3), -3.0), torch.full((500,), 3.0), torch.zeros(500, 1, 3), harmonics)
    away = [np.linalg.norm(eye(camera)) for camera in likely_cameras(ball, 8, 32, 24)]
    assert max(away) < 1 if is_room else min(away) > 1


def test_splats_in_one_place_are_seen_from_around_it() -> None:
    torch.manual_seed(0)
    one = RawSplats(*(tensor[:1].expand(50, *tensor.shape[1:]).contiguous() for tensor in painting()))
    one = one._replace(shN=torch.randn(1, 15, 3).expand(50, 15, 3).contiguous())
    assert len({tuple(eye(camera)) for camera in likely_cameras(one, 4, 64, 48)}) == 4


def test_the_same_scene_has_the_same_views_and_the_best_come_first() -> None:
    once, again = (likely_cameras(painting(), 5, 64, 48) for _ in range(2))
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(once, again, strict=True))


@pytest.mark.parametrize("rows", [slice(0, 1), slice(0, 41, 40), slice(None)])
@pytest.mark.parametrize("opacity", [3.0, -1000.0])
def test_a_single_splat_one_above_another_and_transparent_ones_have_views(rows: slice, opacity: float) -> None:
    splats = painting(behind=False)
    shN, opacities = torch.ones(len(splats.means), 3, 3), torch.full_like(splats.opacities, opacity)
    some = RawSplats(*(tensor[rows] for tensor in splats._replace(shN=shN, opacities=opacities)))
    assert all(camera.viewmat.isfinite().all() for camera in likely_cameras(some, 3, 32, 24))


def test_a_splat_of_no_length_and_the_place_of_a_scene_change_no_view() -> None:
    plain = painting()
    more = [torch.cat([tensor, tensor[:1]]) for tensor in plain]
    one = RawSplats(*more)._replace(scales=torch.cat([plain.scales, torch.full((1, 3), -20.0)]))
    away = torch.tensor([3000.0, -2000.0, 1000.0])
    moved = plain._replace(means=plain.means + away)
    expected = [eye(camera) for camera in likely_cameras(plain, 5, 64, 48)]
    apart = [np.std([eye(camera) for camera in likely_cameras(splats, 12, 64, 48)]) for splats in (plain, one)]
    assert apart[1] > 0.8 * apart[0]
    found = [eye(camera) - away.numpy() for camera in likely_cameras(moved, 5, 64, 48)]
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_splats_far_out_hardly_change_the_views() -> None:
    plain = painting()
    far = RawSplats(*(torch.cat([tensor, tensor[:3]]) for tensor in plain))
    far.means[-3:] += torch.tensor([[1e4, 0.0, 0.0], [0.0, 1e5, 0.0], [0.0, 0.0, -1e4]])
    eyes = ([eye(camera) for camera in likely_cameras(splats, 12, 64, 48)] for splats in (plain, far))
    away, now = (np.linalg.norm(places, axis=1).mean() for places in eyes)
    assert now == pytest.approx(away, rel=0.1)


def test_pictures_of_a_scene_are_its_photos() -> None:
    cameras = likely_cameras(painting(), 4, 64, 48)
    scene = own_scene(painting(), cameras)
    assert (len(scene), scene.train, scene.extent > 0) == (4, (0, 1, 2, 3), True)
    for index, camera in enumerate(cameras):
        view = scene.view(index)
        assert view.image.dtype == torch.uint8
        assert float((view.image / 255 - render(painting(), camera).image.clamp(0, 1)).abs().max()) < 0.51 / 255


def test_an_error_is_the_root_mean_square_difference_of_pictures() -> None:
    cameras = likely_cameras(painting(), 3, 64, 48)
    measure = Measure(painting(), cameras)
    assert measure.error(painting()) == 0
    other = painting()._replace(sh0=painting().sh0 + 0.1)
    pairs = [[render(splats, camera).image.clamp(0, 1) for splats in (painting(), other)] for camera in cameras]
    expected = np.sqrt(np.mean([float((a - b).square().mean()) for a, b in pairs]))
    assert measure.error(other) == pytest.approx(expected, rel=1e-5)
    with pytest.raises(ValueError, match="all 1 pictures of the scene are empty"):
        Measure(painting()._replace(means=painting().means + 1e4), cameras[:1])


def test_cameras_of_a_part_are_those_that_show_it() -> None:
    cameras = likely_cameras(painting(), 6, 64, 48)
    means = painting().means.numpy()
    assert len(showing(cameras, means, 4)) == 4
    assert len(showing(cameras, means + 1000, 6)) < 3 < len(showing(cameras, means, 6))
    assert showing([], means, 4) == []
