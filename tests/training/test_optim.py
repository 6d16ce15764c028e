"""Learning rates against the values of 3D Gaussian Splatting; Adam against torch's own single-tensor loop."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from runs import PAPER_MODULE
from torch import nn

from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.optim import (
    LearningRates,
    adapt_to_views,
    build_adam,
    param_groups,
    position_lr,
)

PAPER: LearningRates = PAPER_MODULE["rates"]


class Codebook(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.codebook = nn.Parameter(torch.zeros(4, 3))


def splats() -> Splats:
    return Splats.from_points(torch.rand(5, 3, generator=torch.Generator().manual_seed(0)), torch.rand(5, 3))


def test_every_attribute_and_codebook_has_its_group_and_rate() -> None:
    rates = replace(PAPER, codebook_factor=2.0)
    groups = param_groups(splats(), {"scales": Codebook(), "shN": Codebook()}, rates, extent=3.0)
    assert {group["name"]: group["lr"] for group in groups} == {
        "means": pytest.approx(4.8e-4),
        "quats": 1e-3,
        "scales": 5e-3,
        "opacities": 0.05,
        "sh0": 2.5e-3,
        "shN": 1.25e-4,
        "codebook_scales": 1e-2,
        "codebook_shN": 2.5e-4,
    }


def test_the_position_rate_falls_log_linearly_and_then_stays() -> None:
    rates = PAPER
    assert position_lr(0, 2.0, rates, 30_000) == pytest.approx(3.2e-4)
    assert position_lr(15_000, 2.0, rates, 30_000) == pytest.approx(2.0 * math.sqrt(1.6e-4 * 1.6e-6))
    assert position_lr(30_000, 2.0, rates, 30_000) == pytest.approx(3.2e-6)
    assert position_lr(45_000, 2.0, rates, 30_000) == pytest.approx(3.2e-6)


def trained(steps: int, views: int, scale: bool) -> torch.Tensor:
    """Where 20 000 numbers get to whose gradient in a view is 0.05 in the mean and varies by 1."""
    numbers = nn.Parameter(torch.zeros(20_000))
    optimizer = torch.optim.Adam([{"params": [numbers], "name": "scales"}], eps=1e-15)
    rates = LearningRates(scales=1e-3, scale_with_views=scale)
    optimizer.param_groups[0]["lr"] = rates.scales * adapt_to_views(optimizer, rates, views)
    draws = torch.Generator().manual_seed(views)
    for _ in range(steps):
        numbers.grad = 0.05 + torch.randn(20_000, generator=draws) / math.sqrt(views)
        optimizer.step()
    return numbers.detach()


def test_scaled_steps_of_four_views_move_as_four_steps_of_one() -> None:
    one = trained(800, views=1, scale=True)
    torch.testing.assert_close(trained(800, views=1, scale=False), one, rtol=0, atol=0)
    four, unscaled = trained(200, views=4, scale=True), trained(200, views=4, scale=False)
    for measure in (torch.mean, torch.std):
        assert float(measure(four)) == pytest.approx(float(measure(one)), rel=0.05)
        assert float(measure(unscaled)) == pytest.approx(0.5 * float(measure(one)), rel=0.05)


def test_adams_numbers_follow_the_number_of_views() -> None:
    rates = replace(PAPER, scale_with_views=True)
    optimizer = build_adam(param_groups(splats(), {"scales": Codebook()}, rates, extent=3.0))
    assert adapt_to_views(optimizer, rates, 4) == 2
    for group in optimizer.param_groups:
        assert group["betas"] == (pytest.approx(0.6), pytest.approx(0.996))
        assert group["eps"] == pytest.approx(0.5e-15)
    assert adapt_to_views(optimizer, LearningRates(), 4) == 1
    assert {(group["betas"], group["eps"]) for group in optimizer.param_groups} == {((0.9, 0.999), 1e-15)}
    with pytest.raises(ValueError, match=r"16 views a step, as Adam.s first beta would be -0\.6"):
        adapt_to_views(optimizer, rates, 16)


def test_steps_have_the_same_bits_for_any_number_of_threads() -> None:
    def moved(threads: int) -> list[torch.Tensor]:
        torch.set_num_threads(threads)
        draw = torch.Generator().manual_seed(0)
        scene = Splats.from_points(torch.rand(1001, 3, generator=draw), torch.rand(1001, 3, generator=draw))
        optimizer = build_adam(param_groups(scene, {}, LearningRates(), extent=1.0))
        for _ in range(3):
            for parameter in scene.parameters():
                parameter.grad = 1e-6 * torch.randn(parameter.shape, generator=draw)
            optimizer.step()
        moments = [optimizer.state[p][key] for p in scene.parameters() for key in ("exp_avg", "exp_avg_sq")]
        return [*(p.detach() for p in scene.parameters()), *moments]

    before = torch.get_num_threads()
    one, two = moved(1), moved(2)
    torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def test_a_codebook_without_gradient_is_left_alone() -> None:
    book = Codebook()
    optimizer = build_adam(param_groups(splats(), {"scales": book}, LearningRates(), extent=1.0))
    optimizer.step()
    assert book.codebook not in optimizer.state


@pytest.mark.parametrize("bad", [{"means": 0.0}, {"opacities": -1.0}, {"shN": math.nan}])
def test_impossible_rates_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"rate {next(iter(bad))} must be finite"):
        LearningRates(**bad)


@pytest.mark.parametrize("views", [0, -1])
def test_a_step_of_no_views_is_refused(views: int) -> None:
    """With -1 accumulated batches the loss went up, without a word; with 0, Lightning divided by 0."""
    optimizer = build_adam(param_groups(Splats(0), {}, LearningRates(), 1.0))
    with pytest.raises(ValueError, match=rf"{views} views a step: accumulate_grad_batches must be above 0"):
        adapt_to_views(optimizer, LearningRates(), views)
