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
    """A module whose splats resist the pressure by their gradients: the first half strongly, the second not at all."""

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
        self.module: Any = SimpleNamespace(
            splats=splats,
            schedule=SCHEDULE,
            seed=0,
            splat_budget=budget,
            scale_rate=self.rates.__setitem__,
            loss_terms={},
        )
        self.trainer: Any = SimpleNamespace(optimizers=[self.optimizer], global_step=0, world_size=1)

    def step(self) -> None:
        self.rates.clear()
        self.selection.on_train_batch_start(self.trainer, self.module, None, 0)
        for parameter in self.module.splats.parameters():
            parameter.grad = torch.zeros_like(parameter)
        strong = self.module.splats.means.detach()[:, 0] < self.first[len(self.first) // 2, 0]
        self.module.splats.opacities.grad = torch.where(strong, -1.0, 0.0)
        for term in self.module.loss_terms.values():
            term(None, None).backward()
        self.optimizer.step()
        self.trainer.global_step += 1
        self.selection.on_train_batch_end(self.trainer, self.module, {}, None, 0)

    def run(self, until: int) -> None:
        while self.trainer.global_step < until:
            self.step()


def test_those_that_resist_are_left() -> None:
    stage = Stage(100, OpacitySelection(budget=50, strength=1e-3))
    stage.run(10)
    assert len(stage.module.splats) == 100
    assert not stage.rates
    stage.step()
    assert stage.rates == {"opacities": 4.0}
    stage.run(220)
    assert torch.equal(stage.module.splats.means.detach(), stage.first[:50])
    assert stage.selection.done
    assert not stage.rates


def test_the_budget_holds_at_the_end_even_without_pressure() -> None:
    stage = Stage(100, OpacitySelection(budget=30, strength=1e-30))
    stage.run(209)
    assert len(stage.module.splats) == 100
    stage.run(210)
    assert len(stage.module.splats) == 30


def test_too_much_pressure_never_prunes_below_the_budget() -> None:
    stage = Stage(100, OpacitySelection(budget=90, strength=1e6, min_opacity=0.9))
    stage.run(220)
    assert len(stage.module.splats) == 90


def test_without_a_budget_nothing_happens_and_the_modules_budget_is_taken() -> None:
    stage = Stage(20, OpacitySelection())
    before = stage.module.splats.opacities.detach().clone()
    stage.run(220)
    resisted = stage.module.splats.opacities.detach()
    assert torch.equal(resisted[10:], before[10:])
    assert len(stage.module.splats) == 20
    stage = Stage(20, OpacitySelection(), budget=7)
    stage.run(220)
    assert len(stage.module.splats) == 7


def test_it_does_nothing_where_there_are_few_splats_already() -> None:
    stage = Stage(20, OpacitySelection(budget=20))
    before = stage.module.splats.opacities.detach().clone()
    stage.run(220)
    assert len(stage.module.splats) == 20
    assert torch.equal(stage.module.splats.opacities.detach()[10:], before[10:])
    assert not stage.rates


def test_the_pressure_does_not_depend_on_the_number_of_threads() -> None:
    """Torch adds up more than 32 768 numbers in as many parts as there are threads."""
    logits = 4 * torch.randn(100_003, generator=torch.Generator().manual_seed(0))
    before = torch.get_num_threads()
    found = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        found.append([pressure(logits, 1e-3, gentle=gentle) for gentle in (True, False)])
    torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))
