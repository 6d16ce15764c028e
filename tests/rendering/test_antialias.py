"""Anti-aliasing: the same in all back-ends, with exact gradients, and alike at other resolutions."""

import math

import pytest
import torch

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.rendering.reference import light_kept
from nsvq_lightning.splats.splats import RawSplats
from tests.support.splat_scenes import front_camera, random_splats


def scaled(camera: Camera, factor: float) -> Camera:
    """The camera of the same picture with ``factor`` times as many pixels a side."""
    stretch = torch.diag(torch.tensor([factor, factor, 1.0], dtype=camera.K.dtype))
    return Camera(stretch @ camera.K, camera.viewmat, round(camera.width * factor), round(camera.height * factor))


def shrunk(image: torch.Tensor, factor: int) -> torch.Tensor:
    height, width, _ = image.shape
    return image.reshape(height // factor, factor, width // factor, factor, 3).mean((1, 3))


def leaves(splats: RawSplats, dtype: torch.dtype) -> RawSplats:
    return RawSplats(*(tensor.detach().to(dtype).requires_grad_() for tensor in splats))


@pytest.mark.parametrize("log_scale", [-5.0, -3.5, -2.0])
def test_the_kernels_compute_what_plain_torch_does(log_scale: float) -> None:
    camera, splats = front_camera(), random_splats(300, log_scale=log_scale)
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(3))
    fast, exact = leaves(splats, torch.float32), leaves(splats, torch.float64)
    images = []
    for tensors, backend in ((fast, "cpu"), (exact, "reference")):
        image = render(tensors, camera, antialiased=True, backend=backend).image
        (image * weights.to(image)).sum().backward()
        images.append(image.detach().double())
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=2e-4)
    for name, mine, true in zip(RawSplats._fields, fast, exact, strict=True):
        if true.grad is None:
            continue
        error = (mine.grad.double() - true.grad).norm() / true.grad.norm().clamp_min(1e-12)
        assert float(error) < 2e-3, name
    plain = render(splats, camera, backend="cpu").image
    assert float((plain.detach() - images[0]).abs().max()) > 0.01


def test_the_factor_is_that_of_the_determinants() -> None:
    """A splat of known size, straight ahead: √(s² / (s² + 0.3)) along each axis of the picture."""
    camera = front_camera()
    depth, pixels = 4.0, 0.5
    forward, position = camera.viewmat[2, :3], -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    scale = pixels * depth / camera.intrinsics[0]
    splats = RawSplats(
        means=(position + depth * forward)[None].float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), scale).log(),
        opacities=torch.tensor([0.3]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )
    along = camera.intrinsics[1] / camera.intrinsics[0]
    expected = math.prod((size / (size + 0.3)) ** 0.5 for size in (pixels**2, (pixels * along) ** 2))
    assert float(light_kept(splats, camera, torch.tensor([0]))) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_pictures_are_alike_at_half_and_double_resolution(factor: float) -> None:
    """Against the mean of many small pixels, in which the blur is nothing."""
    camera = front_camera(64, 48)
    splats = random_splats(400, log_scale=-4.2)
    fine = shrunk(render(splats, scaled(camera, 16 * factor)).image, 16)
    errors = {
        antialiased: float((render(splats, scaled(camera, factor), antialiased=antialiased).image - fine).abs().mean())
        for antialiased in (False, True)
    }
    assert errors[True] < 0.5 * errors[False]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_broken_and_huge_splats_do_no_harm(backend: str) -> None:
    camera, splats = front_camera(), random_splats(40)
    splats.means[0], splats.scales[1], splats.quats[2] = torch.nan, 40.0, 0.0
    splats.opacities[3], splats.opacities[4], splats.scales[5] = 60.0, -60.0, -60.0
    splats.means[6] = -splats.means[6] * 10
    tensors = leaves(splats, torch.float32 if backend == "cpu" else torch.float64)
    image = render(tensors, camera, antialiased=True, backend=backend).image
    image.sum().backward()
    assert image.isfinite().all()
    good = [i for i in range(40) if i != 0]
    assert all(tensor.grad[good].isfinite().all() for tensor in tensors if tensor.grad is not None)


def test_nothing_in_view() -> None:
    camera, splats = front_camera(), random_splats(5)
    away = splats._replace(means=splats.means * 0 - 50 * camera.viewmat[2, :3].float())
    assert len(visible(away, camera)) == 0
    assert float(render(away, camera, antialiased=True).image.abs().max()) == 0
