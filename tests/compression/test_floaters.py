"""Floaters planted among splats that photos support."""

from __future__ import annotations

import numpy as np
import torch

from nsvq_lightning.compression.floaters import floaters
from nsvq_lightning.compression.viewpoints import look_at
from nsvq_lightning.data.scene import View
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import RawSplats, detached
from tests.support.splat_scenes import ball


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
