"""The algebra of the kernels in float64: forward against the plain torch renderer, backward against autograd."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from splat_scenes import front_camera, random_splats
from torch_formulas import in_torch

from nsvq_lightning.rendering import constants, formulas, reference
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.sampling import ViewSampling
from nsvq_lightning.rendering.sh import sh_basis
from nsvq_lightning.splats.splats import RawSplats

f = in_torch(formulas)
# Constants of the kernels are rounded to float32.
CLOSE = {"rtol": 1e-5, "atol": 1e-6}


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(len(shape) + sum(shape)))


def scene() -> tuple[RawSplats, Camera]:
    return RawSplats(*(tensor.double() for tensor in random_splats(40))), front_camera()


def view_of(camera: Camera) -> Any:
    *rotation, t, _ = torch.tensor(camera.packed_view, dtype=torch.float64).reshape(5, 3)
    low_x, high_x, low_y, high_y = camera.slope_limits
    return rotation, t, camera.intrinsics[:2], (low_x, high_x), (low_y, high_y)


def axes(splats: RawSplats, camera: Camera) -> torch.Tensor:
    """The splats' axes along x and y of the image ``[2, N, 3]``."""
    view = view_of(camera)
    _, _, *rows = f.affine(view, f.view_point(view, splats.means.unbind(1)))
    *_, m = f.axes_of(splats.quats.unbind(1), splats.scales.unbind(1))
    return torch.stack([torch.stack(f.image_axes(row, m), 1) for row in rows])


# Distances that training saw splats from, as shares of those of the scene's camera, and the size of its pictures.
SAMPLINGS = {
    "none": None,
    "anti-aliased": (0.0, 0.0, 0.0),
    "same": (0.9, 1.1, 1.0),
    "half size": (0.9, 1.1, 0.25),
    "double size": (0.9, 1.1, 4.0),
    "from nearer": (0.4, 0.6, 1.0),
    "from farther": (1.5, 2.0, 1.0),
    "from both": (0.8, 1.0, 1.0),
}
samplings = pytest.mark.parametrize("sampling", SAMPLINGS.values(), ids=SAMPLINGS)


def sampling_of(splats: RawSplats, camera: Camera, sampling: Any) -> ViewSampling | None:
    if sampling is None:
        return None
    nearest, farthest, size = sampling
    distance = (splats.means.detach() - camera.to(dtype=torch.float64).position).norm(dim=1)
    spread = torch.linspace(0.8, 1.2, len(distance), dtype=torch.float64)  # some are within, some are not
    return ViewSampling(torch.stack([nearest * spread * distance, farthest * spread * distance]), size)


@samplings
def test_splats_lie_where_the_reference_puts_them(sampling: Any) -> None:
    splats, camera = scene()
    (_, _, z), *expected = reference.image_axes(splats.means, splats.quats, splats.scales, camera)
    torch.testing.assert_close(axes(splats, camera), torch.stack(expected), **CLOSE)
    point = f.view_point(view_of(camera), splats.means.unbind(1))
    torch.testing.assert_close(point[2], z, **CLOSE)

    screen = *camera.intrinsics[2:], camera.width, camera.height, camera.near
    shape = splats.quats.unbind(1), splats.scales.unbind(1)
    logits = splats.opacities
    trained = sampling_of(splats, camera, sampling)
    of_kernel = None if trained is None else (*trained.distances, trained.size)
    seen, record, first, last, radius = f.footprint(view_of(camera), screen, point, *shape, logits, of_kernel)
    expected = reference.project(splats, camera, trained)
    if trained is not None and sampling[2] < 1:
        assert (expected.opacities < 0.9 * logits.sigmoid()).any()
    x, y, a, b, c, log2_opacity, depth, slope_x, slope_y = record
    torch.testing.assert_close(torch.stack([x, y], 1), expected.means2d, **CLOSE)
    torch.testing.assert_close(depth, expected.depths, **CLOSE)
    rows = reference.visible(splats, camera, trained)
    torch.testing.assert_close(log2_opacity.exp2()[rows], expected.opacities[rows], **CLOSE)
    # The factor times itself is the inverse covariance in the binary exponent.
    conics = torch.stack([a * a, a * b, b * b + c * c], 1) * (2 / formulas.LOG2_E)
    torch.testing.assert_close(conics, expected.conics, **CLOSE)
    torch.testing.assert_close(slope_x, -expected.conics[:, 1] / expected.conics[:, 2], **CLOSE)
    torch.testing.assert_close(slope_y, -expected.conics[:, 1] / expected.conics[:, 0], **CLOSE)
    assert torch.equal(seen.nonzero()[:, 0], rows)
    low = ((expected.means2d - expected.half_sizes - 0.5).ceil().clamp_min(0) / formulas.TILE).floor()
    torch.testing.assert_close(torch.stack(first, 1)[rows], low[rows], atol=0, rtol=0)
    assert all(((end - begin)[rows] >= 0).all() for begin, end in zip(first, last, strict=True))
    assert torch.equal(radius[rows], expected.half_sizes.amax(1).ceil()[rows])


def test_bands_and_their_gradients() -> None:
    d = torch.nn.functional.normalize(random(50, 3), dim=1)
    bands = [*f.bands1(d.unbind(1)), *f.bands2(d.unbind(1)), *f.bands3(d.unbind(1))]
    torch.testing.assert_close(torch.stack(bands, 1), sh_basis(d, 3)[:, 1:], **CLOSE)
    e = random(50, 15)
    d.requires_grad_()
    for degree, end in ((1, 3), (2, 8), (3, 15)):
        (expected,) = torch.autograd.grad((sh_basis(d, degree)[:, 1:] * e[:, :end]).sum(), d)
        g = f.direction_gradient1(e[:, :3].unbind(1))
        if degree > 1:
            g = f.direction_gradient2(g, d.detach().unbind(1), e[:, 3:8].unbind(1))
        if degree > 2:
            g = f.direction_gradient3(g, d.detach().unbind(1), e[:, 8:].unbind(1))
        torch.testing.assert_close(torch.stack(torch.broadcast_tensors(*g), 1), expected, **CLOSE)


def test_gradient_through_the_viewing_direction() -> None:
    means, g = random(20, 3).requires_grad_(), random(20, 3)
    position = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    direction = torch.nn.functional.normalize(means - position, dim=1)
    (expected,) = torch.autograd.grad((direction * g).sum(), means)
    d, inverse = f.unit_direction(position, means.detach().unbind(1))
    torch.testing.assert_close(torch.stack(d, 1), direction.detach(), **CLOSE)
    torch.testing.assert_close(torch.stack(f.mean_gradient(d, inverse, g.unbind(1)), 1), expected, **CLOSE)


def test_gradient_of_a_quaternion() -> None:
    quats, g = (2 * random(30, 4)).requires_grad_(), random(30, 3, 3)
    (expected,) = torch.autograd.grad((reference.rotation_matrices(quats) * g).sum(), quats)
    unit, inverse, _, _ = f.axes_of(quats.detach().unbind(1), (torch.zeros(()),) * 3)
    rows = [row.unbind(1) for row in g.unbind(1)]
    torch.testing.assert_close(torch.stack(f.quaternion_gradient(unit, inverse, rows), 1), expected, **CLOSE)


@samplings
def test_gradients_of_the_geometry(sampling: Any) -> None:
    splats, camera = scene()
    moments, h, centre, g_depth = random(40, 3), random(40) + 1, random(40, 2), random(40)
    leaves = [splats.means, splats.quats, splats.scales]
    for leaf in leaves:
        leaf.requires_grad_()
    (_, _, z), u, v = reference.image_axes(*leaves, camera)
    trained = sampling_of(splats, camera, sampling)
    of_kernel = None if trained is None else (*trained.distances, trained.size)
    projected = reference.project(splats, camera, trained)
    # Moments are those of h·uuᵀ with u = F·(x - centre), so that dL/dΣ⁻¹ = -½ Σ h (x - centre)(x - centre)ᵀ.
    view = view_of(camera)
    point = f.view_point(view, splats.means.detach().unbind(1))
    screen = *camera.intrinsics[2:], camera.width, camera.height, camera.near
    shape = splats.quats.detach().unbind(1), splats.scales.detach().unbind(1)
    _, record, *_ = f.footprint(view, screen, point, *shape, splats.opacities, of_kernel)
    factor = record[2:5]
    a, b, c = factor
    zero = torch.zeros_like(a)
    F = torch.stack([torch.stack([a, b], 1), torch.stack([zero, c], 1)], 1)
    S = torch.stack([moments[:, :2], moments[:, 1:]], 1)
    g_covariance = F.mT @ S @ F * (formulas.MOMENT_SCALE / 2)
    U = torch.stack([u, v], 1)
    away = (splats.means - camera.position).square().sum(1)
    blur = constants.BLUR * reference.sampling_ratio(away, trained).clamp_min(1)
    blurred = U @ U.mT + blur[:, None, None] * torch.eye(2)
    loss = (g_covariance * blurred).sum() + (projected.means2d * centre).sum() + (z * g_depth).sum()
    if trained is not None:
        loss = loss + (h * (projected.opacities / splats.opacities.sigmoid()).log()).sum()
    expected = torch.autograd.grad(loss, leaves)
    found = f.geometry_backward(view, point, *shape, factor, moments.unbind(1), h, centre.unbind(1), g_depth, of_kernel)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(torch.stack(ours, 1), theirs, rtol=1e-4, atol=1e-6)


def test_a_splat_at_a_pixel() -> None:
    a, b, c, x0, y0 = random(5, 30)
    x, y = random(2, 30)
    peak = -random(30).abs()
    power, u, v = f.exponent(a, b, c, -(a * x0 + b * y0), -(c * y0), peak, x, y)
    torch.testing.assert_close(u, a * (x - x0) + b * (y - y0), **CLOSE)
    torch.testing.assert_close(v, c * (y - y0), **CLOSE)
    torch.testing.assert_close(power, peak - u * u - v * v, **CLOSE)

    power = torch.tensor([-7.9, -8.1, -0.001, -0.5, -0.001], dtype=torch.float64)
    t = torch.tensor([0.5, 0.5, 0.5, 1e-4, 0.9], dtype=torch.float64)
    raw, alpha, after, is_open, weight = f.blend_step(power, t)
    torch.testing.assert_close(raw, power.exp2(), **CLOSE)
    torch.testing.assert_close(alpha, torch.where(power > -8, raw.clamp_max(0.99), 0.0), **CLOSE)
    torch.testing.assert_close(after, t * (1 - alpha), **CLOSE)
    assert is_open.tolist() == [True, True, True, False, True]
    torch.testing.assert_close(weight, torch.where(is_open, alpha * t, 0.0), **CLOSE)


@pytest.mark.parametrize("name", ["clamped", "unclamped"])
def test_colours_stop_at_zero(name: str) -> None:
    rgb = random(8, 3).requires_grad_()
    g = random(8, 3) + 1
    if name == "clamped":
        ours, expected = f.clamped(rgb.detach().unbind(1)), rgb.detach().clamp_min(0)
    else:
        (expected,) = torch.autograd.grad((rgb.clamp_min(0) * g).sum(), rgb)
        ours = f.unclamped(rgb.detach().unbind(1), g.unbind(1))
    torch.testing.assert_close(torch.stack(ours, 1), expected)
    assert f.clamped((torch.tensor(torch.nan, dtype=torch.float64),) * 3)[1].isnan()


def test_gradient_of_an_opacity() -> None:
    logits, g = (3 * random(20)).requires_grad_(), random(20)
    alpha = 0.7 * logits.sigmoid()
    (expected,) = torch.autograd.grad((alpha * g).sum(), logits)
    torch.testing.assert_close(f.logit_gradient(logits.detach(), alpha.detach() * g), expected, **CLOSE)
