"""A whole run that computes the same in another way: with the switches of skips off, and between guard words."""

from __future__ import annotations

from guards import guarded
from runs import Recipe, RunFactory, Whole

from nsvq_lightning.skips import SKIPS, switched
from nsvq_lightning.training.run_folder import run_folder


def test_a_run_that_skips_nothing_between_guard_words_ends_with_the_same_bits(
    paper: Whole, run: RunFactory, recipe: Recipe
) -> None:
    """Other runs of these tests do without guard words, for speed."""
    with guarded(), switched(**dict.fromkeys(SKIPS, False)):
        trainer, _ = run(recipe().values())
    # The settings in the header are the same, too.
    assert (run_folder(trainer) / "scene.nsvq").read_bytes() == paper.scene
