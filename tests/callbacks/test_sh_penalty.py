"""The pull of SH coefficients to zero: the gradient of its formula, and what a run keeps of it."""

from __future__ import annotations

import math

import pytest
import torch
from lightning.pytorch import Trainer
from splat_scenes import random_splats

from nsvq_lightning.callbacks import ShPenalty
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.module import SplatModule


def module() -> SplatModule:
    return SplatModule(codebooks=None, splats=Splats.from_tensors(*random_splats(7)))


def test_it_adds_the_gradient_of_half_the_mean_squared_norm() -> None:
    ours, plain = module(), module()
    ours.splats.shN.grad = torch.ones_like(ours.splats.shN)
    ShPenalty(0.3).on_before_optimizer_step(Trainer(logger=False), ours, None)
    coefficients = plain.splats.shN
    (coefficients.sum() + 0.3 * coefficients.flatten(1).square().sum(1).mean() / 2).backward()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(ours.splats.shN.grad, coefficients.grad)
    assert all(p.grad is None for name, p in ours.splats.named_parameters() if name != "shN")


def test_without_weight_or_gradient_nothing_happens() -> None:
    host = module()
    ShPenalty(0.3).on_before_optimizer_step(Trainer(logger=False), host, None)
    assert host.splats.shN.grad is None  # a step that must not update, or frozen codes
    host.splats.shN.grad = torch.ones_like(host.splats.shN)
    ShPenalty().on_before_optimizer_step(Trainer(logger=False), host, None)
    assert torch.equal(host.splats.shN.grad, torch.ones_like(host.splats.shN))


@pytest.mark.parametrize("weight", [-1.0, math.nan, math.inf])
def test_a_weight_that_is_none_is_refused(weight: float) -> None:
    with pytest.raises(ValueError, match="weight must be finite and at least 0"):
        ShPenalty(weight)
