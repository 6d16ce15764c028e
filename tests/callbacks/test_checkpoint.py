"""Signals that are held back: by one process, and by one of two."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nsvq_lightning.callbacks.checkpoint import GracefulStop
from nsvq_lightning.training import distributed

Trainers = Callable[..., Any]


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch) -> Trainers:
    """Makes one of ``world_size`` processes; another has received so many SIGINT and SIGTERM."""

    def made(world_size: int, other: tuple[float, float] = (0.0, 0.0), device: str = "cpu", step: int = 1) -> Any:
        monkeypatch.setattr(distributed, "all_reduce", lambda tensor: tensor.add_(torch.tensor(other)))
        strategy = SimpleNamespace(root_device=torch.device(device))
        return SimpleNamespace(world_size=world_size, strategy=strategy, global_step=step)

    return made


@pytest.fixture
def acted() -> Iterator[list[int]]:
    """What the handler of SIGTERM from before has been given."""
    numbers: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: numbers.append(number))
    yield numbers
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize(("world_size", "at_once"), [(1, 1), (2, 0)])
def test_a_second_signal_acts_at_once_in_one_process_alone(
    world_size: int, at_once: int, acted: list[int], trainer: Trainers
) -> None:
    held = GracefulStop()
    held.hold(trainer(world_size))
    signal.raise_signal(signal.SIGTERM)
    assert acted == []
    signal.raise_signal(signal.SIGTERM)
    assert len(acted) == at_once
    held.deliver(held.received(trainer(world_size)))
    assert acted == [signal.SIGTERM]
    held.release()
    signal.raise_signal(signal.SIGTERM)
    assert len(acted) == 2


def test_a_signal_of_another_process_is_taken_for_ones_own(acted: list[int], trainer: Trainers) -> None:
    held = GracefulStop()
    held.hold(trainer(2))
    assert held.received(trainer(2)) == []
    assert held.received(trainer(2, other=(0.0, 1.0))) == [signal.SIGTERM]
    held.deliver([signal.SIGTERM])
    assert acted == [signal.SIGTERM]
    held.release()


def test_several_gpus_ask_each_other_now_and_then(trainer: Trainers) -> None:
    held, other = GracefulStop(), (0.0, 1.0)
    answers = [held.received(trainer(1, device="meta", step=step)) for step in (1, 16)]
    assert answers == [[], []]  # alone, nobody is asked
    assert held.received(trainer(2, other, device="meta", step=15)) == []
