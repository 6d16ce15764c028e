"""Codes that turn non-finite: found, named, put back."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nsvq_lightning.callbacks import FiniteCodes
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.training.optim import codebook_group
from nsvq_lightning.training.schedule import Schedule

ROWS = torch.randn(50, 3, generator=generator(0))
QUANTIZE, FINETUNE = 30_000, 44_000


def fitted() -> NSVQ:
    quantizer = NSVQ(6, 3)
    quantizer.fit(ROWS)
    return quantizer


def search(quantizer: Any, iteration: int, updated: bool = True, every: int = 100) -> dict[str, Tensor]:
    """Run the callback at the end of an iteration; returns Adam's state of the codebook, 1 before."""
    quantizer.codebook.grad = torch.zeros_like(quantizer.codebook) if updated else None
    group = {"name": codebook_group("scales"), "params": [quantizer.codebook]}
    state = {key: torch.ones_like(quantizer.codebook) for key in ("exp_avg", "exp_avg_sq")}
    optimizer = SimpleNamespace(param_groups=[group], state={quantizer.codebook: state})
    trainer: Any = SimpleNamespace(global_step=iteration, optimizers=[optimizer])
    trained = SimpleNamespace(rows=lambda name: ROWS)
    host: Any = SimpleNamespace(schedule=Schedule(), quantizers={"scales": quantizer}, scene=trained, seed=0)
    FiniteCodes(every).on_train_batch_end(trainer, host, {}, None, 0)
    return state


def plant(quantizer: NSVQ, *codes: int) -> Tensor:
    """Break codes; returns the codebook before."""
    before = quantizer.codebook.detach().clone()
    for code, value in zip(codes, (torch.nan, torch.inf), strict=False):
        quantizer.codebook.data[code, 1] = value
    return before


def test_codes_become_copies_of_finite_ones_and_their_moments_start_anew(caplog: pytest.LogCaptureFixture) -> None:
    quantizer = fitted()
    before = plant(quantizer, 2, 4)
    with caplog.at_level(logging.WARNING):
        state = search(quantizer, QUANTIZE)
    after, whole = quantizer.codebook.detach(), [0, 1, 3, 5]
    assert torch.equal(after[whole], before[whole])
    assert all(any(torch.allclose(after[code], before[other]) for other in whole) for code in (2, 4))
    assert all(moment[[2, 4]].eq(0).all() and moment[whole].eq(1).all() for moment in state.values())
    assert caplog.messages == [f"step {QUANTIZE}: 2 of 6 codes of scales are non-finite (rows 2, 4); mended"]


def test_a_frozen_code_becomes_the_mean_of_its_rows() -> None:
    quantizer = fitted()
    codes = quantizer.encode(ROWS)
    quantizer.freeze(codes)
    plant(quantizer, 3)
    search(quantizer, FINETUNE)
    expected = ROWS[codes == 3].double().mean(0).float()
    torch.testing.assert_close(quantizer.codebook.detach()[3], expected)


def test_codebooks_are_searched_when_it_is_time_or_a_loss_was_not_finite() -> None:
    quantizer = fitted()
    plant(quantizer, 2)
    search(quantizer, QUANTIZE + 1)
    search(quantizer, 10_000, updated=False)  # before the quantize phase
    assert not quantizer.codebook.isfinite().all()
    search(quantizer, QUANTIZE + 1, updated=False)
    assert quantizer.codebook.isfinite().all()


def test_what_cannot_be_mended_ends_the_run() -> None:
    quantizer = fitted()
    quantizer.codebook.data.fill_(torch.nan)
    with pytest.raises(FloatingPointError, match="6 of 6 codes of scales are non-finite; lower the learning rates"):
        search(quantizer, QUANTIZE)
    foreign = SimpleNamespace(codebook=torch.tensor([[1.0], [torch.inf]]))
    with pytest.raises(FloatingPointError, match="1 of 2 codes of scales"):
        search(foreign, QUANTIZE)


def test_replacement_neither_copies_a_broken_code_nor_hides_it_with_moments_that_break_it_again() -> None:
    quantizer = fitted()
    plant(quantizer, 2)
    quantizer.usage.copy_(torch.tensor([10, 0, 0, 10, 10, 10]))
    quantizer.window.fill_(10)
    assert quantizer.replace_unused(generator(1)).tolist() == [1]
    assert quantizer.codebook.isfinite().all(1).tolist() == [True, True, False, True, True, True]
    moments = search(quantizer, QUANTIZE)
    assert quantizer.codebook.isfinite().all()
    assert all(moment[2].eq(0).all() for moment in moments.values())
