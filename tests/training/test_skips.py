"""Whole runs that compute the same in another way: with the switches of skips, and between guard words."""

from __future__ import annotations

from guards import guarded
from runs import Recipe, RunFactory, Whole

from nsvq_lightning.skips import SKIPS, switched
from nsvq_lightning.training.run_folder import run_folder


def test_a_run_that_skips_nothing_ends_with_the_same_bits(paper: Whole, run: RunFactory, recipe: Recipe) -> None:
    with switched(**dict.fromkeys(SKIPS, False)):
        trainer, _ = run(recipe().values())
    # The settings in the header are the same, too.
    assert (run_folder(trainer) / "scene.nsvq").read_bytes() == paper.scene


def test_no_kernel_of_a_run_writes_beside_its_arrays(paper: Whole, run: RunFactory, recipe: Recipe) -> None:
    """Other runs of these tests do without guard words, for speed."""
    with guarded():
        trainer, _ = run(recipe().values())
    assert (run_folder(trainer) / "scene.nsvq").read_bytes() == paper.scene
