"""Selection: which splats are left, and when."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from splat_scenes import front_camera, random_splats

from nsvq_lightning.callbacks import SplatSelection
from nsvq_lightning.data.scene import View
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.schedule import Schedule

SCHEDULE = Schedule(total=40, reference_total=40, warmup_end=10, prune_end=20, quantize_end=30)
CAMERAS = 20 * (front_camera(), front_camera(30, 50))


def selected(raw: RawSplats, selection: SplatSelection, budget: int | None = None, until: int = 40) -> RawSplats:
    """What is left of splats after some iterations."""
    splats = Splats.from_tensors(*raw)
    photos = [torch.zeros(camera.height, camera.width, 3) for camera in CAMERAS]
    views = [View(str(k), k, camera, photo) for k, (camera, photo) in enumerate(zip(CAMERAS, photos, strict=True))]
    scene = SimpleNamespace(train=range(len(views)), view=views.__getitem__)
    trained = SimpleNamespace(splats=splats, render=render)
    module: Any = SimpleNamespace(splats=splats, schedule=SCHEDULE, seed=0, splat_budget=budget, scene=trained)
    trainer: Any = SimpleNamespace(
        optimizers=[build_adam(param_groups(splats, {}, LearningRates(), 1.0))],
        datamodule=SimpleNamespace(scene=scene),
        global_rank=0,
        world_size=1,
        strategy=None,
    )
    for step in range(until):
        trainer.global_step = step
        selection.on_train_batch_start(trainer, module, views[0], 0)
    return RawSplats(*(tensor.detach() for tensor in splats.raw()))


def changes(raw: RawSplats) -> torch.Tensor:
    """What removing each splat alone does to the pictures, as a sum of squares ``[N]``."""
    cameras = CAMERAS[:2]
    whole = [render(raw, camera).image for camera in cameras]
    found = torch.zeros(len(raw.means))
    for row in range(len(found)):
        kept = torch.arange(len(found)) != row
        without = [render(RawSplats(*(tensor[kept] for tensor in raw)), camera).image for camera in cameras]
        found[row] = sum((a - b).square().sum() for a, b in zip(whole, without, strict=True))
    return found


def test_those_that_the_pictures_need_are_left_in_their_order() -> None:
    raw = random_splats(60, log_scale=-1.5)
    effects = changes(raw)
    left = selected(raw, SplatSelection(budget=30)).means
    rows = [int((raw.means == mean).all(1).nonzero()) for mean in left]
    assert rows == sorted(rows)
    assert len(rows) == 30
    # An estimate, so those near the middle may be on either side.
    order = effects.argsort(descending=True).tolist()
    assert set(order[:20]) <= set(rows)
    assert not set(order[-20:]) & set(rows)


def test_opaque_splats_count_although_their_middle_has_no_gradient() -> None:
    raw = random_splats(20, log_scale=-1.5)
    opaque = changes(raw).argmax()
    raw.opacities[opaque] = 30.0
    assert (selected(raw, SplatSelection(budget=5)).opacities == 30.0).any()


@pytest.mark.parametrize(("until", "left"), [(10, 20), (11, 7)])
def test_it_acts_when_the_phase_starts_by_the_modules_budget(until: int, left: int) -> None:
    assert len(selected(random_splats(20), SplatSelection(), 7, until).means) == left


def test_a_run_without_the_phase_has_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "SCHEDULE", replace(SCHEDULE, prune_end=10))
    assert len(selected(random_splats(20), SplatSelection(), 7).means) == 7


class Late(SplatSelection):
    """Selects five iterations into the phase."""

    def is_due(self, module: Any, iteration: int) -> bool:
        return iteration == 15


@pytest.mark.parametrize(("until", "left"), [(14, 20), (15, 7)])
def test_a_subclass_says_when(until: int, left: int) -> None:
    assert len(selected(random_splats(20), Late(), 7, until).means) == left


@pytest.mark.parametrize("budget", [None, 20, 30])
def test_without_a_budget_or_below_it_nothing_happens(budget: int | None) -> None:
    raw = random_splats(20)
    assert torch.equal(selected(raw, SplatSelection(budget=budget)).means, raw.means)


def test_what_no_view_shows_counts_by_its_size_and_opacity() -> None:
    raw = random_splats(20)
    raw.opacities[:10] = -3.0
    raw.opacities[10:] = 3.0
    hidden = raw.means[[0, 10]] = -1000 * raw.means[[0, 10]]
    left = selected(raw, SplatSelection(budget=10)).means.tolist()
    assert [mean in left for mean in hidden.tolist()] == [False, True]
