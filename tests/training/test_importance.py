"""Contributions and sensitivities of splats against their definitions, and floaters."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from splat_scenes import front_camera, random_splats
from torch import Tensor

from nsvq_lightning.compression.viewpoints import look_at
from nsvq_lightning.compute import memory
from nsvq_lightning.compute.devices import kernels_for
from nsvq_lightning.data.scene import View
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import Render, render
from nsvq_lightning.rendering.sh import C0
from nsvq_lightning.splats.splats import RawSplats, SplatTensors, detached
from nsvq_lightning.training.importance import (
    contributions,
    floaters,
    likely_effects,
    row_weights,
    sensitivity,
)
from tests.support.splat_scenes import ball


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


def test_where_nothing_shows_opaque_and_large_splats_count_most() -> None:
    splats = detached(random_splats(50))
    effects = likely_effects(splats, torch.zeros(50))
    assert torch.isfinite(effects).all()
    larger = splats._replace(opacities=splats.opacities + 1, scales=splats.scales + 1)
    assert (likely_effects(larger, torch.zeros(50)) > effects).all()


def test_weights_are_never_zero() -> None:
    torch.testing.assert_close(row_weights(torch.tensor([0.0, 200.0])), torch.tensor([1.0, 201.0]))
    assert (row_weights(torch.zeros(3)) > 0).all()


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
    estimates = [sensitivity(splats, CAMERA, render, generator(1, draw))[0] for draw in range(150)]
    for name, derivative in zip(RawSplats._fields, jacobian, strict=True):
        exact = derivative.square().sum(0)
        mean = torch.stack([getattr(estimate, name) for estimate in estimates]).mean(0)
        torch.testing.assert_close(mean, exact, rtol=0.5, atol=1e-5)
    assert not any(getattr(estimates[0], name)[3].any() for name in RawSplats._fields)


def test_the_picture_comes_with_it_and_nothing_is_tracked() -> None:
    splats = few_splats()
    squares, image = sensitivity(splats, CAMERA, render, generator(1))
    assert torch.equal(image, render(splats, CAMERA).image)
    assert not image.requires_grad
    assert not any(tensor.requires_grad for tensor in (*squares, *splats))
    again, _ = sensitivity(splats, CAMERA, render, generator(1))
    assert all(torch.equal(first, second) for first, second in zip(squares, again, strict=True))


def joined(*parts: RawSplats) -> RawSplats:
    return RawSplats(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))


def test_planted_floaters_go_and_splats_that_photos_show_stay() -> None:
    own = detached(ball(600).decode())
    directions = np.random.default_rng(0).standard_normal((24, 3))
    eyes = 6 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    cameras = [look_at(np.zeros(3), eye, 64, 48, 0.9) for eye in eyes]
    noise = torch.Generator().manual_seed(0)
    with torch.no_grad():
        pictures = [render(own, camera).image.clamp(0, 1) for camera in cameras]
    photos = [(255 * p + 2 * torch.randn(p.shape, generator=noise)).round().clamp(0, 255).byte() for p in pictures]
    views = [View(str(i), i, camera, photo) for i, (camera, photo) in enumerate(zip(cameras, photos, strict=True))]
    count = 30
    seen_by = torch.from_numpy(eyes).float()[torch.randint(24, (count,), generator=noise)]
    floating = RawSplats(
        means=seen_by * (0.5 + 0.3 * torch.rand(count, 1, generator=noise)),
        quats=torch.randn(count, 4, generator=noise),
        scales=torch.full((count, 3), -1.8),
        opacities=torch.randn(count, generator=noise),
        sh0=torch.randn(count, 1, 3, generator=noise),
        shN=torch.zeros(count, *own.shN.shape[1:]),
    )
    behind_all = RawSplats(*(tensor[:1].clone() for tensor in own))._replace(means=torch.tensor([[0.0, 0.0, 50.0]]))
    removed = floaters(joined(own, floating, behind_all), lambda: views, render)
    assert removed[600:630].float().mean() > 0.9
    assert removed[:600].float().mean() < 0.02
    assert not floaters(own, lambda: views, render)[:600].any()


def test_a_mask_hides_what_it_excludes() -> None:
    """A splat that contradicts only excluded pixels is not seen by any photo that counts."""
    own = detached(ball(50, 0).decode())
    camera = look_at(np.zeros(3), np.array([0.0, 0.0, -6.0]), 64, 48, 0.9)
    with torch.no_grad():
        photo = (255 * render(own, camera).image.clamp(0, 1)).byte()
    mask = torch.zeros(48, 64, dtype=torch.bool)
    removed = floaters(own, lambda: [View("0", 0, camera, photo * mask[..., None], mask)], render)
    assert removed.all()


def test_each_view_takes_the_memory_of_the_one_before() -> None:
    memory.trim()
    contributions(random_splats(50), [front_camera()] * 3, rendered)
    assert len(memory._IDLE) == (kernels_for(torch.zeros(1)) == "cpu")
