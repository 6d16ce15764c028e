from __future__ import annotations

from typing import TypeVar

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import CodebookQuantizer, StraightThrough, TrainedStraightThrough
from nsvq_lightning.quantize.base import as_quantizer, is_refittable
from nsvq_lightning.random import generator

Kind = TypeVar("Kind", bound=CodebookQuantizer)


def fitted(dim: int = 3, count: int = 300, kind: type[Kind] = StraightThrough) -> tuple[Kind, Tensor]:  # type: ignore[assignment]
    x = torch.randn(count, dim, generator=generator(0))
    quantizer = kind(16, dim, kmeans_steps=2)
    quantizer.fit(x, generator=generator(1))
    return quantizer, x.requires_grad_()


def distortion(quantizer: StraightThrough, x: Tensor) -> float:
    """Mean squared distance to the nearest code, by torch alone."""
    return float(torch.cdist(x.double(), quantizer.codebook.detach().double()).amin(1).square().mean())


def test_is_a_quantizer_that_is_refitted() -> None:
    assert as_quantizer(StraightThrough(4, 3))
    assert is_refittable(StraightThrough(4, 3))
    assert as_quantizer(TrainedStraightThrough(4, 3))
    assert not is_refittable(TrainedStraightThrough(4, 3))


@pytest.mark.parametrize("kind", [StraightThrough, TrainedStraightThrough])
@pytest.mark.parametrize("dim", [3, 45])
@pytest.mark.parametrize("chosen", [None, [0, 3, 4, 299], []])
def test_value_is_the_code_and_the_gradient_goes_to_the_rows(
    dim: int, chosen: list[int] | None, kind: type[CodebookQuantizer]
) -> None:
    quantizer, x = fitted(dim, kind=kind)
    rows = None if chosen is None else torch.tensor(chosen, dtype=torch.int64)
    which = slice(None) if rows is None else rows
    x_q, codes = quantizer(x, generator(2), rows)
    assert torch.equal(codes, quantizer.encode(x)[which])
    assert torch.equal(x_q, quantizer.decode(quantizer.encode(x))[which])
    grad = torch.randn(x_q.shape, generator=generator(3))
    x_q.backward(grad)
    expected = torch.zeros_like(x)
    expected[which] = grad
    assert torch.equal(x.grad, expected)
    if kind is StraightThrough:
        assert quantizer.codebook.grad is None
    else:  # as of the codes themselves, which fine-tuning trains
        (to_codes,) = torch.autograd.grad(quantizer.decode(codes), quantizer.codebook, grad)
        assert torch.equal(quantizer.codebook.grad, to_codes)


def test_refit_lowers_the_distortion_and_stays_where_rows_stay() -> None:
    quantizer, x = fitted()
    moved = x.detach() + torch.tensor([1.0, -0.5, 0.25])
    parameter, distortions = quantizer.codebook, [distortion(quantizer, moved)]
    for steps in (1, 1, 5, 40):
        quantizer.refit(moved, steps)
        distortions.append(distortion(quantizer, moved))
    assert quantizer.codebook is parameter
    assert distortions == sorted(distortions, reverse=True)
    assert distortions[-1] < 0.6 * distortions[0]
    # At the fixed point every code in use is the mean of its rows.
    codes = quantizer.encode(moved)
    for code in codes.unique():
        torch.testing.assert_close(quantizer.codebook[code].detach(), moved[codes == code].mean(0))
    before = quantizer.codebook.detach().clone()
    quantizer.refit(moved, 1)
    torch.testing.assert_close(quantizer.codebook.detach(), before)


def test_searches_after_a_refit_are_exact() -> None:
    """The search remembers last codes, and a refit moves all of them at once."""
    quantizer, x = fitted(45)
    for step in range(4):
        x = (x + 0.1).detach()
        quantizer.refit(x, 3)
        _, codes = quantizer(x, generator(step))
        assert torch.equal(codes, torch.cdist(x.double(), quantizer.codebook.double()).argmin(1))


def test_frozen_codes_train_the_codebook() -> None:
    quantizer, x = fitted()
    quantizer.freeze(quantizer.encode(x))
    x_q, codes = quantizer(x)
    x_q.backward(torch.ones_like(x_q))
    assert x.grad is None
    counts = torch.bincount(codes, minlength=16).float()
    assert torch.equal(quantizer.codebook.grad, counts[:, None].expand(-1, 3))
