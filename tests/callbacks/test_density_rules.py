"""Decisions of density control against the rules written out (Kerbl et al. 2023, section 5)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nsvq_lightning.callbacks.density_rules import (
    DensityRules,
    add_view,
    clone_mask,
    limit_growth,
    lower_opacities,
    prune_mask,
    screen_gradient,
    split,
    split_mask,
)
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats

RULES = DensityRules()


def log_scales(*largest: float) -> torch.Tensor:
    """Log-scales whose longest axis is given; the others are shorter."""
    return torch.tensor([[math.log(s / 3), math.log(s), math.log(s / 2)] for s in largest])


def test_the_statistic_is_in_normalised_device_coordinates() -> None:
    # A shift of one pixel is a shift of 2 / width; the gradient by it is width / 2 times larger.
    norm = screen_gradient(torch.tensor([[3e-6, 0.0], [0.0, 4e-6], [3e-6, 4e-6]]), width=800, height=600)
    expected = [3e-6 * 400, 4e-6 * 300, math.hypot(3e-6 * 400, 4e-6 * 300)]
    assert norm.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_only_splats_that_were_seen_enter_the_statistic(dtype: torch.dtype) -> None:
    draw = torch.Generator().manual_seed(0)
    grad, start = torch.randn(57, 2, generator=draw).to(dtype), torch.rand(57, generator=draw).to(dtype)
    radii = torch.randint(0, 3, (57,), generator=draw, dtype=torch.int32)
    sums, views = start.clone(), torch.full((57,), 2.0, dtype=dtype)
    add_view(sums, views, grad, radii, width=80, height=60)
    seen = radii > 0
    torch.testing.assert_close(sums, torch.where(seen, start + screen_gradient(grad, 80, 60), start))
    assert torch.equal(views, torch.where(seen, 3.0, 2.0).to(dtype))


def test_small_splats_are_cloned_and_large_ones_split() -> None:
    statistic = torch.tensor([2e-4, 2e-4, 1.9e-4, 1.0])
    scales = log_scales(0.0199, 0.0201, 0.5, 0.02)  # the limit is 0.01 · extent = 0.02
    scales[3, 1] = math.log(0.02) - 1e-6
    assert clone_mask(statistic, scales, 2.0, RULES).tolist() == [True, False, False, True]
    assert split_mask(statistic, scales, 2.0, RULES).tolist() == [False, True, False, False]


def test_transparent_splats_are_pruned_and_huge_ones_only_when_size_counts() -> None:
    logits = torch.tensor([0.0049, 0.0051, 0.9]).logit()
    scales = log_scales(0.1, 0.1, 0.21)  # the limit is 0.1 · extent = 0.2
    assert prune_mask(logits, scales, 2.0, RULES, huge=False).tolist() == [True, False, False]
    assert prune_mask(logits, scales, 2.0, RULES, huge=True).tolist() == [True, False, True]


def test_children_follow_the_parents_own_gaussian() -> None:
    count = 4000
    quat = torch.tensor([0.9, 0.1, -0.3, 0.2])
    scales = torch.tensor([0.0, -1.0, -2.0])
    parents = RawSplats(
        means=torch.tensor([1.0, -2.0, 3.0]).repeat(count, 1),
        quats=2.5 * quat.repeat(count, 1),  # any norm
        scales=scales.repeat(count, 1),
        opacities=torch.linspace(-1, 1, count),
        sh0=torch.rand(count, 1, 3),
        shN=torch.rand(count, 15, 3),
    )
    children = split(parents, RULES, generator(0, 0, "split"))
    assert children.means.shape == (2 * count, 3)
    rotation = Rotation.from_quat(quat[[1, 2, 3, 0]].numpy()).as_matrix()
    covariance = rotation @ np.diag(np.exp(2 * scales.numpy())) @ rotation.T
    offsets = (children.means - parents.means[0]).numpy()
    np.testing.assert_allclose(np.cov(offsets.T), covariance, atol=0.06)
    np.testing.assert_allclose(offsets.mean(0), 0.0, atol=0.05)
    torch.testing.assert_close(children.scales.exp(), parents.scales.exp().repeat(2, 1) / 1.6)
    assert torch.equal(children.opacities, parents.opacities.repeat(2))
    assert torch.equal(children.shN, parents.shN.repeat(2, 1, 1))


def test_growth_is_limited_to_the_largest_statistics_and_ties_go_to_the_first() -> None:
    mask = torch.tensor([True, True, False, True, True])
    statistic = torch.tensor([1.0, 3.0, 9.0, 3.0, 2.0])
    one = torch.ones(5, dtype=torch.int64)
    assert limit_growth(mask, statistic, one, 4).tolist() == mask.tolist()
    assert limit_growth(mask, statistic, one, 1).tolist() == [False, True, False, False, False]
    assert limit_growth(mask, statistic, one, 3).tolist() == [False, True, False, True, True]
    assert not limit_growth(mask, statistic, one, -5).any()


def test_growth_counts_what_each_splat_adds() -> None:
    mask, statistic = torch.tensor([True, True, False, True, True]), torch.tensor([1.0, 3.0, 9.0, 4.0, 2.0])
    added = torch.tensor([1, 3, 3, 1, 3])
    kept = {budget: limit_growth(mask, statistic, added, budget).tolist() for budget in (0, 1, 3, 4, 7, 8)}
    assert kept[0] == [False] * 5
    assert kept[1] == kept[3] == [False, False, False, True, False]  # the next one would add 3
    assert kept[4] == [False, True, False, True, False]
    assert kept[7] == [False, True, False, True, True]
    assert kept[8] == mask.tolist()


def test_reset_lowers_opacities_and_never_raises_them() -> None:
    lowered = lower_opacities(torch.tensor([0.9, 0.01, 0.002]).logit(), 0.01)
    assert lowered.sigmoid().tolist() == pytest.approx([0.01, 0.01, 0.002], rel=1e-5)


@pytest.mark.parametrize(
    "bad", [{"every": 0}, {"min_opacity": 0.0}, {"shrink": 0.0}, {"children": 0}, {"grad_threshold": -1.0}]
)
def test_impossible_rules_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        DensityRules(**bad)  # type: ignore[arg-type]
