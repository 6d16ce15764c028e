from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import PostHoc, kmeans
from nsvq_lightning.quantize.base import as_quantizer, is_refittable
from nsvq_lightning.random import generator
from nsvq_lightning.skips import switched


def fitted() -> tuple[PostHoc, Tensor]:
    x = torch.randn(200, 3, generator=generator(0))
    quantizer = PostHoc(16, 3)
    quantizer.fit(x, generator=generator(1))
    return quantizer, x.requires_grad_()


def test_is_a_quantizer_without_refits() -> None:
    assert as_quantizer(PostHoc(4, 3))
    assert not is_refittable(PostHoc(4, 3))


@pytest.mark.parametrize("chosen", [None, [0, 3, 199], []])
def test_training_sees_the_rows_and_counts_nothing(chosen: list[int] | None) -> None:
    quantizer, x = fitted()
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
    quantizer, _ = fitted()
    for rows in (
        torch.randn(300, 3, generator=generator(5)),
        torch.ones(9, 3),
        torch.rand(99, 3, generator=generator(6)),
    ):
        codes = quantizer.encode(rows)
        expected = kmeans(rows, 16, generator(0), steps=10)
        assert torch.equal(quantizer.codebook, expected)
        assert quantizer.usage.shape == (len(expected),)
        assert torch.equal(codes, torch.cdist(rows.double(), expected.double()).argmin(1))
    quantizer.eval()
    hard, found = quantizer(rows, rows=torch.tensor([3, 50]))
    assert torch.equal(found, codes[[3, 50]])
    assert torch.equal(hard, quantizer.decode(found))


def test_rows_that_are_not_finite_have_no_part_in_the_codebook() -> None:
    quantizer, _ = fitted()
    rows = torch.randn(100, 3, generator=generator(5))
    expected = kmeans(rows[2:], 16, generator(0), steps=10)
    rows[0, 1], rows[1, 2] = torch.nan, torch.inf
    codes = quantizer.encode(rows)
    assert torch.equal(quantizer.codebook, expected)
    assert torch.equal(codes[2:], torch.cdist(rows[2:].double(), expected.double()).argmin(1))
    assert codes.shape == (100,)


def test_frozen_codebook_is_trained_and_not_fitted_again() -> None:
    quantizer, x = fitted()
    codes = quantizer.encode(x)
    quantizer.freeze(codes)
    book = quantizer.codebook.detach().clone()
    with switched(frozen_search=False, distance_bounds=False):
        x_q, found = quantizer(x + 1)
    assert torch.equal(found, codes)
    assert torch.equal(x_q, book[codes])
    assert torch.equal(quantizer.encode(x + 1), torch.cdist((x + 1).double(), book.double()).argmin(1))
    assert torch.equal(quantizer.codebook, book)
    x_q.sum().backward()
    assert torch.equal(quantizer.codebook.grad[:, 0], torch.bincount(codes, minlength=16).float())


def test_state_of_fewer_codes_loads_and_may_grow_again() -> None:
    source, _ = fitted()
    source.encode(torch.ones(9, 3))
    target = PostHoc(16, 3)
    target.load_state_dict(source.state_dict())
    assert torch.equal(target.codebook, torch.ones(1, 3))
    target.encode(torch.randn(50, 3, generator=generator(0)))
    assert target.num_codes == 16
