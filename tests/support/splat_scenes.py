"""Small random scenes for the rasterizer tests."""

from __future__ import annotations

import numpy as np
import torch
from compressed_scenes import scene_of

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.splats.splats import RawSplats


def random_splats(n: int, seed: int = 0, sh_degree: int = 3, log_scale: float = -2.5) -> RawSplats:
    """Splats in a ball around the origin, seen well by :func:`front_camera`."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return RawSplats(
        means=normal(n, 3) * 0.8,
        quats=normal(n, 4),
        scales=log_scale + 0.6 * normal(n, 3),
        opacities=1.5 * normal(n),
        sh0=normal(n, 1, 3),
        shN=0.2 * normal(n, (sh_degree + 1) ** 2 - 1, 3),
    )


def uneven_splats(n: int) -> RawSplats:
    """Four parts of equally many splats: tiny ones, long ones, needles and plain ones; the first is huge."""
    splats = random_splats(n, seed=6)
    scales = splats.scales.clone()
    tiny, long, thin = (slice(k * n // 4, (k + 1) * n // 4) for k in range(3))
    scales[tiny], scales[long, 0], scales[thin, 1:], scales[0] = -12.0, 0.5, -9.0, 1.0
    return splats._replace(scales=scales)


def front_camera(width: int = 70, height: int = 45, cx: float | None = None, cy: float | None = None) -> Camera:
    """A camera four units in front of the origin, slightly turned."""
    focal = 0.9 * width
    K = torch.tensor(
        [
            [focal, 0, width / 2 if cx is None else cx],
            [0, 1.1 * focal, height / 2 if cy is None else cy],
            [0, 0, 1],
        ]
    )
    angle = torch.tensor(0.3)
    viewmat = torch.eye(4)
    viewmat[0, 0] = viewmat[2, 2] = angle.cos()
    viewmat[0, 2], viewmat[2, 0] = angle.sin(), -angle.sin()
    viewmat[:3, 3] = torch.tensor([0.1, -0.05, 4.0])
    return Camera(K, viewmat, width, height)


def some_pixel_weights(camera: Camera) -> torch.Tensor:
    """A strength for each pixel, of both signs."""
    return torch.randn(camera.height, camera.width, generator=torch.Generator().manual_seed(1))


def ball(count: int = 1500, degree: int = 1) -> CompressedScene:
    """A ball of splats."""
    rng = np.random.default_rng(count)
    coefficients = (degree + 1) ** 2 - 1
    return scene_of(
        means=rng.standard_normal((count, 3), np.float32),
        quats=rng.standard_normal((count, 4), np.float32),
        scales=(-2.5 + 0.5 * rng.standard_normal((count, 3))).astype(np.float32),
        opacities=rng.standard_normal(count, np.float32),
        sh0=rng.standard_normal((count, 1, 3), np.float32),
        shN=(0.1 * rng.standard_normal((count, coefficients, 3))).astype(np.float32),
    )
