"""Which canonical form k-means likes best."""

from __future__ import annotations

import torch
from torch import Tensor

from nsvq_lightning.compression.covariance_error import covariance_error, covariances, form_errors


def shuffled_axes(count: int) -> tuple[Tensor, Tensor]:
    """Flat splats near three orientations, each each given by one of four of its 48 pairs at random."""
    g = torch.Generator().manual_seed(0)
    scales = torch.tensor([-1.0, -2.0, -5.0]) + 0.02 * torch.randn(count, 3, generator=g)
    quats = torch.nn.functional.normalize(torch.randn(3, 4, generator=g), dim=1)[torch.arange(count) % 3]
    quats = quats + 0.02 * torch.randn(count, 4, generator=g)
    # A third of a turn around the diagonal brings each axis into the place of the next one.
    w, x, y, z = quats.unbind(1)
    turned = 0.5 * torch.stack([w - x - y - z, x + w + z - y, y - z + w + x, z + y - x + w], 1)
    once = torch.rand(count, 1, generator=g) < 0.5
    scales, quats = torch.where(once, scales[:, [1, 2, 0]], scales), torch.where(once, turned, quats)
    return scales, quats * torch.where(torch.rand(count, 1, generator=g) < 0.5, -1.0, 1.0)


def test_shuffled_axes_are_best_sorted() -> None:
    scales, quats = shuffled_axes(600)
    errors = form_errors(scales, quats, {"scales": 6, "quats": 6}, seed=0)
    assert errors["full"] < 0.8 * errors["sign"]
    assert errors["sign"] < 0.8 * errors["none"]
    assert form_errors(scales, quats, {"scales": 6, "quats": 6}, seed=0) == errors


def test_what_is_not_quantized_has_no_error() -> None:
    scales, quats = shuffled_axes(100)
    errors = form_errors(scales, quats, {"scales": 100}, seed=0)
    assert max(errors.values()) < 1e-6


def test_the_error_is_that_of_the_definition() -> None:
    exact = covariances(torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0], [0, 2.0, 0, 0]]))
    torch.testing.assert_close(exact, torch.eye(3).expand(2, 3, 3))
    found = exact.clone()
    found[1, 0, 0] = 4.0  # off by 3, and ‖I‖ = √3
    assert abs(covariance_error(found, exact) - 0.5 * 3**0.5) < 1e-6
