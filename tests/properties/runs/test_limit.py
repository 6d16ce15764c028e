"""``max_splats`` is a limit: of the scene that training starts with, and of what grows from it."""

from __future__ import annotations

from typing import Any

import pytest
from lightning.pytorch import Callback, LightningModule, Trainer
from runs import Recipe, RunFactory, Whole

from nsvq_lightning.callbacks import DensityControl
from nsvq_lightning.random import draw_rows, generator
from nsvq_lightning.training.run_scene import train_contributions


class Counts(Callback):
    """The number of splats in each iteration, and what the first ones contribute."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        self.seen.append(len(pl_module.splats))


def limited(most: int | None) -> DensityControl:
    return DensityControl(grad_threshold=5e-6, max_splats=most)


@pytest.mark.parametrize(("most", "first"), [(400, 280), (600, 420), (800, 500)])
def test_no_iteration_has_more(run: RunFactory, recipe: Recipe, most: int, first: int) -> None:
    counts = Counts()
    _, module = run([*recipe(density=limited(most)).values(), counts])
    assert counts.seen[0] == first  # the scene has 500 points; there is room to grow
    assert max(counts.seen) == most
    assert len(module.splats) <= most


def test_what_stays_is_drawn_by_what_the_photos_see(run: RunFactory, recipe: Recipe) -> None:
    trainer, everything = run(recipe(density=limited(None)).values(), max_steps=1, module={"rates": {"means": 1e-12}})
    contribution = train_contributions(trainer, everything.scene)
    drawn = draw_rows(contribution.sqrt(), 35, generator(everything.seed, 0, "limit"))
    expected = everything.splats.means[drawn]
    assert contribution[drawn].mean() > 1.1 * contribution.mean()
    _, few = run(recipe(density=limited(50)).values(), max_steps=1, module={"rates": {"means": 1e-12}})
    assert len(few.splats) == 35
    same = (few.splats.means[:, None] - expected[None]).abs().amax(2).amin(1) < 1e-4
    assert same.sum() > 32  # one step of the other attributes has moved the order a little


def test_the_limit_comes_too_late_for_codebooks(paper: Whole, caplog: pytest.LogCaptureFixture) -> None:
    count = len(paper.module.splats)
    limited(20).on_train_start(paper.trainer, paper.module)
    assert len(paper.module.splats) == count
    assert f"max_splats=20 comes too late for {count} splats" in caplog.text
