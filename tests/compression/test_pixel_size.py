"""How large a pixel is at a splat, and the floor of scales that follows from it."""

from __future__ import annotations

import math

import pytest
import torch

from nsvq_lightning.compression.pixel_size import pixel_sizes, scale_floor
from nsvq_lightning.rendering.camera import Camera


def camera(focal: float = 100.0, back: float = 0.0) -> Camera:
    """Looks along +z from ``back`` behind the origin, 60×40 pixels."""
    K = torch.tensor([[focal, 0.0, 30.0], [0.0, 0.9 * focal, 20.0], [0.0, 0.0, 1.0]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = back
    return Camera(K, viewmat, 60, 40)


def test_a_pixel_is_depth_over_focal_length_in_the_closest_view() -> None:
    means = torch.tensor([[0.0, 0.0, 2.0], [0.1, -0.1, 4.0]])
    torch.testing.assert_close(pixel_sizes(means, [camera()]), torch.tensor([0.02, 0.04]))
    views = [camera(back=1.0), camera(), camera(focal=10.0)]
    torch.testing.assert_close(pixel_sizes(means, views), torch.tensor([0.02, 0.04]))


def test_only_views_that_show_the_centre_count() -> None:
    behind, too_near, left, below = [0.0, 0.0, -1.0], [0.0, 0.0, 0.1], [-0.4, 0.0, 1.0], [0.0, 0.3, 1.0]
    broken, seen = [math.nan, 0.0, 1.0], [-0.2, 0.1, 1.0]
    sizes = pixel_sizes(torch.tensor([behind, too_near, left, below, broken, seen]), [camera()])
    assert sizes.tolist() == [math.inf] * 5 + [pytest.approx(0.01)]


def test_the_floor_is_where_all_but_a_few_splats_are_seen_from_farther_away() -> None:
    means = torch.zeros(101, 3)
    means[:, 2] = torch.arange(101) / 100 + 1
    assert scale_floor(means, [camera()], 0.5) == pytest.approx(math.log(0.5 * 1.05 / 100))
    # Nor do those count that no view shows, or more splats than are looked at.
    means = torch.cat([means.repeat(2000, 1), -means])
    assert scale_floor(means, [camera()], 0.5) == pytest.approx(math.log(0.5 * 1.05 / 100), abs=1e-3)


def test_without_a_view_of_any_splat_there_is_no_floor() -> None:
    assert scale_floor(torch.zeros(3, 3), [camera()]) is None
    assert scale_floor(torch.zeros(0, 3), [camera()]) is None
    assert scale_floor(torch.ones(3, 3), []) is None
