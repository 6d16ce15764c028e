"""Rows of parameters, moments and tables move together; the oracle is an Adam that never saw an edit."""

from __future__ import annotations

import logging
from typing import Any

import pytest
import torch
from torch import Tensor

from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import Splats, detached
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.row_ops import (
    append_rows,
    change_coordinates,
    drop_non_finite,
    keep_rows,
    replace_attribute,
    reset_moments,
)


def make(n: int, seed: int = 0) -> Splats:
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    return Splats.from_tensors(rand(n, 3), rand(n, 4), rand(n, 3), rand(n), rand(n, 1, 3), rand(n, 15, 3))


def trained(splats: Splats, steps: int, optimizer: torch.optim.Adam | None = None) -> torch.optim.Adam:
    """Steps on a loss whose gradient differs by row and by step."""
    optimizer = optimizer or build_adam(param_groups(splats, {}, LearningRates(), extent=2.0))
    for step in range(steps):
        optimizer.zero_grad()
        loss = sum(((step + 1.0) * p.square()).sum() for p in splats.attributes().values())
        assert isinstance(loss, Tensor)
        loss.backward()
        optimizer.step()
    return optimizer


def state_of(splats: Splats, optimizer: torch.optim.Adam, name: str) -> dict[str, Tensor]:
    return optimizer.state[getattr(splats, name)]


@pytest.mark.parametrize(
    "make_optimizer",
    [
        build_adam,
        lambda groups: torch.optim.SGD(groups, momentum=0.9),
        torch.optim.RMSprop,
        torch.optim.Adagrad,
        torch.optim.Adamax,
        lambda groups: torch.optim.Adam(groups, amsgrad=True),
    ],
)
def test_a_kept_splat_trains_on_as_if_nothing_had_happened(make_optimizer: Any) -> None:
    mask = torch.tensor([True, False, True, True, False, True])
    edited, untouched = make(6), make(6)
    optimizer, oracle = (
        make_optimizer(param_groups(each, {}, LearningRates(), extent=2.0)) for each in (edited, untouched)
    )
    trained(edited, 3, optimizer)
    trained(untouched, 3, oracle)
    keep_rows(edited, optimizer, mask)
    trained(edited, 3, optimizer)
    trained(untouched, 3, oracle)
    for name in ATTRIBUTES:
        torch.testing.assert_close(getattr(edited, name), getattr(untouched, name)[mask], rtol=0, atol=0)
    append_rows(edited, optimizer, detached(make(2)))
    trained(edited, 1, optimizer)


def test_an_appended_splat_starts_without_moments_and_the_others_keep_theirs() -> None:
    splats, other = make(4), make(2, seed=1)
    optimizer = trained(splats, 2)
    before = {name: {k: v.clone() for k, v in state_of(splats, optimizer, name).items()} for name in ATTRIBUTES}
    append_rows(splats, optimizer, other.raw())
    assert len(splats) == 6
    for name in ATTRIBUTES:
        state = state_of(splats, optimizer, name)
        assert torch.equal(getattr(splats, name)[4:], getattr(other, name))
        assert torch.equal(state["step"], before[name]["step"])
        for moment in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(state[moment][:4], before[name][moment])
            assert not state[moment][4:].any()
    trained(splats, 1, optimizer)


def test_the_optimizer_knows_the_new_parameters_only() -> None:
    splats = make(4)
    optimizer = trained(splats, 1)
    keep_rows(splats, optimizer, torch.tensor([True, True, False, True]))
    bound = {group["name"]: group["params"] for group in optimizer.param_groups}
    assert {name: [id(p) for p in params] for name, params in bound.items()} == {
        name: [id(parameter)] for name, parameter in splats.attributes().items()
    }
    assert {id(p) for p in optimizer.state} == {id(p) for p in splats.attributes().values()}


def test_side_tables_follow_the_rows() -> None:
    splats = make(4)
    optimizer = trained(splats, 1)
    splats.add_table("score").copy_(torch.arange(4.0))
    keep_rows(splats, optimizer, torch.tensor([False, True, True, True]))
    append_rows(splats, optimizer, make(2).raw())
    assert splats.tables()["score"].tolist() == [1.0, 2.0, 3.0, 0.0, 0.0]
    assert splats.state_dict()["score"].tolist() == [1.0, 2.0, 3.0, 0.0, 0.0]


def test_moments_can_be_reset_for_all_rows_or_some() -> None:
    splats = make(4)
    optimizer = trained(splats, 2)
    reset_moments(optimizer, "means", torch.tensor([1, 3]))
    assert state_of(splats, optimizer, "means")["exp_avg"].any(1).tolist() == [True, False, True, False]
    reset_moments(optimizer, "opacities")
    assert not state_of(splats, optimizer, "opacities")["exp_avg_sq"].any()
    assert state_of(splats, optimizer, "scales")["exp_avg"].all()


def test_edits_work_before_the_first_step() -> None:
    splats = make(3)
    optimizer = build_adam(param_groups(splats, {}, LearningRates(), extent=1.0))
    keep_rows(splats, optimizer, torch.tensor([True, False, True]))
    reset_moments(optimizer, "opacities")
    trained(splats, 1, optimizer)
    assert len(splats) == 2


def test_replaced_values_keep_their_moments() -> None:
    splats = make(3)
    optimizer = trained(splats, 1)
    moment = state_of(splats, optimizer, "opacities")["exp_avg"].clone()
    replace_attribute(splats, "opacities", torch.zeros(3))
    assert not splats.opacities.any()
    assert torch.equal(state_of(splats, optimizer, "opacities")["exp_avg"], moment)


def test_moments_follow_into_other_coordinates() -> None:
    """After steps on x the moments become those that steps on y = P·x/4 give, P a permutation with a sign."""
    swap = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    start = make(4)

    def step(splats: Splats, optimizer: torch.optim.Adam, weight: float, to_x: Tensor) -> None:
        optimizer.zero_grad()
        (weight * (splats.scales @ to_x.T).pow(3)).sum().backward()
        optimizer.step()

    changed = make(4)
    optimizer = build_adam(param_groups(changed, {}, LearningRates(scales=0.0), extent=1.0))
    for weight in (1.0, -2.0, 0.5):
        step(changed, optimizer, weight, torch.eye(3))
    change_coordinates(changed, optimizer, "scales", start.scales @ swap.T / 4, (4 * swap).expand(4, 3, 3))

    always = make(4)
    other = build_adam(param_groups(always, {}, LearningRates(scales=0.0), extent=1.0))
    replace_attribute(always, "scales", start.scales @ swap.T / 4)
    for weight in (1.0, -2.0, 0.5):
        step(always, other, weight, 4 * swap.T)

    for key in ("exp_avg", "exp_avg_sq"):
        found, expected = (state_of(s, o, "scales")[key] for s, o in ((changed, optimizer), (always, other)))
        torch.testing.assert_close(found, expected)
    with pytest.raises(ValueError, match=r"maps of scales must be \[4, 3, 3\]"):
        change_coordinates(changed, optimizer, "scales", start.scales, swap)


def test_non_finite_splats_are_dropped_and_named(caplog: pytest.LogCaptureFixture) -> None:
    splats = make(5)
    optimizer = trained(splats, 1)
    with torch.no_grad():
        splats.scales[1, 2] = torch.inf
        splats.shN[3, 7, 0] = torch.nan
        splats.shN[1, 7, 0] = torch.nan
    with caplog.at_level(logging.WARNING):
        assert drop_non_finite(splats, optimizer, step=42).tolist() == [True, False, True, False, True]
    assert len(splats) == 3
    assert "step 42" in caplog.text
    assert "scales in 1 rows, shN in 2 rows" in caplog.text
    assert drop_non_finite(splats, optimizer, step=43).tolist() == [True] * 3
    with torch.no_grad():
        splats.means.fill_(torch.nan)
    with pytest.raises(FloatingPointError, match="all 3 splats are non-finite"):
        drop_non_finite(splats, optimizer, step=44)


def test_wrong_edits_are_refused() -> None:
    splats = make(3)
    optimizer = trained(splats, 1)
    with pytest.raises(ValueError, match=r"mask must be \[3\] bool"):
        keep_rows(splats, optimizer, torch.ones(4, dtype=torch.bool))
    uneven = make(2).raw()._replace(means=torch.zeros(1, 3))
    with pytest.raises(ValueError, match=r"quats must have shape \[1, 4\]"):
        append_rows(splats, optimizer, uneven)
    with pytest.raises(ValueError, match="must keep its shape"):
        replace_attribute(splats, "opacities", torch.zeros(4))
    with pytest.raises(ValueError, match="no parameter group 'albedo'"):
        reset_moments(optimizer, "albedo")
