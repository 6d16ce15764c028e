"""Contributions of splats; the oracle renders each splat alone bright among black ones, in float64."""

from __future__ import annotations

import torch
from splat_scenes import front_camera, random_splats
from torch import Tensor

from nsvq_lightning.compression.importance import contributions, least_contributing, most_contributing, row_weights
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render, render
from nsvq_lightning.rendering.sh import C0
from nsvq_lightning.splats.splats import RawSplats, SplatTensors


def rendered(splats: SplatTensors, camera: Camera) -> Render:
    return render(splats, camera)


def one_by_one(splats: RawSplats, camera: Camera) -> Tensor:
    double = RawSplats(*(tensor.double() for tensor in splats))
    black = torch.full_like(double.sh0, -0.5 / C0)
    light = []
    for row in range(len(splats.means)):
        sh0 = black.clone()
        sh0[row] = 0.5 / C0
        image = render(double._replace(sh0=sh0, shN=double.shN[:, :0]), camera, backend="reference").image
        light.append(image[..., 0].sum())
    return torch.stack(light)


def test_contributions_are_blending_weights() -> None:
    splats, cameras = random_splats(40, log_scale=-1.5), [front_camera(), front_camera(30, 50)]
    found = contributions(splats, cameras, rendered)
    expected = one_by_one(splats, cameras[0]) + one_by_one(splats, cameras[1])
    assert int((expected > 0).sum()) > 30
    torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=1e-3)
    assert all(tensor.grad is None for tensor in splats)


def test_all_contributions_make_the_alpha_of_the_picture() -> None:
    splats, camera = random_splats(2000), front_camera()
    found = contributions(splats, [camera], rendered)
    torch.testing.assert_close(found.sum(), render(splats, camera).alpha.sum(), rtol=1e-4, atol=0)


def test_the_least_contributing_go() -> None:
    contribution = torch.tensor([5.0, 0.0, 1.0, 90.0, 0.0, 4.0])
    assert least_contributing(contribution, 0.0).nonzero()[:, 0].tolist() == [1, 4]
    assert least_contributing(contribution, 0.049).nonzero()[:, 0].tolist() == [1, 2, 4]
    assert least_contributing(contribution, 0.05).nonzero()[:, 0].tolist() == [1, 2, 4, 5]
    assert least_contributing(contribution, 0.999).nonzero()[:, 0].tolist() == [0, 1, 2, 4, 5]


def test_weights_are_never_zero() -> None:
    torch.testing.assert_close(row_weights(torch.tensor([0.0, 200.0])), torch.tensor([1.0, 201.0]))
    assert (row_weights(torch.zeros(3)) > 0).all()


def test_the_most_contributing_are_kept_and_of_equals_the_first() -> None:
    contribution = torch.tensor([0.0, 3.0, 1.0, 3.0, 1.0, 2.0])
    assert most_contributing(contribution, 2).nonzero()[:, 0].tolist() == [1, 3]
    assert most_contributing(contribution, 4).nonzero()[:, 0].tolist() == [1, 2, 3, 5]
    assert most_contributing(contribution, 6).all()
