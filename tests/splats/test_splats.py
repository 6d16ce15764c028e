"""First splats from points; the oracle is their distance."""

from __future__ import annotations

import math

import pytest
import torch

from nsvq_lightning.splats.splats import Splats


def test_first_splats_are_as_large_as_their_distance_says() -> None:
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
    points = torch.cat([torch.tensor([[math.nan, 0.0, 0.0]]), corners, corners[:1]])  # one not finite, one twice
    plain = Splats.from_points(points, torch.full_like(points, 0.5), sh_degree=1)
    assert torch.equal(plain.means, corners)
    assert plain.scales.exp().detach().flatten().tolist() == pytest.approx([((1 + 4 + 5) / 3) ** 0.5] * 24)
    assert plain.opacities.sigmoid().tolist() == pytest.approx([0.1] * 8)
    other = Splats.from_points(points, torch.full_like(points, 0.5), sh_degree=1, opacity=0.3)
    assert torch.equal(other.scales, plain.scales)
    assert other.opacities.sigmoid().tolist() == pytest.approx([0.3] * 8)
