"""What the strategy does with gradients, beside a second process that is only imagined."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.strategies import StrategyRegistry
from torch import Tensor, nn

import nsvq_lightning.training.strategies as strategies
from nsvq_lightning.training.strategies import ViewParallelStrategy

LOSS = torch.tensor(1.0)


class Scene(LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(2))
        self.third = nn.Parameter(torch.zeros(2))


class OfTwo(ViewParallelStrategy):
    """The first of two processes; the module is given from outside."""

    world_size = 2  # type: ignore[assignment]
    root_device = torch.device("cpu")  # type: ignore[assignment]


@pytest.fixture
def strategy() -> OfTwo:
    made = OfTwo()
    made._lightning_module = Scene()
    return made


def meet(monkeypatch: pytest.MonkeyPatch, *contributions: list[float]) -> list[Tensor]:
    """Let the other process contribute these to the reductions to come, and nothing else; what it was sent."""
    other, sent = list(contributions), []

    def all_reduce(tensor: Tensor, async_op: bool = False) -> Any:
        sent.append(tensor.clone())
        tensor += torch.tensor(other.pop(0))
        return SimpleNamespace(wait=lambda: None)

    monkeypatch.setattr(strategies, "all_reduce", all_reduce)
    return sent


def test_gradients_are_averaged_and_those_nobody_has_stay_away(
    strategy: OfTwo, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene: Any = strategy.lightning_module
    scene.first.grad = torch.tensor([1.0, 2.0])
    meet(monkeypatch, [0.0, 1.0, 1.0, 0.0], [3.0, -2.0], [4.0, 0.0])  # its votes, then its gradients
    strategy.post_backward(LOSS)
    assert scene.first.grad.tolist() == [2.0, 0.0]
    assert scene.second.grad.tolist() == [2.0, 0.0]  # ours was none: 0
    assert scene.third.grad is None


def test_parameters_that_were_replaced_are_followed(strategy: OfTwo, monkeypatch: pytest.MonkeyPatch) -> None:
    scene: Any = strategy.lightning_module
    scene.first = nn.Parameter(torch.zeros(3))
    scene.first.grad = torch.ones(3)
    meet(monkeypatch, [0.0, 1.0, 0.0, 0.0], [3.0, 3.0, 3.0])
    strategy.post_backward(LOSS)
    assert scene.first.grad.tolist() == [2.0] * 3


@pytest.mark.parametrize(("ours", "theirs"), [(float("nan"), 0.0), (float("inf"), 0.0), (1.0, 1.0)])
def test_a_loss_that_is_not_finite_on_any_process_updates_nothing(
    strategy: OfTwo, monkeypatch: pytest.MonkeyPatch, ours: float, theirs: float
) -> None:
    scene: Any = strategy.lightning_module
    scene.first.grad = torch.full((2,), ours)
    meet(monkeypatch, [theirs, 1.0, 0.0, 0.0])
    strategy.post_backward(torch.tensor(ours))
    assert all(parameter.grad is None for parameter in scene.parameters())
    # The next step is a new one.
    scene.first.grad = torch.ones(2)
    meet(monkeypatch, [0.0, 1.0, 0.0, 0.0], [1.0, 1.0])
    strategy.post_backward(LOSS)
    assert scene.first.grad.tolist() == [1.0, 1.0]


def test_accumulated_gradients_travel_once_and_remember_a_loss_that_was_not_finite(
    strategy: OfTwo, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene: Any = strategy.lightning_module
    sent = meet(monkeypatch, [0.0, 1.0, 0.0, 0.0])
    scene.first.grad = torch.ones(2)
    with strategy.block_backward_sync():
        strategy.post_backward(torch.tensor(float("nan")))
    assert sent == []
    strategy.post_backward(LOSS)
    assert len(sent) == 1
    assert scene.first.grad is None


def test_the_strategy_has_a_name() -> None:
    assert isinstance(StrategyRegistry.get("view_parallel"), ViewParallelStrategy)
