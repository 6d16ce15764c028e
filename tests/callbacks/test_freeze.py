"""Frozen codes stay with their splats, whatever other callbacks do to them."""

from __future__ import annotations

import logging
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nsvq_lightning.callbacks import FreezeCodes
from nsvq_lightning.callbacks.finite import keep_finite_splats
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.edit import append_rows, keep_rows
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.schedule import Phase, Schedule

FIRST = 43_001


class Stage:
    """Four splats whose scales have the codes 0 to 3, at the start of fine-tuning."""

    def __init__(self) -> None:
        self.splats = Splats.from_tensors(
            means=torch.arange(12.0).view(4, 3),
            quats=torch.ones(4, 4),
            scales=torch.arange(4.0)[:, None].repeat(1, 3),
            opacities=torch.zeros(4),
            sh0=torch.zeros(4, 1, 3),
            shN=torch.zeros(4, 0, 3),
        )
        self.optimizer = build_adam(param_groups(self.splats, {}, LearningRates(), 1.0))
        self.quantizer = NSVQ(4, 3)
        with torch.no_grad():
            self.quantizer.codebook.copy_(self.splats.scales)
        self.quantizer.fitted.fill_(True)
        self.callback = FreezeCodes()
        self.host: Any = SimpleNamespace(
            splats=self.splats,
            quantizers={"scales": self.quantizer},
            schedule=Schedule(),
            rows=lambda name: self.splats.scales.detach(),
        )
        self.trainer: Any = SimpleNamespace(optimizers=[self.optimizer], global_step=0, world_size=1)
        assert self.host.schedule.first_of(Phase.FINETUNE) == FIRST

    def start(self, iteration: int) -> list[int]:
        """Start an iteration; the frozen codes."""
        self.trainer.global_step = iteration - 1
        self.callback.on_train_batch_start(self.trainer, self.host, None, 0)
        codes: list[int] = self.quantizer.codes.tolist()
        return codes

    def remove_first(self) -> None:
        keep_rows(self.splats, self.optimizer, torch.arange(len(self.splats)) > 0)

    def append_last(self) -> None:
        rows = {name: value.detach()[-1:] for name, value in self.splats.attributes().items()}
        append_rows(self.splats, self.optimizer, rows)


@pytest.mark.parametrize(
    ("edits", "expected"),
    [("remove_first", [1, 2, 3]), ("append_last", [0, 1, 2, 3, 3]), ("remove_first append_last", [1, 2, 3, 3])],
)
def test_codes_of_changed_splats_are_searched_again_with_one_warning(
    edits: str, expected: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    stage = Stage()
    assert stage.start(FIRST - 1) == []
    assert stage.start(FIRST) == [0, 1, 2, 3]
    with caplog.at_level(logging.WARNING):
        for edit in edits.split():
            getattr(stage, edit)()
        assert stage.start(FIRST + 1) == expected
        stage.remove_first()
        assert stage.start(FIRST + 2) == expected[1:]
    assert [record.message.partition(":")[0] for record in caplog.records] == [f"iteration {FIRST + 1}"]
    assert "codes of scales are searched again" in caplog.text


def test_frozen_codes_are_left_alone_where_splats_are() -> None:
    stage = Stage()
    stage.start(FIRST)
    with torch.no_grad():
        stage.splats.scales.zero_()  # all would have code 0 now
    assert stage.start(FIRST + 1) == [0, 1, 2, 3]


def test_codes_that_follow_an_edit_are_not_searched_again(caplog: pytest.LogCaptureFixture) -> None:
    stage = Stage()
    stage.start(FIRST)
    with torch.no_grad():
        stage.splats.scales.zero_()
        stage.splats.quats[1] = math.nan
    keep_finite_splats(stage.trainer, stage.host)
    caplog.clear()
    assert stage.start(FIRST + 1) == [0, 2, 3]
    assert not caplog.records


def test_a_resumed_run_keeps_the_codes_of_its_checkpoint() -> None:
    stage = Stage()
    stage.quantizer.freeze(torch.tensor([3, 3, 0, 1]))
    assert stage.start(FIRST + 5) == [3, 3, 0, 1]
    stage.remove_first()
    stage.callback = FreezeCodes()
    assert stage.start(FIRST + 6) == [1, 2, 3]
