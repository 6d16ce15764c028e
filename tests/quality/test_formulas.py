"""The algebra of the loss in float64, against plain torch and autograd."""

from __future__ import annotations

import torch
from torch_formulas import in_torch

from nsvq_lightning.quality import formulas
from nsvq_lightning.quality.formulas import SSIM_C1, SSIM_C2

f = in_torch(formulas)


def random(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(sum(shape)))


def moments_of(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    return torch.stack([p, q, p * p + q * q, p * q])


def test_sums_of_moments() -> None:
    p, q = random(2, 3, 9)
    found = f.add_moments(f.moments(0.4, p[0], q[0]), 0.3, p[1], q[1], p[2], q[2])
    expected = (moments_of(p, q) * torch.tensor([0.4, 0.3, 0.3], dtype=torch.float64)[:, None]).sum(1)
    torch.testing.assert_close(torch.stack(found), expected)


def test_similarity_and_its_derivatives() -> None:
    m1, m2, variance1, variance2, along = random(5, 30)
    square1 = (m1 * m1 + variance1).requires_grad_()
    square2 = m2 * m2 + variance2
    product = (m1 * m2 + (along - 0.5) * (variance1 * variance2).sqrt()).requires_grad_()
    m1.requires_grad_()
    luminance = (2 * m1 * m2 + SSIM_C1) / (m1**2 + m2**2 + SSIM_C1)
    structure = (2 * (product - m1 * m2) + SSIM_C2) / (square1 - m1**2 + square2 - m2**2 + SSIM_C2)
    expected = torch.autograd.grad((luminance * structure).sum(), [m1, square1, product])
    inputs = (each.detach() for each in (m1, m2, square1 + square2, product))
    value, derivatives = f.similarity(*inputs)
    torch.testing.assert_close(value, (luminance * structure).detach(), rtol=1e-6, atol=1e-9)
    for ours, theirs in zip(derivatives, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_gradient_of_a_pixel() -> None:
    raw = (1.4 * random(40) - 0.2).requires_grad_()
    q, by_mean, by_square, by_product = random(4, 40)
    p = raw.clamp(0, 1)
    similarity = by_mean * p + by_square * p * p + by_product * p * q
    error = 0.8 * (p - q).abs() + 0.15 * (p - q).square()
    (expected,) = torch.autograd.grad((error - 0.2 * similarity).sum(), raw)
    raw = raw.detach()
    assert torch.equal(f.clamped(raw), raw.clamp(0, 1))
    assert f.clamped(torch.tensor(torch.nan, dtype=torch.float64)).isnan()
    ours = f.pixel_gradient(raw, f.clamped(raw), q, (by_mean, by_square, by_product), (0.8, 0.3, 0.2))
    torch.testing.assert_close(ours, expected)
