"""Canonical scales and rotations; the oracles are SciPy's rotations and autograd."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_scenes import front_camera, random_splats
from torch import Tensor

from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import Splats, canonical


def rows(count: int = 500, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Log-scales and quaternions of lengths from 0.1 to 10."""
    g = torch.Generator().manual_seed(0)
    lengths = 10 ** (2 * torch.rand(count, 1, generator=g, dtype=dtype) - 1)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g, dtype=dtype), dim=1)
    return torch.randn(count, 3, generator=g, dtype=dtype), lengths * quats


def scipy_covariances(scales: Tensor, quats: Tensor) -> np.ndarray:
    rotations = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    return np.einsum("nij,nj,nkj->nik", rotations, np.exp(2 * scales.numpy()), rotations)


def test_covariances_stay() -> None:
    scales, quats = rows()
    new = canonical(scales, quats)
    before, after = scipy_covariances(scales, quats), scipy_covariances(new.scales, new.quats)
    size = np.abs(before).max(axis=(1, 2), keepdims=True)
    assert np.abs((after - before) / size).max() < 1e-12
    assert (new.quats[:, 0] >= 0).all()
    torch.testing.assert_close(new.quats.norm(dim=1), torch.ones(500, dtype=torch.float64))


def test_all_48_representatives_become_one() -> None:
    scales, quats = rows(20)
    rotations = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]])
    expected = canonical(scales, quats)
    for turn in Rotation.create_group("O"):
        # The columns of R·G are those of R in another order and direction; the scales go with them.
        other = torch.from_numpy((rotations * turn).as_quat()[:, [3, 0, 1, 2]])
        axes = scales @ torch.from_numpy(np.abs(turn.as_matrix()).round())
        for sign in (1.0, -3.0):
            found = canonical(axes, sign * other)
            torch.testing.assert_close(found.scales, expected.scales)
            torch.testing.assert_close(found.quats, expected.quats)
    assert (expected.scales.diff(dim=1) <= 0).all()
    assert (expected.quats[:, 0] >= 0.5).all()  # the largest w of four half turns


def test_maps_take_gradients_along() -> None:
    scales, quats = rows(50)
    new = canonical(scales, quats)
    weights = torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def gradients(scales: Tensor, quats: Tensor) -> tuple[Tensor, ...]:
        scales, quats = scales.clone().requires_grad_(), quats.clone().requires_grad_()
        w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
        zero = torch.zeros_like(w)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
        rotations = torch.eye(3, dtype=w.dtype) + 2 * w[:, None, None] * cross + 2 * cross @ cross  # Rodrigues
        covariances = rotations @ torch.diag_embed((2 * scales).exp()) @ rotations.mT
        return torch.autograd.grad((weights * covariances).sum(), (scales, quats))

    old_gradients, new_gradients = gradients(scales, quats), gradients(new.scales, new.quats)
    for maps, old, fresh in zip((new.scale_maps, new.quat_maps), old_gradients, new_gradients, strict=True):
        torch.testing.assert_close(torch.einsum("nij,nj->ni", maps, old), fresh)


def test_pictures_stay() -> None:
    splats = random_splats(300)
    new = canonical(splats.scales, splats.quats)
    before, after = (
        render(s, front_camera()).image for s in (splats, splats._replace(scales=new.scales, quats=new.quats))
    )
    # Where float32 rounding moves an alpha over 1/255, a pixel jumps.
    difference = (after - before).abs().amax(-1)
    assert float(difference.quantile(0.99)) < 2e-5
    assert float(difference.max()) < 0.02


def test_canonical_rows_stay_and_a_zero_quaternion_is_the_identity() -> None:
    scales, quats = rows(dtype=torch.float32)
    once = canonical(scales, quats)
    twice = canonical(once.scales, once.quats)
    assert torch.equal(twice.scales, once.scales)
    torch.testing.assert_close(twice.quats, once.quats, rtol=0, atol=1e-6)
    zero = canonical(torch.zeros(1, 3), torch.zeros(1, 4))
    assert zero.quats.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert zero.quat_maps.isfinite().all()


def test_what_is_not_finite_stays_so_and_changes_no_other() -> None:
    scales, quats = rows(5)
    expected = canonical(scales, quats)
    scales[1, 2], quats[3, 0] = torch.nan, torch.nan
    found = canonical(scales, quats)
    assert found.scales.isfinite().all(1).tolist() == [True, False, True, True, True]
    assert found.quats.isfinite().all(1).tolist()[3] is False
    for row in (0, 2, 4):
        assert all(torch.equal(a[row], b[row]) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize(("step", "limit"), [(0.1, 2.0), (20.0, 20 * math.sqrt(10))])
def test_no_first_splat_is_much_larger_than_is_usual(step: float, limit: float) -> None:
    """Where somebody stands in one place and turns, all that is shown is far away in units of the cameras."""
    lines = torch.arange(100.0)[:, None] * torch.tensor([step, 0.0, 0.0])
    points = torch.cat([lines, torch.tensor([[0.0, 0.0, 1e4]])])
    sizes = Splats.from_points(points, torch.full_like(points, 0.5)).scales.exp()[:, 0]
    assert sizes[50].item() == pytest.approx(step * math.sqrt(2), rel=1e-4)  # of one, one and two steps
    assert sizes[-1].item() == pytest.approx(limit * (math.sqrt(2) if step > 1 else 1), rel=1e-4)


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
    with pytest.raises(ValueError, match=r"colours of points are up to 255, not in \[0, 1\]: divide bytes by 255"):
        Splats.from_points(points, torch.full_like(points, 255, dtype=torch.uint8))
    with pytest.raises(ValueError, match="colours of points are up to -1, not in"):
        Splats.from_points(points, torch.full_like(points, -1))


def test_splats_of_arrays_are_those_of_tensors() -> None:
    raw = random_splats(5)
    made = Splats.from_tensors(*(tensor.numpy() for tensor in raw))
    for one, other in zip(made.raw(), raw, strict=True):
        assert torch.equal(one, other)
    made.means.data[0] = 7
    assert not (raw.means == 7).any()
