"""A scene's frame: the same numbers in any unit and at any place, and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.placing import placed
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.frame import EXTENT, Frame, middle_of, reach_of
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import Splats

DRAWS = np.random.default_rng(0)
CENTRES, POINTS = DRAWS.uniform(-1, 1, (15, 3)) * [3, 1, 3], DRAWS.normal(size=(300, 3)) * 4
K = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def looking(position: np.ndarray, near: float = NEAR) -> Camera:
    """A camera that looks along z."""
    view = np.eye(4)
    view[:3, 3] = -position
    return Camera(K, torch.from_numpy(view), 64, 48, near)


@pytest.mark.parametrize("unit", [1e-4, 0.03, 2.0**-7, 0.3048, 100.0, 2.0**9, 1e4])
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (-3.0, 70.0, 11.0)])
def test_a_scene_has_the_same_bits_in_any_unit(unit: float, shift: tuple[float, float, float]) -> None:
    frames = Frame.around(CENTRES), Frame.around(unit * (CENTRES + shift))
    assert frames[1].unit / frames[0].unit == pytest.approx(unit, rel=1e-12)
    assert np.array_equal(frames[0].points(POINTS), frames[1].points(unit * (POINTS + shift)))
    for centre in CENTRES:
        one = frames[0].camera(looking(centre, frames[0].near))
        other = frames[1].camera(looking(unit * (centre + shift), frames[1].near))
        assert torch.equal(one.viewmat, other.viewmat)
        assert (one.packed_view, one.near, other.near) == (other.packed_view, NEAR, NEAR)


def test_the_middle_is_0_and_the_extent_is_that_of_a_usual_scene() -> None:
    frame = Frame.around(CENTRES)
    inside = frame.points(CENTRES)
    assert np.abs(np.median(inside, axis=0)).max() < 1e-5
    assert 1.1 * np.linalg.norm(inside, axis=1).max() == pytest.approx(EXTENT, rel=1e-5)
    assert Frame.around(np.ones((3, 3))).unit == 1  # of cameras in one place


@pytest.mark.parametrize("count", [6, 15])
def test_one_lost_camera_is_no_extent(count: int) -> None:
    usual = Frame.around(CENTRES[:count])
    lost = np.concatenate([CENTRES[: count - 1], 1000 * CENTRES[count - 1 : count]])
    assert Frame.around(lost).unit == pytest.approx(usual.unit, rel=0.4)
    assert reach_of(np.array([1.0, 1.0, 1.0, 1.0, 1.9])) == 1.9
    assert reach_of(np.array([1.0, 1.0, 1.0, 1.0, 2.1])) == 1.0
    assert reach_of(np.array([0.0, 0.0, 0.0, 0.0, 2.1])) == 2.1


def test_the_middle_is_the_median_and_four_fifths_lie_about_it() -> None:
    places = np.zeros((5, 3), np.float32)
    places[:, 1] = (7, 8, 6, 9, -50)
    middle, reach = middle_of(places)
    assert (middle.tolist(), reach) == ([0, 7, 0], 2)


def test_splats_are_the_same_picture_here_and_in_their_files() -> None:
    frame = Frame(0.01, (2.0, -1.0, 0.5), (1e6, 0.0, 0.0))
    colors = torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    inside = Splats.from_points(torch.from_numpy(POINTS) + torch.tensor([0.0, 0.0, 9.0]), colors, 1)
    files = placed(CompressedScene.from_splats(inside), frame)
    assert files.origin == frame.origin
    camera = looking(np.array(frame.middle), frame.near)
    expected = render(inside, frame.camera(camera)).image
    assert expected.max() > 0.5
    torch.testing.assert_close(render(files.decode(), camera).image, expected, atol=1e-3, rtol=0)
    back = frame.splats(files.decode())
    torch.testing.assert_close(back.means, inside.means.detach(), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(back.scales, inside.scales.detach(), atol=1e-5, rtol=0)
    assert torch.equal(back.sh0, inside.sh0.detach())


def test_what_is_before_the_near_plane_is_not_seen() -> None:
    splats = Splats.from_points(torch.tensor([[0.0, 0.0, 0.05]]), torch.ones(1, 3))
    for backend in ("cpu", "reference"):
        seen = [bool(render(splats, looking(np.zeros(3), near), backend=backend).radii) for near in (0.2, 0.049)]
        assert seen == [False, True]
    with pytest.raises(ValueError, match="near must be positive"):
        looking(np.zeros(3), 0.0)
