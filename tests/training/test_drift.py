"""A whole run on a scene with bad points stays finite from the first step to the last."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.edit import finite_rows
from nsvq_lightning.module import SplatModule
from nsvq_lightning.splats import Splats

STEPS = 200
FAR = 1e5


class Watch(Callback):
    """Looks at every number after every step."""

    def __init__(self) -> None:
        self.steps = 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Fail at the first number that is not finite."""
        assert isinstance(pl_module, SplatModule)
        assert outputs, f"step {trainer.global_step} was refused"
        assert not finite_rows(pl_module.splats)[1], f"step {trainer.global_step}"
        for name, quantizer in pl_module.quantizers.items():
            assert torch.isfinite(quantizer.codebook).all(), f"step {trainer.global_step}: codebook of {name}"
        self.steps += 1


def test_a_run_on_bad_points_never_has_a_number_that_is_none(
    demo_scene: Path,
    run: Callable[..., tuple[Trainer, SplatModule]],
    recipe: Callable[..., dict[str, Callback]],
    caplog: pytest.LogCaptureFixture,
) -> None:
    scene = load_scene(demo_scene)
    centres = torch.stack([scene.cameras[i].position for i in scene.train])
    outliers = FAR * torch.cat([torch.eye(3), -torch.eye(3)])
    points = torch.cat([scene.points, scene.points[:50], scene.points[:50] + 1e-7, centres, outliers])
    colors = torch.cat([scene.colors, torch.rand(len(points) - len(scene.points), 3, generator=torch.Generator())])
    splats = Splats.from_points(points, colors, sh_degree=1)
    watch = Watch()
    callbacks = {name: callback for name, callback in recipe().items() if name not in ("report", "export")}
    with caplog.at_level(logging.WARNING, logger="nsvq_lightning"):
        _, module = run([*callbacks.values(), watch], module={"splats": splats}, max_steps=STEPS)
    assert watch.steps == STEPS
    assert "non-finite" not in caplog.text
    assert all(bool(torch.isfinite(value).all()) for value in module.compressed().decode().raw())
