"""Draws in proportion to weights, and that they repeat."""

from __future__ import annotations

import torch

from nsvq_lightning.random import draw_rows, generator, top_rows


def test_rows_are_drawn_without_replacement_in_proportion_to_their_weight() -> None:
    weight = torch.tensor([0.0, 1.0, 2.0, 4.0, 0.0, 8.0])
    single = torch.zeros(6, dtype=torch.float64)
    pairs = torch.zeros(6, dtype=torch.float64)
    trials = 4000
    for trial in range(trials):
        single += draw_rows(weight, 1, generator(0, trial))
        chosen = draw_rows(weight, 2, generator(1, trial))
        assert int(chosen.sum()) == 2
        pairs += chosen
    share = (weight / weight.sum()).double()
    # Four standard deviations of a binomial count.
    assert ((single / trials - share).abs() <= 4 * (share * (1 - share) / trials).sqrt()).all()
    # Drawn second: Σ over first draws j of p_j · p_i / (1 - p_j).
    both = share + torch.stack([share * share[j] / (1 - share[j]) * (torch.arange(6) != j) for j in range(6)]).sum(0)
    assert ((pairs / trials - both).abs() <= 4 * (both * (1 - both) / trials).sqrt() + 1e-12).all()


def test_a_draw_takes_no_row_of_weight_zero_and_repeats() -> None:
    weight = torch.tensor([0.0, 3.0, 0.0, 1e-30])
    assert draw_rows(weight, 10, generator(0)).tolist() == [False, True, False, True]
    assert not draw_rows(torch.zeros(4), 2, generator(0)).any()
    assert not draw_rows(weight, -5, generator(0)).any()
    many = torch.rand(1000, generator=generator(2))
    assert torch.equal(draw_rows(many, 100, generator(7)), draw_rows(many, 100, generator(7)))
    assert not torch.equal(draw_rows(many, 100, generator(7)), draw_rows(many, 100, generator(8)))


def test_the_top_rows_are_kept_and_of_equals_the_first() -> None:
    values = torch.tensor([0.0, 3.0, 1.0, 3.0, 1.0, 2.0])
    assert top_rows(values, 2).nonzero()[:, 0].tolist() == [1, 3]
    assert top_rows(values, 4).nonzero()[:, 0].tolist() == [1, 2, 3, 5]
    assert top_rows(values, 6).all()
