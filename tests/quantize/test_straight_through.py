"""Straight-through quantizers, and k-means after training."""

from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import (
    CodebookQuantizer,
    PostHoc,
    StraightThrough,
    TrainedStraightThrough,
    kmeans,
)
from nsvq_lightning.random import generator

Kind = TypeVar("Kind", bound=CodebookQuantizer)


def fitted(
    kind: type[Kind] = StraightThrough,  # type: ignore[assignment]
    dim: int = 3,
    codes: int = 16,
    **settings: Any,
) -> tuple[Kind, Tensor]:
    x = torch.randn(200, dim, generator=generator(0))
    quantizer = kind(codes, dim, kmeans_steps=2, **settings)
    quantizer.fit(x, generator=generator(1))
    return quantizer, x.requires_grad_()


def nearest_codes(x: Tensor, codebook: Tensor) -> Tensor:
    """By torch alone."""
    return torch.cdist(x.double(), codebook.double()).argmin(1)


def distortion(quantizer: StraightThrough, x: Tensor) -> float:
    """Mean squared distance to the nearest code, by torch alone."""
    return float(torch.cdist(x.double(), quantizer.codebook.detach().double()).amin(1).square().mean())


@pytest.mark.parametrize("kind", [StraightThrough, TrainedStraightThrough])
@pytest.mark.parametrize("dim", [3, 45])
@pytest.mark.parametrize("chosen", [None, [0, 3, 4, 199], []])
def test_value_is_the_code_and_the_gradient_goes_to_the_rows(
    dim: int, chosen: list[int] | None, kind: type[CodebookQuantizer]
) -> None:
    quantizer, x = fitted(kind, dim)
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
    quantizer, x = fitted(dim=45)
    for step in range(4):
        x = (x + 0.1).detach()
        quantizer.refit(x, 3)
        _, codes = quantizer(x, generator(step))
        assert torch.equal(codes, nearest_codes(x, quantizer.codebook))


# PostHoc


@pytest.mark.parametrize("chosen", [None, [0, 3, 199], []])
def test_training_sees_the_rows_and_counts_nothing(chosen: list[int] | None) -> None:
    quantizer, x = fitted(PostHoc)
    rows = None if chosen is None else torch.tensor(chosen, dtype=torch.int64)
    which = slice(None) if rows is None else rows
    before = quantizer.codebook.detach().clone()
    x_q, codes = quantizer(x, generator(2), rows)
    assert torch.equal(x_q, x[which])
    assert torch.equal(codes, torch.full((len(x_q),), -1))
    x_q.backward(torch.full_like(x_q, 2.0))
    expected = torch.zeros_like(x)
    expected[which] = 2.0
    assert torch.equal(x.grad, expected)
    assert quantizer.codebook.grad is None
    assert int(quantizer.window) == 0
    assert quantizer.replace_unused(generator(3)).numel() == 0
    assert torch.equal(quantizer.codebook, before)


def test_codes_are_kmeans_of_the_rows_that_are_encoded_whatever_came_before() -> None:
    quantizer, _ = fitted(PostHoc)
    for rows in (
        torch.randn(300, 3, generator=generator(5)),
        torch.ones(9, 3),
        torch.rand(99, 3, generator=generator(6)),
    ):
        codes = quantizer.encode(rows)
        expected = kmeans(rows, 16, generator(0), steps=2)
        assert torch.equal(quantizer.codebook, expected)
        assert quantizer.usage.shape == (len(expected),)
        assert torch.equal(codes, nearest_codes(rows, expected))
    quantizer.eval()
    hard, found = quantizer(rows, rows=torch.tensor([3, 50]))
    assert torch.equal(found, codes[[3, 50]])
    assert torch.equal(hard, quantizer.decode(found))


def test_rows_hold_no_codes_that_would_keep_the_codebook() -> None:
    assert not hasattr(PostHoc(16, 3), "hold")


def test_rows_that_are_not_finite_have_no_part_in_the_codebook() -> None:
    quantizer, _ = fitted(PostHoc)
    rows = torch.randn(100, 3, generator=generator(5))
    expected = kmeans(rows[2:], 16, generator(0), steps=2)
    rows[0, 1], rows[1, 2] = torch.nan, torch.inf
    codes = quantizer.encode(rows)
    assert torch.equal(quantizer.codebook, expected)
    assert torch.equal(codes[2:], nearest_codes(rows[2:], expected))
    assert codes.shape == (100,)


def test_a_frozen_codebook_is_trained_and_not_fitted_again() -> None:
    quantizer, x = fitted(PostHoc)
    codes = quantizer.encode(x)
    quantizer.freeze(codes)
    book = quantizer.codebook.detach().clone()
    x_q, found = quantizer(x + 1)
    assert torch.equal(found, codes)
    assert torch.equal(x_q, book[codes])
    assert torch.equal(quantizer.encode(x + 1), nearest_codes(x + 1, book))
    assert torch.equal(quantizer.codebook, book)
    x_q.sum().backward()
    assert torch.equal(quantizer.codebook.grad[:, 0], torch.bincount(codes, minlength=16).float())


def test_state_of_fewer_codes_loads_and_may_grow_again() -> None:
    source, _ = fitted(PostHoc)
    source.encode(torch.ones(9, 3))
    target = PostHoc(16, 3)
    target.load_state_dict(source.state_dict())
    assert torch.equal(target.codebook, torch.ones(1, 3))
    target.encode(torch.randn(50, 3, generator=generator(0)))
    assert target.num_codes == 16
