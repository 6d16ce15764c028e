"""Selection by opacity pressure: its gradient, its line, what is left in the end."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nsvq_lightning.callbacks import OpacitySelection
from nsvq_lightning.callbacks.pruning import pressure
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.schedule import Schedule

SCHEDULE = Schedule(total=230, reference_total=230, warmup_end=10, prune_end=210, quantize_end=220)


@pytest.mark.parametrize("gentle", [True, False])
def test_the_pressure_is_the_gradient_of_its_term(gentle: bool) -> None:
    logits = torch.linspace(-6, 7, 40, dtype=torch.float64)[torch.randperm(40, generator=torch.Generator())]
    leaf = logits.clone().requires_grad_()
    if gentle:
        term = 1e-3 * ((leaf + 20) / (1 - leaf.sigmoid()).clamp_min(0.05)).mean() ** 2
    else:
        term = 3 * 1e-3 * (leaf.mean() + 20) ** 2
    (expected,) = torch.autograd.grad(term, leaf)
    torch.testing.assert_close(pressure(logits, 1e-3, gentle=gentle), expected)


class Stage:
    """A host whose splats resist the pressure by their gradients: the first half strongly, the second not at all."""

    def __init__(self, count: int, selection: OpacitySelection, budget: int | None = None) -> None:
        self.selection = selection
        splats = Splats.from_tensors(
            means=torch.arange(3.0 * count).view(count, 3),
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            scales=torch.zeros(count, 3),
            opacities=torch.linspace(-0.5, 0.5, count),
            sh0=torch.zeros(count, 1, 3),
            shN=torch.zeros(count, 0, 3),
        )
        self.first = splats.means.detach().clone()
        self.optimizer = build_adam(param_groups(splats, {}, LearningRates(opacities=0.4), 1.0))
        self.rates: dict[str, float] = {}
        self.host: Any = SimpleNamespace(
            splats=splats, schedule=SCHEDULE, seed=0, splat_budget=budget, scale_rate=self.rates.__setitem__
        )
        self.trainer: Any = SimpleNamespace(optimizers=[self.optimizer], global_step=0, world_size=1)

    def step(self) -> None:
        self.rates.clear()
        self.selection.on_train_batch_start(self.trainer, self.host, None, 0)
        for parameter in self.host.splats.parameters():
            parameter.grad = torch.zeros_like(parameter)
        strong = self.host.splats.means.detach()[:, 0] < self.first[len(self.first) // 2, 0]
        self.host.splats.opacities.grad = torch.where(strong, -1.0, 0.0)
        self.selection.on_before_optimizer_step(self.trainer, self.host, self.optimizer)
        self.optimizer.step()
        self.trainer.global_step += 1
        self.selection.on_train_batch_end(self.trainer, self.host, {}, None, 0)

    def run(self, until: int) -> None:
        while self.trainer.global_step < until:
            self.step()


def test_those_that_resist_are_left() -> None:
    stage = Stage(100, OpacitySelection(budget=50, strength=1e-3))
    stage.run(10)
    assert len(stage.host.splats) == 100
    assert not stage.rates
    stage.step()
    assert stage.rates == {"opacities": 4.0}
    stage.run(220)
    assert torch.equal(stage.host.splats.means.detach(), stage.first[:50])
    assert stage.selection.done
    assert not stage.rates


def test_the_budget_holds_at_the_end_even_without_pressure() -> None:
    stage = Stage(100, OpacitySelection(budget=30, strength=1e-30))
    stage.run(209)
    assert len(stage.host.splats) == 100
    stage.run(210)
    assert len(stage.host.splats) == 30


def test_too_much_pressure_never_prunes_below_the_budget() -> None:
    stage = Stage(100, OpacitySelection(budget=90, strength=1e6, min_opacity=0.9))
    stage.run(220)
    assert len(stage.host.splats) == 90


def test_without_a_budget_nothing_happens_and_the_modules_budget_is_taken() -> None:
    stage = Stage(20, OpacitySelection())
    before = stage.host.splats.opacities.detach().clone()
    stage.run(220)
    resisted = stage.host.splats.opacities.detach()
    assert torch.equal(resisted[10:], before[10:])
    assert len(stage.host.splats) == 20
    stage = Stage(20, OpacitySelection(), budget=7)
    stage.run(220)
    assert len(stage.host.splats) == 7


def test_it_does_nothing_where_there_are_few_splats_already() -> None:
    stage = Stage(20, OpacitySelection(budget=20))
    before = stage.host.splats.opacities.detach().clone()
    stage.run(220)
    assert len(stage.host.splats) == 20
    assert torch.equal(stage.host.splats.opacities.detach()[10:], before[10:])
    assert not stage.rates


def test_its_state_survives_a_checkpoint() -> None:
    whole = Stage(100, OpacitySelection(budget=50))
    whole.run(60)
    state = whole.selection.state_dict()
    assert state["line"] is not None
    resumed = OpacitySelection(budget=50)
    resumed.load_state_dict(state)
    assert resumed.state_dict() == state


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget": 0}, "budget must be at least 1, got 0"),
        ({"pushes": 0}, "pushes must be at least 1, got 0"),
        ({"strength": -1.0}, "strength must be finite and above 0, got -1.0"),
        ({"gentle": 1.0}, r"gentle must be in \[0, 1\), got 1.0"),
        ({"min_opacity": 1.0}, r"min_opacity must be in \[0, 1\), got 1.0"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        OpacitySelection(**settings)
