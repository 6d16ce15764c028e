"""The estimate against the sums of squared derivatives that it stands for."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from nsvq_lightning.compression.sensitivity import sensitivity
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import RawSplats

INTRINSICS = torch.tensor([[12.0, 0.0, 6.0], [0.0, 12.0, 5.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(K=INTRINSICS, viewmat=torch.eye(4), width=12, height=10)


def few_splats() -> RawSplats:
    draw = generator(3)
    means = torch.randn(4, 3, generator=draw) * torch.tensor([0.5, 0.4, 0.2]) + torch.tensor([0.0, 0.0, 2.0])
    means[3, 2] = -2.0  # behind the camera
    return RawSplats(
        means=means,
        quats=torch.randn(4, 4, generator=draw),
        scales=torch.randn(4, 3, generator=draw) * 0.3 - 1.5,
        opacities=torch.randn(4, generator=draw),
        sh0=torch.rand(4, 1, 3, generator=draw),
        shN=torch.zeros(4, 0, 3),
    )


def test_the_mean_estimate_is_the_sum_of_squared_derivatives() -> None:
    splats = few_splats()
    jacobian = cast(
        tuple[Tensor, ...],
        torch.autograd.functional.jacobian(lambda *raw: render(RawSplats(*raw), CAMERA).image.flatten(), tuple(splats)),
    )
    estimates = [sensitivity(splats, CAMERA, render, generator(1, draw))[0] for draw in range(400)]
    for name, derivative in zip(RawSplats._fields, jacobian, strict=True):
        exact = derivative.square().sum(0)
        mean = torch.stack([getattr(estimate, name) for estimate in estimates]).mean(0)
        torch.testing.assert_close(mean, exact, rtol=0.35, atol=1e-5)
    assert not any(getattr(estimates[0], name)[3].any() for name in RawSplats._fields)


def test_the_picture_comes_with_it_and_nothing_is_tracked() -> None:
    splats = few_splats()
    squares, image = sensitivity(splats, CAMERA, render, generator(1))
    assert torch.equal(image, render(splats, CAMERA).image)
    assert not image.requires_grad
    assert not any(tensor.requires_grad for tensor in (*squares, *splats))
    again, _ = sensitivity(splats, CAMERA, render, generator(1))
    assert all(torch.equal(first, second) for first, second in zip(squares, again, strict=True))
