"""Exposure compensation on photos that were made brighter and darker, and colour correction for metrics."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, Trainer

from nsvq_lightning.callbacks import ExposureCompensation, PhaseSchedule
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.images import ImageStore
from nsvq_lightning.data.scene import View, exposures, load_scene, uneven
from nsvq_lightning.quality.metrics import color_corrected, psnr
from nsvq_lightning.training import distributed
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Schedule

STOPS = (0.0, 0.4, -0.4, 0.3, -0.3, 0.2, -0.2, 0.0, 0.0)
"""Of the nine photos, the first and the last of which are test views."""


@pytest.fixture(scope="module")
def uneven_scene(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("uneven")
    (root / "images").mkdir()
    os.symlink(demo_scene / "sparse", root / "sparse", target_is_directory=True)
    for path, stops in zip(sorted((demo_scene / "images").iterdir()), STOPS, strict=True):
        photo = cv2.imread(str(path)).astype(np.float32) * 0.7
        assert cv2.imwrite(str(root / "images" / path.name), (photo * 2**stops).clip(0, 255).astype(np.uint8))
    return root


def fit(
    scene: Path, folder: Path, callbacks: list[Callback], steps: int, ckpt_path: str | None = None, total: int = 150
) -> tuple[Trainer, SplatModule]:
    trainer = Trainer(
        max_steps=steps,
        accelerator="cpu",
        default_root_dir=folder,
        logger=False,
        callbacks=[PhaseSchedule(total, None, warmup_end=total, prune_end=total, quantize_end=total), *callbacks],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    module = SplatModule(sh_degree=0, codebooks=None)
    trainer.fit(module, ColmapDataModule(str(scene)), ckpt_path=ckpt_path, weights_only=True)
    return trainer, module


def test_exposures_are_found(uneven_scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    compensation = ExposureCompensation(rate=0.003)
    _, module = fit(uneven_scene, tmp_path, [compensation], 150)
    changes = compensation.state_dict()["changes"]
    assert changes.shape == (7, 3, 4)
    gains = 1 + (changes - changes.mean(0))[:, :, :3].diagonal(dim1=1, dim2=2).mean(1)
    found, true = gains.log2(), torch.tensor(STOPS[1:8])
    assert float(torch.corrcoef(torch.stack([found, true]))[0, 1]) > 0.8
    assert "exposures of the train photos: " in caplog.text
    term: Any = module.loss_terms["photometric"]
    assert (list(module.loss_terms), term.args) == (["photometric"], (module,))  # not that with exposures


def test_points_tell_exposures_of_photos(
    uneven_scene: Path, demo_scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = load_scene(uneven_scene)
    found = exposures(scene)
    assert found.shape == (7, 3)
    assert float(torch.corrcoef(torch.stack([found.mean(1).log2(), torch.tensor(STOPS[1:8])]))[0, 1]) > 0.9
    twice = [
        photo._replace(image=(photo.image * 2**stops).clamp(0, 255).to(torch.uint8))
        for photo, stops in zip(map(scene.images.__getitem__, range(9)), STOPS, strict=True)
    ]
    told = uneven(replace(scene, images=ImageStore((), held=twice)))
    assert re.fullmatch("differ in brightness by [23][0-9] %: see ExposureCompensation in .*", told)
    assert uneven(load_scene(demo_scene)) == ""
    random = load_scene(demo_scene).with_random_points()
    assert torch.equal(exposures(random), torch.ones(7, 3))
    compensation = ExposureCompensation()
    fit(uneven_scene, tmp_path, [compensation], 1)
    assert ("differ in brightness" in caplog.text) == bool(uneven(scene))
    start = compensation.state_dict()["changes"][:, :, :3].diagonal(dim1=1, dim2=2) + 1
    # Their mean is kept at 1: no gain is below 0, however many photos are dark.
    torch.testing.assert_close(start, found / found.mean(0), atol=0.01, rtol=0)


def test_a_resumed_run_has_the_same_bits(uneven_scene: Path, tmp_path: Path) -> None:
    whole = ExposureCompensation()
    _, module = fit(uneven_scene, tmp_path / "whole", [whole], 20)
    first, _ = fit(uneven_scene, tmp_path / "part", [ExposureCompensation()], 9)
    first.save_checkpoint(tmp_path / "9.ckpt")
    resumed = ExposureCompensation()
    _, other = fit(uneven_scene, tmp_path / "rest", [resumed], 20, str(tmp_path / "9.ckpt"))
    assert torch.equal(whole.state_dict()["changes"], resumed.state_dict()["changes"])
    assert torch.equal(module.splats.means, other.splats.means)
    assert torch.equal(module.splats.sh0, other.splats.sh0)


def test_colour_correction_undoes_a_map_of_colours() -> None:
    generator = torch.Generator().manual_seed(0)
    photo = torch.rand(30, 40, 3, generator=generator) * 0.6 + 0.2
    mixing = torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.7, 0.1], [0.0, 0.1, 0.9]])
    image = photo @ mixing.T + 0.05
    assert float(psnr(image, photo)) < 30
    assert float(psnr(color_corrected(image, photo), photo)) > 60
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[:20] = True
    spoiled = torch.where(mask[..., None], image, torch.rand(30, 40, 3, generator=generator))
    assert float(psnr(color_corrected(spoiled, photo, mask), photo, mask)) > 60
    # Grey pictures leave most coefficients open; clipped ones all.
    grey = image.mean(-1, keepdim=True).expand(-1, -1, 3)
    assert float(psnr(color_corrected(grey, photo), photo)) > float(psnr(grey, photo))
    assert torch.equal(color_corrected(torch.ones(4, 5, 3), torch.ones(4, 5, 3)), torch.ones(4, 5, 3))


def test_colour_correction_leaves_out_what_the_image_clips() -> None:
    generator = torch.Generator().manual_seed(0)
    photo = torch.rand(60, 80, 3, generator=generator) * 0.9 + 0.05
    image = (1.3 * photo).clamp(0, 1)
    clipped = image == 1
    corrected = color_corrected(image, photo)
    # What is left of a gain is exact where all channels are known, and as dark as others of their colour elsewhere.
    known = ~clipped.any(-1)
    assert float((corrected - photo)[known].abs().max()) < 1e-6
    spoiled = torch.where(clipped, torch.rand(photo.shape, generator=generator), photo)
    torch.testing.assert_close(color_corrected(image, spoiled)[known], photo[known], atol=1e-5, rtol=0)


class OneBadLoss(Callback):
    """Spoils the loss of one iteration, and notes the exposures around it."""

    def __init__(self, compensation: ExposureCompensation, iteration: int) -> None:
        self.compensation, self.iteration = compensation, iteration
        self.changes: dict[int, torch.Tensor] = {}

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, batch: View, batch_idx: int) -> None:  # type: ignore[override]
        if trainer.global_step + 1 == self.iteration:
            batch.image[:] = float("nan")

    def on_train_batch_end(self, trainer: Trainer, *_: object) -> None:
        self.changes[trainer.global_step] = self.compensation.state_dict()["changes"].clone()


def test_a_step_that_changes_nothing_moves_no_exposure(uneven_scene: Path, tmp_path: Path) -> None:
    compensation = ExposureCompensation()
    spoiled = OneBadLoss(compensation, 6)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ColmapDataModule, "transfer_batch_to_device", float_photos)
        fit(uneven_scene, tmp_path, [compensation, spoiled], 8)
    assert not torch.equal(spoiled.changes[4], spoiled.changes[5])
    assert torch.equal(spoiled.changes[5], spoiled.changes[6])
    assert not torch.equal(spoiled.changes[6], spoiled.changes[7])


def float_photos(self: ColmapDataModule, batch: View, device: torch.device, dataloader_idx: int) -> View:
    """Photos that can be NaN."""
    return replace(batch, image=batch.image.float() / 255)


def test_gradients_of_several_processes_are_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for processes in (1, 2):
        compensation = ExposureCompensation(rate=0.1)
        compensation._changes = torch.zeros(2, 3, 4, requires_grad=True)
        compensation._changes.grad = torch.full((2, 3, 4), 0.5)
        compensation._adam = torch.optim.SGD([compensation._changes], lr=0.1)  # type: ignore[assignment]
        # The other process has the same gradient.
        monkeypatch.setattr(distributed, "sum_over_processes", lambda _, tensor, times=processes: tensor.mul_(times))
        group = {"params": [SimpleNamespace(grad=1)]}
        trainer: Any = SimpleNamespace(
            world_size=processes, global_step=0, optimizers=[SimpleNamespace(param_groups=[group])]
        )
        module: Any = SimpleNamespace(updates=True, schedule=Schedule(total=100))
        compensation.on_before_optimizer_step(trainer, module, None)
        found.append(compensation._changes.detach().clone())
    assert torch.equal(*found)
    assert found[0].abs().max() > 0
