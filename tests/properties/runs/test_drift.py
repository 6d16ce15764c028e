"""A whole run on a scene with bad points stays finite from the first step to the last."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from small_demo import write_small_demo
from torch import Tensor

from nsvq_lightning.callbacks import DensityControl
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

FAR = 1e5


class Watch(Callback):
    """Looks at every number of scene, codebooks and optimiser after every step."""

    def __init__(self) -> None:
        self.steps = 0
        self.phases: set[Phase] = set()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Fail at the first number that is not finite."""
        assert isinstance(pl_module, SplatModule)
        assert outputs, f"step {trainer.global_step} was refused"
        for name, tensor in _numbers(trainer, pl_module):
            assert torch.isfinite(tensor).all(), f"step {trainer.global_step}: {name}"
        self.steps += 1
        self.phases.add(pl_module.phase)


def _numbers(trainer: Trainer, module: SplatModule) -> Iterator[tuple[str, Tensor]]:
    yield from module.state_dict().items()
    optimizer = trainer.optimizers[0]
    for group in optimizer.param_groups:
        state = optimizer.state.get(group["params"][0], {})
        yield from ((f"{key} of {group['name']}", moment) for key, moment in state.items())


@pytest.fixture(scope="module")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """9 views that are trained at 32x24, 150 points."""
    return write_small_demo(tmp_path_factory.mktemp("tiny") / "scene", views=9, width=64, height=48, points=150)


def _bad_splats(root: Path) -> Splats:
    """The scene's points with duplicates, points a hair apart, points at camera centres, and far outliers."""
    scene = load_scene(root)
    centres = torch.stack([camera.position for camera in scene.cameras])
    outliers = FAR * torch.cat([torch.eye(3), -torch.eye(3)])
    points = torch.cat([scene.points, scene.points[:30], scene.points[:30] + 1e-7, centres, outliers])
    more = torch.rand(len(points) - len(scene.points), 3, generator=generator(0))
    return Splats.from_points(points, torch.cat([scene.colors, more]), sh_degree=1)


@pytest.mark.parametrize("steps", [200, pytest.param(45_000, marks=pytest.mark.long)])
def test_a_run_on_bad_points_never_has_a_number_that_is_none(
    steps: int,
    tiny_scene: Path,
    run: Callable[..., tuple[Trainer, SplatModule]],
    recipe: Callable[..., dict[str, Callback]],
    caplog: pytest.LogCaptureFixture,
) -> None:
    watch = Watch()
    callbacks = recipe(density=DensityControl(grad_threshold=5e-6, max_splats=1000))
    callbacks = {name: callback for name, callback in callbacks.items() if name not in ("report", "export")}
    with caplog.at_level(logging.WARNING, logger="nsvq_lightning"):
        _, module = run(
            [*callbacks.values(), watch], scene=tiny_scene, module={"splats": _bad_splats(tiny_scene)}, max_steps=steps
        )
    assert watch.steps == steps
    assert watch.phases == set(Phase)
    assert "non-finite" not in caplog.text
    assert all(bool(torch.isfinite(value).all()) for value in module.compressed().decode().raw())
