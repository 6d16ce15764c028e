"""Codes by error and bits: against the definition in float64, at the limits, and what they do to the entropy."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize.cheapest import cheapest, cheapest_reference, code_rates
from nsvq_lightning.quantize.nearest import nearest
from nsvq_lightning.random import generator


def table(rows: int, codes: int, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    draw = generator(0, dim)
    x, codebook = torch.randn(rows, dim, generator=draw), torch.randn(codes, dim, generator=draw)
    return x, codebook, 12 * torch.rand(codes, generator=draw), 0.3 * torch.rand(rows, generator=draw)


def costs(x: Tensor, codebook: Tensor, rates: Tensor, prices: Tensor) -> Tensor:
    """All costs ``[N, K]`` in float64."""
    squares = (x.double()[:, None] - codebook.double()).square().sum(2)
    return squares + prices.double()[:, None] * rates.double()


@pytest.mark.parametrize(("codes", "dim"), [(1, 3), (15, 3), (16, 4), (77, 3), (64, 45), (33, 1)])
def test_no_code_is_cheaper(codes: int, dim: int) -> None:
    given = table(300, codes, dim)
    expected = costs(*given)
    for search in (cheapest, cheapest_reference):
        found = expected.gather(1, search(*given)[:, None])[:, 0]
        torch.testing.assert_close(found, expected.amin(1), rtol=1e-5, atol=1e-6)


def test_bits_that_cost_nothing_give_the_nearest_code() -> None:
    x, codebook, rates, _ = table(500, 40, 3)
    assert torch.equal(cheapest(x, codebook, rates, torch.zeros(500)), nearest(x, codebook))


def test_of_equally_cheap_codes_the_lowest_is_taken() -> None:
    codebook = torch.tensor([[2.0], [1.0], [-1.0]]).repeat(20, 1)
    rates = torch.tensor([0.0, 1.0, 1.0]).repeat(20)
    # At 0 with price 3 all cost 4; at 0 with price 4 only the first.
    found = cheapest(torch.zeros(2, 1), codebook, rates, torch.tensor([3.0, 2.0]))
    assert found.tolist() == [0, 1]


def test_a_row_that_is_not_finite_gets_code_0() -> None:
    x, codebook, rates, prices = table(3, 20, 3)
    x[1, 2], x[2, 0] = torch.nan, torch.inf
    for search in (cheapest, cheapest_reference):
        assert search(x, codebook, rates, prices)[1:].tolist() == [0, 0]


def test_a_high_price_leads_to_the_code_of_many() -> None:
    x, codebook, _, _ = table(400, 16, 3)
    codes = nearest(x, codebook)
    rates = code_rates(codes, 16)
    assert rates.argmin() == torch.bincount(codes, minlength=16).argmax()
    assert bool((cheapest(x, codebook, rates, torch.full((400,), 1e6)) == rates.argmin()).all())


def test_rates_are_those_of_an_entropy_coder() -> None:
    codes = torch.tensor([0] * 800 + [1] * 150 + [2] * 50)
    rates = code_rates(codes, 4)
    torch.testing.assert_close(rates[:3], -(torch.tensor([0.8, 0.15, 0.05]).log2()), atol=0.02, rtol=0)
    assert 11 < float(rates[3]) < 13  # nobody has it: dear, but to be had


@pytest.mark.parametrize(("rates", "prices"), [(5, 3), (4, 2)])
def test_rates_and_prices_must_fit(rates: int, prices: int) -> None:
    with pytest.raises(ValueError, match="must belong to 4 codes and 3 rows"):
        cheapest(torch.zeros(3, 2), torch.zeros(4, 2), torch.zeros(rates), torch.zeros(prices))
