"""A whole run with the switches of skips set otherwise."""

from __future__ import annotations

import torch
from runs import Recipe, RunFactory
from torch import Tensor

from nsvq_lightning.io.formats import load
from nsvq_lightning.skips import SKIPS, switched
from nsvq_lightning.training.run_folder import run_folder


def decoded(run: RunFactory, recipe: Recipe, **switches: bool) -> dict[str, Tensor]:
    """The splats of the file that a run leaves."""
    with switched(**switches):
        trainer, _ = run(recipe().values())
    splats = load(run_folder(trainer) / "scene.nsvq")
    return {name: parameter.detach() for name, parameter in splats.attributes().items()}


def test_a_run_that_skips_nothing_ends_with_the_same_bits(run: RunFactory, recipe: Recipe) -> None:
    standard = decoded(run, recipe)
    nothing_skipped = decoded(run, recipe, **dict.fromkeys(SKIPS, False))
    assert {name: torch.equal(nothing_skipped[name], standard[name]) for name in standard} == dict.fromkeys(
        standard, True
    )
