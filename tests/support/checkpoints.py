"""Checkpoints where a test wants them, and what two of them have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nsvq_lightning.callbacks import RunCheckpoint
from nsvq_lightning.training.module import SplatModule


class CheckpointAt(RunCheckpoint):
    """Keeps checkpoints of given iterations."""

    def __init__(self, *iterations: int) -> None:
        super().__init__(keep=True)
        self.iterations = iterations

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        return iteration in self.iterations


def read(path: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = torch.load(path, weights_only=True)
    return loaded


def iteration_of(path: Path) -> int:
    return int(read(path)["global_step"])


def assert_same(first: Any, second: Any, where: str = "") -> None:
    """Every tensor and number of two nested structures is the same, to the bit, but for the time they took."""
    assert type(first) is type(second), where
    if isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            if key == "_extra_state":  # its last number is the seconds of training
                assert torch.equal(first[key][:3], second[key][:3]), where
            elif key != "seconds":
                assert_same(first[key], second[key], f"{where}/{key}")
    elif isinstance(first, list | tuple):
        assert len(first) == len(second), where
        for number, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{where}/{number}")
    elif isinstance(first, Tensor):
        assert torch.equal(first, second), where
    else:
        assert first == second, where


def assert_same_end(first: Path, second: Path) -> None:
    """Two runs have stored the same bytes, and their last checkpoints hold the same state in every part."""
    assert (first / "scene.nsvq").read_bytes() == (second / "scene.nsvq").read_bytes()
    assert_same(*(read(folder / "checkpoints" / "last.ckpt") for folder in (first, second)))
