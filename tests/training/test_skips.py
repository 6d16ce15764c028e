"""A whole run with the switches of skips set otherwise."""

from __future__ import annotations

import pytest
import torch
from runs import Recipe, RunFactory
from torch import Tensor

from nsvq_lightning.io.formats import load
from nsvq_lightning.skips import SKIPS, switched
from nsvq_lightning.training.run_folder import run_folder

EXACT = [name for name, skip in SKIPS.items() if skip.exact]


def decoded(run: RunFactory, recipe: Recipe, **switches: bool) -> dict[str, Tensor]:
    """The splats of the file that a run leaves."""
    with switched(**switches):
        trainer, _ = run(recipe().values())
    splats = load(run_folder(trainer) / "scene.nsvq")
    return {name: parameter.detach() for name, parameter in splats.attributes().items()}


@pytest.fixture(scope="module")
def standard(run: RunFactory, recipe: Recipe) -> dict[str, Tensor]:
    return decoded(run, recipe)


def test_a_run_that_skips_nothing_ends_with_the_same_bits(
    run: RunFactory, recipe: Recipe, standard: dict[str, Tensor]
) -> None:
    nothing_skipped = decoded(run, recipe, **dict.fromkeys(EXACT, False))
    assert {name: torch.equal(nothing_skipped[name], standard[name]) for name in standard} == dict.fromkeys(
        standard, True
    )


def test_a_run_that_leaves_idle_rows_is_another_one_and_repeatable(
    run: RunFactory, recipe: Recipe, standard: dict[str, Tensor]
) -> None:
    first, second = (decoded(run, recipe, adam_rows=True) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert first["means"].shape != standard["means"].shape or not torch.equal(first["means"], standard["means"])
