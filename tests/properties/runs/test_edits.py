"""Callbacks of users that remove and add splats, anywhere in the list of callbacks, in every phase of a run."""

from __future__ import annotations

import logging
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import Recipe, RunFactory, paper_phases

from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.row_ops import append_rows, keep_rows

STEPS = 60
AMOUNT = 7


class EditRows(Callback):
    """Every third iteration adds copies of the last splats, and to swap them removes the first ones."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.edits = 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if trainer.global_step % 3 or trainer.global_step == STEPS:
            return
        splats, optimizer = pl_module.splats, trainer.optimizers[0]
        self.edits += 1
        if self.kind == "swap":
            keep_rows(splats, optimizer, torch.arange(len(splats)) >= AMOUNT)
        append_rows(splats, optimizer, RawSplats(*(value.detach()[-AMOUNT:] for value in splats.raw())))


@pytest.mark.parametrize(("kind", "place"), [("swap", "first"), ("add", "last")])
def test_splats_may_change_at_the_end_of_a_step(
    kind: str, place: str, run: RunFactory, recipe: Recipe, caplog: pytest.LogCaptureFixture
) -> None:
    edit = EditRows(kind)
    # A fine-tune phase from iteration 48 on, in which splats change, too.
    phases = paper_phases(quantize_end=35_000, min_density_interval=4, min_replacement_interval=5, min_finetune=1)
    callbacks = list(recipe(phases=phases).values())
    callbacks.insert(0 if place == "first" else len(callbacks), edit)
    with caplog.at_level(logging.WARNING):
        _, module = run(callbacks)
    said = [record.message for record in caplog.records if "another callback has removed or added" in record.message]
    left_out = [message for message in said if "List that callback after DensityControl" in message]
    searched = [message for message in said if "codes of scales, quats, sh0, shN are searched again" in message]
    assert edit.edits == STEPS // 3 - 1
    assert len(left_out) == (place == "first")
    assert len(searched) == 1
    assert len(said) == len(left_out) + len(searched)
    splats = module.splats
    assert all(bool(value.isfinite().all()) for value in splats.attributes().values())
    assert {len(table) for table in splats.tables().values()} == {len(splats)}
    assert {len(quantizer.codes) for quantizer in module.quantizers.values()} == {len(splats)}
