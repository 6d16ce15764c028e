"""What replicas exchange, with a second process that is only imagined, and what happens when they differ."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.strategies import DDPStrategy, FSDPStrategy, SingleDeviceStrategy, StrategyRegistry
from torch import Tensor, nn

import nsvq_lightning.training.distributed as strategies
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.training.distributed import (
    ViewParallelStrategy,
    check_replicas,
    check_strategy,
    checksum,
    follow_first,
    on_first_process,
)

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


ROWS = torch.randn(40, 3, generator=generator(0))


def test_a_checksum_is_the_sum_over_bits_and_places() -> None:
    # 1.0 is 0x3f800000, -0.0 is -2³¹ as an integer.
    assert int(checksum(torch.tensor([1.0, -0.0]))) == 1 * 0x3F800000 + 2 * -(2**31)
    assert int(checksum(torch.zeros(0, 3))) == 0


@pytest.mark.parametrize("change", ["last bit", "sign of zero", "rows swapped", "a row less"])
def test_a_checksum_sees_every_change(change: str) -> None:
    tensor = ROWS.clone()
    tensor[3, 1] = 0.0
    other = tensor.clone()
    if change == "last bit":
        other.view(torch.int32)[7, 2] ^= 1
    elif change == "sign of zero":
        other[3, 1] = -0.0
    elif change == "rows swapped":
        other[[1, 2]] = tensor[[2, 1]]
    else:
        other = other[:-1]
    assert int(checksum(tensor)) != int(checksum(other))
    assert int(checksum(tensor)) == int(checksum(tensor.clone()))


def trainer(world_size: int, parameters: dict[str, Tensor], first: Tensor | None = None) -> Any:
    """One of ``world_size`` processes; the first one's checksums are ``first`` or the same, the others agree."""

    def broadcast(own: Tensor) -> Tensor:
        return own if first is None else first

    return SimpleNamespace(
        world_size=world_size,
        global_step=600,
        optimizers=[SimpleNamespace(param_groups=[{"name": n, "params": [p]} for n, p in parameters.items()])],
        strategy=SimpleNamespace(broadcast=broadcast),
    )


def test_replicas_that_differ_end_the_run_and_say_where(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strategies, "all_reduce", lambda tensor: None)
    parameters = {"means": ROWS, "scales": ROWS + 1}
    same = torch.stack([checksum(tensor) for tensor in parameters.values()])
    check_replicas(trainer(2, parameters), "pruning")
    check_replicas(trainer(2, parameters, same), "pruning")
    check_replicas(trainer(1, parameters, same + 1), "pruning")  # alone there is nothing to compare
    with pytest.raises(RuntimeError, match=r"iteration 600, after pruning: .* 2 processes differ in scales\."):
        check_replicas(trainer(2, parameters, same + torch.tensor([0, 1])), "pruning")


def test_a_quantizer_takes_over_the_first_one_with_fewer_codes() -> None:
    first, other = NSVQ(64, 3), NSVQ(64, 3)
    first.fit(ROWS)
    parameter = other.codebook
    sent = first.state_dict()
    follow_first(SimpleNamespace(broadcast=lambda own: sent), other)  # type: ignore[arg-type]
    assert other.codebook is parameter  # the optimiser knows it
    assert torch.equal(other.codebook, first.codebook)
    assert other.usage.shape == (40,)
    assert bool(other.fitted)


def test_ddp_is_refused_with_the_reason() -> None:
    with pytest.raises(ValueError, match=r"silently stops averaging.*strategy=view_parallel"):
        check_strategy(DDPStrategy())
    with pytest.raises(ValueError, match="A wrapper such as"):
        check_strategy(FSDPStrategy())
    check_strategy(SingleDeviceStrategy())
    check_strategy(ViewParallelStrategy())


@pytest.mark.parametrize("rank", [0, 1])
@pytest.mark.parametrize("fails", [False, True])
def test_only_the_first_process_makes_what_all_get(rank: int, fails: bool) -> None:
    made: list[int] = []

    def make() -> str:
        made.append(rank)
        if fails:
            raise ValueError("a photo is damaged")
        return "of 0"

    def broadcast(value: object) -> object:
        return value if rank == 0 else ValueError("a photo is damaged") if fails else "of 0"

    two: Any = SimpleNamespace(world_size=2, is_global_zero=rank == 0, strategy=SimpleNamespace(broadcast=broadcast))
    with pytest.raises(ValueError, match="damaged") if fails else nullcontext():
        assert on_first_process(two, make) == "of 0"
    assert made == [0] * (rank == 0)


def test_every_start_method_has_a_name() -> None:
    for name, start in {"": "popen", "_spawn": "spawn", "_fork": "fork", "_notebook": "fork"}.items():
        strategy = StrategyRegistry.get(f"view_parallel{name}")
        assert isinstance(strategy, ViewParallelStrategy)
        assert strategy._start_method == start
