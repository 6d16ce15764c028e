"""Exact nearest codes, and cheapest ones: against the definition in float64, at the limits."""

import pytest
import torch
from threads import use_threads
from torch import Tensor

from nsvq_lightning.quantize import nearest_reference
from nsvq_lightning.quantize.nearest import cheapest, cheapest_reference, code_rates, nearest
from nsvq_lightning.random import generator


def clustered(count: int, dim: int, seed: int = 0) -> Tensor:
    draw = generator(seed)
    centres = 2 * torch.randn(20, dim, generator=draw) - 4
    rows = centres[torch.randint(20, (count,), generator=draw)]
    return rows + 0.3 * torch.randn(count, dim, generator=draw)


def assert_nearest(x: Tensor, codebook: Tensor, codes: Tensor) -> None:
    """Oracle: float64; another code is allowed only if it is as far to a relative 1e-6."""
    wide, book = x.double(), codebook.double()
    best = (wide - book[nearest_reference(wide, book)]).square().sum(1)
    found = (wide - book[codes]).square().sum(1)
    assert bool((found <= best * (1 + 1e-6)).all())


@pytest.mark.parametrize("dim", [3, 4, 9, 45, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("num_codes", [1, 2, 15, 17, 300, 5000])
def test_equals_float64_up_to_ties(dim: int, num_codes: int) -> None:
    x, codebook = clustered(700, dim, 1), clustered(num_codes, dim, 2)
    assert_nearest(x, codebook, nearest(x, codebook))


@pytest.mark.parametrize("dim", [3, 4, 45])
def test_far_from_the_origin(dim: int) -> None:
    """Uncentred dot products would lose all digits here."""
    x, codebook = clustered(500, dim, 1) + 1000, clustered(600, dim, 2) + 1000
    assert_nearest(x, codebook, nearest(x, codebook))


@pytest.mark.parametrize("dim", [3, 45])
def test_ties_go_to_the_lower_code(dim: int) -> None:
    codebook = clustered(400, dim)
    doubled = torch.cat((codebook, codebook))[torch.randperm(800, generator=generator(3))]
    codes = nearest(doubled, doubled)
    first = [int((doubled == row).all(1).nonzero()[0, 0]) for row in doubled]
    assert codes.tolist() == first


@pytest.mark.parametrize("dim", [3, 45])
def test_bits_do_not_depend_on_threads(dim: int) -> None:
    x, codebook = clustered(3000, dim, 1), clustered(500, dim, 2)
    codebook[250:] = codebook[:250]
    with use_threads(1):
        one = nearest(x, codebook)
    with use_threads(2):
        two = nearest(x, codebook)
    assert torch.equal(one, two)
    assert torch.equal(nearest(x[1000:1100].clone(), codebook), one[1000:1100])


def test_reference_takes_the_lower_code_and_no_autocast() -> None:
    x = clustered(50, 4, 1)
    codebook = x[:20].repeat(2, 1)
    with torch.autocast("cpu", torch.bfloat16):
        assert nearest_reference(x, codebook)[:20].tolist() == list(range(20))
        assert nearest(x, codebook)[:20].tolist() == list(range(20))


@pytest.mark.parametrize("dim", [3, 45])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_bad_code_is_never_chosen_and_bad_rows_do_not_disturb_others(dim: int, bad: float) -> None:
    x, codebook = clustered(100, dim, 1), clustered(60, dim, 2)
    good = torch.tensor([code for code in range(60) if code not in (7, 33)])
    expected = good[nearest(x, codebook[good])]
    codebook[7, 1] = codebook[33, 0] = x[5] = x[6, 0] = bad
    codes = nearest(x, codebook)
    assert torch.equal(codes[7:], expected[7:])
    assert torch.equal(codes[:5], expected[:5])
    assert 0 <= int(codes.min()) <= int(codes.max()) < 60


def test_no_rows_and_refusals() -> None:
    for dim in (3, 45):
        assert nearest(torch.zeros(0, dim), torch.zeros(5, dim)).shape == (0,)
    with pytest.raises(ValueError, match="share D"):
        nearest(torch.zeros(2, 3), torch.zeros(2, 4))
    with pytest.raises(ValueError, match="no code"):
        nearest(torch.zeros(2, 3), torch.zeros(0, 3))
    with pytest.raises(TypeError, match="dtype"):
        nearest(torch.zeros(2, 3), torch.zeros(2, 3).double())


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
