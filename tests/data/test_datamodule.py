from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from lightning.pytorch import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.utilities.model_helpers import is_overridden
from runs import quiet_trainer
from torch import Tensor, nn
from torch.utils.data import DataLoader

from nsvq_lightning.data import datamodule
from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.datamodule import (
    DEMO,
    ColmapDataModule,
    DemoDataModule,
    DevicePhotos,
    SceneDataModule,
    view_order,
)
from nsvq_lightning.data.scene import View
from nsvq_lightning.rendering.camera import Camera

SceneFactory = Callable[..., Path]


class _Recorder(LightningModule):
    """Writes down the views it gets."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self.trained: list[str] = []
        self.validated: list[str] = []
        self.predicted: list[str] = []

    def training_step(self, view: View, index: int) -> Tensor:
        self.trained.append(view.name)
        return self.weight.sum() + view.image.float().mean()

    def validation_step(self, view: View, index: int) -> None:
        self.validated.append(view.name)

    def predict_step(self, view: View, index: int) -> None:
        self.predicted.append(view.name)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), 0.1)


def _on(data: ColmapDataModule, step: int, rank: int, world_size: int, repeated: int = 0) -> ColmapDataModule:
    """The data module as it is on one of several processes, with so many batches that are repeated."""
    progress = SimpleNamespace(total=SimpleNamespace(processed=step))
    loop = SimpleNamespace(epoch_loop=SimpleNamespace(batch_progress=progress))
    trainer = SimpleNamespace(fit_loop=loop, global_rank=rank, world_size=world_size, overfit_batches=repeated)
    data.trainer = cast(Trainer, trainer)
    return data


@pytest.mark.parametrize("accumulate", [1, 2])
def test_run_resumed_sees_the_views_of_the_run_not_interrupted(
    make_scene: SceneFactory, tmp_path: Path, accumulate: int
) -> None:
    root = str(make_scene())
    whole, first, second = _Recorder(), _Recorder(), _Recorder()
    quiet_trainer(tmp_path, 20, accumulate_grad_batches=accumulate).fit(whole, ColmapDataModule(root, seed=4))
    trainer = quiet_trainer(tmp_path, 7, accumulate_grad_batches=accumulate)
    trainer.fit(first, ColmapDataModule(root, seed=4))
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    quiet_trainer(tmp_path, 20, accumulate_grad_batches=accumulate).fit(
        second, ColmapDataModule(root, seed=4), ckpt_path=tmp_path / "a.ckpt", weights_only=True
    )
    assert len(first.trained) == 7 * accumulate
    assert first.trained + second.trained == whole.trained
    scene = ColmapDataModule(root).scene
    order = islice(view_order(len(scene.train), seed=4), 20 * accumulate)  # oracle: the sampler
    assert whole.trained == [scene.names[scene.train[i]] for i in order]
    assert not {scene.names[i] for i in scene.test} & set(whole.trained)


def test_validation_within_a_fit_and_prediction(make_scene: SceneFactory, tmp_path: Path) -> None:
    data, module = ColmapDataModule(str(make_scene(views=18))), _Recorder()
    trainer = quiet_trainer(tmp_path, 10, val_check_interval=5, check_val_every_n_epoch=None)
    trainer.fit(module, data)
    assert module.validated == ["000.png", "008.png", "016.png"] * 2
    trainer.predict(module, data, return_predictions=False)
    assert module.predicted == list(data.scene.names)


def test_processes_share_the_train_sequence_and_the_test_views(make_scene: SceneFactory) -> None:
    root = str(make_scene(views=30))
    whole = [view.name for view in islice(ColmapDataModule(root).train_dataloader(), 40)]
    ranks = [_on(ColmapDataModule(root), 0, rank, 2) for rank in (0, 1)]
    draws = [[view.name for view in islice(data.train_dataloader(), 20)] for data in ranks]
    assert [name for pair in zip(*draws, strict=True) for name in pair] == whole
    shares = [[view.index for view in _on(ColmapDataModule(root), 0, r, 3).val_dataloader()] for r in range(3)]
    assert shares == [[0, 24], [8], [16]]  # nothing padded


def test_some_of_many_test_views_are_looked_at_during_a_run(
    make_scene: SceneFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = ColmapDataModule(str(make_scene(views=33)))
    assert [view.index for view in data.val_dataloader()] == [0, 8, 16, 24, 32]
    monkeypatch.setattr(datamodule, "VALIDATED", 3)
    assert [view.index for view in data.val_dataloader()] == [0, 16, 32]
    assert [view.index for view in data.test_dataloader()] == [0, 8, 16, 24, 32]


def test_workers_that_would_each_give_all_views_are_refused(make_scene: SceneFactory) -> None:
    loader = ColmapDataModule(str(make_scene())).train_dataloader()
    with pytest.raises(ValueError, match="set num_workers=0"):
        next(iter(DataLoader(loader.dataset, batch_size=None, num_workers=1)))


def test_overfitting_repeats_the_first_views(make_scene: SceneFactory) -> None:
    root = str(make_scene(views=30))
    first = [view.name for view in islice(ColmapDataModule(root).train_dataloader(), 2)]
    for step in (0, 2, 8):
        data = _on(ColmapDataModule(root), step, 0, 1, repeated=2)
        assert [view.name for view in islice(data.train_dataloader(), 2)] == first


def test_more_processes_than_test_views(make_scene: SceneFactory) -> None:
    data = _on(ColmapDataModule(str(make_scene())), 0, 0, 4)
    with pytest.raises(SceneError, match="2 test views cannot be shared by 4 processes: use fewer devices"):
        data.setup("fit")  # a run would notice at its first evaluation
    data.setup("predict")


def test_setup_is_idempotent_and_prints_the_split_once(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture
) -> None:
    data = ColmapDataModule(str(make_scene()))
    with caplog.at_level(logging.INFO):
        data.setup("fit")
        scene = data.scene
        data.setup("test")
    assert data.scene is scene
    texts = [record.getMessage() for record in caplog.records if "test views" in record.getMessage()]
    assert len(texts) == 1
    assert "7 train views, 2 test views (every 8th by name: 000.png, 008.png)" in texts[0]


def test_one_of_several_processes_can_train_alone_on_a_scene_that_is_there() -> None:
    # Lightning makes all processes meet where there is such a hook: one that compresses by itself would wait for ever.
    assert is_overridden("prepare_data", ColmapDataModule("photos"), LightningDataModule)
    assert not is_overridden("prepare_data", SceneDataModule(ColmapDataModule(str(DEMO)).scene), LightningDataModule)


def test_demo_is_read_where_it_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in DEMO.rglob("*")}
    data = DemoDataModule(factor=2)
    data.prepare_data()
    data.setup()
    assert (len(data.scene), data.scene.test) == (40, (0, 8, 16, 24, 32))
    assert tuple(data.scene.view(0).image.shape) == (120, 160, 3)
    assert {path: path.stat().st_mtime_ns for path in DEMO.rglob("*")} == before
    assert list(tmp_path.iterdir()) == []


def test_every_epoch_is_a_permutation_and_epochs_differ() -> None:
    order = list(islice(view_order(11, seed=3), 33))
    epochs = [tuple(order[i : i + 11]) for i in (0, 11, 22)]
    assert all(sorted(epoch) == list(range(11)) for epoch in epochs)
    assert len(set(epochs)) == 3


def test_known_order() -> None:
    # the order is part of a run's identity: a change here breaks resuming old checkpoints
    assert list(islice(view_order(5, seed=0), 10)) == [4, 0, 1, 3, 2, 2, 4, 0, 3, 1]


@pytest.mark.parametrize(("start", "ranks"), [(0, 1), (10, 1), (11, 1), (57, 1), (0, 2), (5, 3)])
def test_ranks_share_one_sequence_from_any_draw(start: int, ranks: int) -> None:
    whole = list(islice(view_order(11, seed=1), 100))
    for rank in range(ranks):
        found = list(islice(view_order(11, 1, rank, ranks, start), 20))
        assert found == whole[start * ranks + rank :: ranks][:20]


ELSEWHERE = torch.device("meta")
BYTES = 4 * 4 * 5


def _view(index: int) -> View:
    camera = Camera(torch.eye(3), torch.eye(4), 5, 4)
    image, mask = torch.zeros(4, 5, 3, dtype=torch.uint8), torch.ones(4, 5, dtype=torch.bool)
    return View(f"{index}.png", index, camera, image, mask)


def test_the_first_photos_stay_while_the_budget_lasts() -> None:
    assert DevicePhotos(10 * BYTES).move(first := _view(0), torch.device("cpu")) is first
    photos, views = DevicePhotos(2 * BYTES + 1), [_view(i) for i in range(3)]
    moved, again = ([photos.move(each, ELSEWHERE) for each in views] for _ in range(2))
    assert [a.image is b.image for a, b in zip(moved, again, strict=True)] == [True, True, False]
    for there, here in zip(again, views, strict=True):
        assert (there.image.is_meta, there.mask is not None and there.mask.is_meta) == (True, True)
        assert (there.name, there.camera) == (here.name, here.camera)


def test_a_view_in_several_sizes_keeps_each() -> None:
    photos, view = DevicePhotos(10 * BYTES), _view(0)
    sizes = [photos.move(each, ELSEWHERE).image.shape for each in (view.smaller(2), view, view.smaller(2))]
    assert sizes == [(2, 2, 3), (4, 5, 3), (2, 2, 3)]


def test_a_gpu_gives_a_part_of_what_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datamodule, "_spare", lambda _: BYTES)
    photos, views = DevicePhotos(10 * BYTES), [_view(i) for i in range(2)]
    first = [photos.move(each, ELSEWHERE) for each in views]
    assert photos.move(views[0], ELSEWHERE).image is first[0].image
    assert photos.move(views[1], ELSEWHERE).image is not first[1].image


def test_a_damaged_photo_leaves_the_views_of_every_process_and_of_a_resumed_run(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_scene(views=18)
    path = root / "images" / "005.png"
    path.write_bytes(path.read_bytes()[:-100])
    (root / "images" / "008.png").write_bytes(b"")
    left = [name for name in (f"{i:03d}.png" for i in range(18)) if name not in ("000.png", "005.png", "008.png")]
    for step, rank in ((0, 0), (0, 1), (4, 0), (4, 1)):
        data = _on(ColmapDataModule(str(root)), step, rank, 2)
        seen = islice(iter(data.train_dataloader()), 7)
        order = view_order(14, 0, rank, 2, step)  # oracle: the sampler, on the train views that are left
        trained = [name for name in left if name != "016.png"]
        assert [view.name for view in seen] == [trained[next(order)] for _ in range(7)]
        assert [data.scene.names[i] for i in data.scene.test] == ["000.png", "016.png"]
    assert caplog.text.count("left out 2 of 18 photos, first: ") == 4
