"""The decisions of budgeted growth, against plain definitions."""

from __future__ import annotations

import math

import pytest
import torch

from nsvq_lightning.callbacks import GrowthRules
from nsvq_lightning.callbacks.growth_rules import add_observed, budget_at, draw_rows, lowest_share, split_longest
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.reference import rotation_matrices
from nsvq_lightning.splats.splats import RawSplats


def tables(count: int, like: torch.Tensor) -> list[torch.Tensor]:
    return [torch.ones(count, dtype=like.dtype) for _ in range(3)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_view_adds_gradients_in_device_coordinates_and_edge_weights_of_mean_one(dtype: torch.dtype) -> None:
    observed = torch.tensor([[3e-6, 4e-6, 2.0], [1e-6, 0.0, 0.0], [5e-6, 0.0, 6.0], [1.0, 1.0, 0.0]], dtype=dtype)
    gradients, views, edges = tables(4, observed)
    radii = torch.tensor([3, 1, 9, 0], dtype=torch.int32)
    add_observed(gradients, views, edges, observed, radii, width=800, height=600)
    assert gradients.tolist() == pytest.approx([1 + math.hypot(3e-6 * 400, 4e-6 * 300), 1 + 4e-4, 1 + 2e-3, 1.0])
    assert views.tolist() == [2.0, 2.0, 2.0, 1.0]
    assert edges.tolist() == pytest.approx([1.5, 1.0, 2.5, 1.0])  # the mean of the two that are positive is 4


@pytest.mark.parametrize("count", [0, 1, 63, 1000])
def test_the_kernel_adds_what_plain_torch_adds(count: int) -> None:
    draw = torch.Generator().manual_seed(count)
    observed = torch.rand(count, 3, generator=draw) - torch.tensor([0.0, 0.0, 0.3])
    radii = torch.randint(0, 3, (count,), generator=draw, dtype=torch.int32)
    fast, exact = tables(count, observed), tables(count, observed.double())
    add_observed(*fast, observed, radii, width=80, height=60)
    add_observed(*exact, observed.double(), radii, width=80, height=60)
    for ours, theirs in zip(fast, exact, strict=True):
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-6, atol=1e-6)


def test_a_view_without_edges_adds_no_weight() -> None:
    gradients, views, edges = tables(5, torch.zeros(1))
    add_observed(gradients, views, edges, torch.zeros(5, 3), torch.ones(5, dtype=torch.int32), width=8, height=6)
    assert edges.tolist() == [1.0] * 5
    assert views.tolist() == [2.0] * 5


def test_the_budget_opens_with_the_root_of_time() -> None:
    assert [budget_at(progress, 1000) for progress in (-1.0, 0.0, 0.25, 0.81, 1.0, 7.0)] == [0, 0, 500, 900, 1000, 1000]


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


def test_children_lie_on_the_longest_axis_of_their_parent() -> None:
    draw = torch.Generator().manual_seed(0)
    count = 50
    parents = RawSplats(
        means=torch.randn(count, 3, generator=draw),
        quats=3 * torch.randn(count, 4, generator=draw),  # any norm
        scales=torch.randn(count, 3, generator=draw),
        opacities=torch.randn(count, generator=draw),
        sh0=torch.randn(count, 1, 3, generator=draw),
        shN=torch.randn(count, 8, 3, generator=draw),
    )
    children = split_longest(parents)
    longest, axis = parents.scales.exp().max(1)
    directions = rotation_matrices(parents.quats)[torch.arange(count), :, axis]
    for child, side in ((slice(0, count), 1), (slice(count, None), -1)):
        expected = parents.means + side * 1.35 * longest[:, None] * directions
        torch.testing.assert_close(children.means[child], expected)
        ratio = (children.scales[child] - parents.scales).exp()
        torch.testing.assert_close(ratio[torch.arange(count), axis], torch.full((count,), 0.55))
        others = torch.ones(count, 3, dtype=torch.bool).scatter(1, axis[:, None], False)
        torch.testing.assert_close(ratio[others], torch.full((2 * count,), 0.893))
        torch.testing.assert_close(children.opacities[child].sigmoid(), 0.6 * parents.opacities.sigmoid())
        for name in ("quats", "sh0", "shN"):
            assert torch.equal(getattr(children, name)[child], getattr(parents, name))


def test_the_lowest_share_is_counted_and_ties_go_to_the_first() -> None:
    logits = torch.tensor([0.0, -2.0, 3.0, -2.0, -2.0])
    assert lowest_share(logits, 0.4).tolist() == [False, True, False, True, False]
    assert not lowest_share(logits, 0.1).any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"every": 0}, "every must be at least 1, got 0"),
        ({"start": -1}, "start must be at least 0, got -1"),
        ({"grad_threshold": float("nan")}, "grad_threshold must be at least 0, got nan"),
        ({"start": 900, "full": 900}, "growth must be full after its start=900, got full=900"),
        ({"reset_opacity": 1.0}, "reset_opacity must be between 0 and 1, got 1.0"),
        ({"recovery_share": 1.0}, r"recovery_share must be in \[0, 1\), got 1.0"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GrowthRules(**settings)  # type: ignore[arg-type]
