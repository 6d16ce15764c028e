"""When codebooks are refitted, which, and by which process."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nsvq_lightning.callbacks import CodebookRefit
from nsvq_lightning.quantize import NSVQ, StraightThrough
from nsvq_lightning.random import generator
from nsvq_lightning.training.schedule import Schedule

ROWS = torch.randn(50, 3, generator=generator(0))


class Processes:
    """A trainer that knows of ``count`` processes and is number ``rank``; the first one broadcasts ``sent``."""

    def __init__(self, count: int = 1, rank: int = 0, sent: Tensor | None = None) -> None:
        self.world_size, self.is_global_zero, self.global_step = count, rank == 0, 20_099
        self.sent = sent
        self.strategy = SimpleNamespace(broadcast=lambda tensor: tensor if sent is None else sent)


def refit(trainer: Any, steps: int = 2) -> dict[str, Any]:
    """The quantizers of a host after the first refit of the paper's run."""
    quantizers = {"scales": StraightThrough(4, 3), "quats": NSVQ(4, 3)}
    for quantizer in quantizers.values():
        quantizer.fit(ROWS - 1)
    host: Any = SimpleNamespace(schedule=Schedule(), quantizers=quantizers, rows=lambda name: ROWS)
    CodebookRefit(steps=steps).on_before_optimizer_step(trainer, host, None)  # type: ignore[arg-type]
    return quantizers


def test_refits_scale_like_replacement() -> None:
    def due(total: int, every: int = 100) -> list[int]:
        host: Any = SimpleNamespace(schedule=Schedule(total=total))
        return [i for i in range(1, total + 1) if CodebookRefit(every=every).is_due(host, i)]

    assert due(45_000) == list(range(20_100, 43_001, 100))
    assert due(4500) == list(range(2050, 4201, 50))
    assert due(4500, 1000) == list(range(2100, 4201, 100))


def test_only_quantizers_that_offer_it_are_refitted() -> None:
    start, expected = StraightThrough(4, 3), StraightThrough(4, 3)
    for quantizer in (start, expected):
        quantizer.fit(ROWS - 1)
    expected.refit(ROWS, 2)
    quantizers = refit(Processes())
    assert torch.equal(quantizers["scales"].codebook, expected.codebook)
    assert not torch.equal(start.codebook, expected.codebook)
    assert torch.equal(quantizers["quats"].codebook, start.codebook)


def test_other_processes_take_over_what_the_first_fitted() -> None:
    sent = torch.full((4, 3), 7.0)
    assert torch.equal(refit(Processes(2, 1, sent))["scales"].codebook, sent)
    assert torch.equal(refit(Processes(2, 0))["scales"].codebook, refit(Processes())["scales"].codebook)


@pytest.mark.parametrize("bad", [{"every": 0}, {"steps": 0}])
def test_impossible_refits_are_refused(bad: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="refits need"):
        CodebookRefit(**bad)
