"""Codes by rate and distortion in whole runs: fewer bits, the same bits after a resumption, nothing while it is off."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import Recipe, RunFactory
from torch import Tensor

from nsvq_lightning.callbacks import DensityControl, RateDistortion, RunCheckpoint
from nsvq_lightning.quantize import TrainedStraightThrough
from nsvq_lightning.quantize.nearest import code_rates
from nsvq_lightning.training.module import SplatModule

MODULE = {"quantizer": TrainedStraightThrough}


def bits(module: SplatModule) -> float:
    """Bits of all codes of a splat at their entropy."""
    total = 0.0
    for quantizer in module.quantizers.values():
        total += float(code_rates(quantizer.codes, len(quantizer.codebook))[quantizer.codes].mean())
    return total


def numbers(module: SplatModule) -> dict[str, Tensor]:
    return {name: value for name, value in module.state_dict().items() if "seconds" not in name}


def test_codes_take_fewer_bits_the_stronger_it_is(run: RunFactory, recipe: Recipe) -> None:
    found = []
    for strength in (0.0, 0.01, 0.1):
        _, module = run(recipe(rate_distortion=RateDistortion(strength)).values(), module=MODULE)
        assert all(len(quantizer.held) == 0 for quantizer in module.codebooks.values())  # type: ignore[arg-type]
        found.append(bits(module))
    assert found[0] > found[1] + 0.3
    assert found[1] > found[2] + 0.3


def test_a_resumed_run_gives_the_same_bits(run: RunFactory, recipe: Recipe, tmp_path: Path) -> None:
    def callbacks(folder: Path) -> list[object]:
        checkpoint = RunCheckpoint(every=1, keep=True, folder=str(folder))
        return list(recipe(rate_distortion=RateDistortion(0.02), checkpoint=checkpoint).values())

    _, whole = run(callbacks(tmp_path / "whole"), module=MODULE)
    first, last = whole.schedule.ends[1] + 1, whole.schedule.ends[2]
    assert last - first >= 6
    for iteration in (first, first + 3, last):
        ckpt_path = tmp_path / "whole" / f"step-{iteration}.ckpt"
        _, resumed = run(callbacks(tmp_path / str(iteration)), ckpt_path=ckpt_path, module=MODULE)
        for name, value in numbers(resumed).items():
            assert torch.equal(value, numbers(whole)[name]), (iteration, name)


def test_other_attributes_keep_their_nearest_codes(run: RunFactory, recipe: Recipe) -> None:
    held: dict[str, int] = {}

    class Watch(Callback):
        def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            held.update({name: len(q.held) for name, q in pl_module.quantizers.items() if len(q.held)})  # type: ignore[attr-defined]

    callbacks = recipe(rate_distortion=RateDistortion(0.02, ["shN", "scales"])).values()
    run([*callbacks, Watch()], module=MODULE)
    assert held.keys() == {"shN", "scales"}


def test_dropped_splats_are_measured_anew(run: RunFactory, recipe: Recipe) -> None:
    counts: list[int] = []

    class Spoil(Callback):
        def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            host = pl_module
            if trainer.global_step == 35:
                host.splats.means.data[:7] = torch.nan
            counts.append(len(host.splats))

    callbacks = recipe(density=DensityControl(finite_every=1), rate_distortion=RateDistortion(0.02)).values()
    _, module = run([Spoil(), *callbacks], module=MODULE)
    assert counts[-1] == counts[33] - 7
    assert all(len(quantizer.codes) == counts[-1] for quantizer in module.quantizers.values())


def test_unknown_attributes_are_refused() -> None:
    with pytest.raises(ValueError, match="must be among scales, quats, sh0, shN, got means"):
        RateDistortion(attributes=["means"])


@pytest.mark.parametrize("strength", [-1.0, float("inf"), float("nan")])
def test_impossible_strengths_are_refused(strength: float) -> None:
    with pytest.raises(ValueError, match="strength must be a finite number"):
        RateDistortion(strength)
