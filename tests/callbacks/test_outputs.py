from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback
from runs import fit

from nsvq_lightning.callbacks import ExportScene, LiveScene, PhaseSchedule
from nsvq_lightning.callbacks import outputs as live_callback
from nsvq_lightning.callbacks.settings import Count
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.io import load
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.header import read_header
from nsvq_lightning.io.placing import placed
from nsvq_lightning.report.viewer import LIVE_SCENE, REQUEST, ask_live
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.run_folder import run_folder

CODES = {"scales": 8, "quats": 8, "sh0": 8, "shN": 8}


class Viewer(Callback):
    """Asks before the given iterations, and keeps what is there after each."""

    def __init__(self, asking: set[int]) -> None:
        self.asking = asking
        self.seen: dict[int, Any] = {}
        self.expected: dict[int, Any] = {}
        self.said: dict[int, Any] = {}
        self.folder = Path()

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        self.folder = run_folder(trainer)
        if batch_idx in self.asking:
            ask_live(self.folder)

    def on_train_batch_end(self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        path = self.folder / LIVE_SCENE
        if path.exists():
            self.seen[batch_idx] = load(path)
            self.said[batch_idx] = read_header(path).config
            path.unlink()
            hard = CompressedScene.from_splats(pl_module.scene.hard_splats(pl_module.phase))
            self.expected[batch_idx] = placed(hard, pl_module.frame).decode().raw()


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_callback, "CHECKED_EVERY", 2)
    monkeypatch.setattr(live_callback, "SHARE", 1e6)


def _fit(viewer: Viewer, demo_scene: Path, folder: Path, steps: int = 12) -> SplatModule:
    module = SplatModule(sh_degree=1, codebooks=CODES, background="white")
    callbacks = [PhaseSchedule(warmup_end=3, prune_end=5, quantize_end=8, total=steps), LiveScene(), viewer]
    fit(module, ColmapDataModule(str(demo_scene)), callbacks, steps)
    return module


def test_splats_are_written_when_somebody_asks(demo_scene: Path, tmp_path: Path) -> None:
    viewer = Viewer({1, 5, 9})
    _fit(viewer, demo_scene, tmp_path)
    assert list(viewer.seen) == [2, 6, 10]
    state = {"iteration": 7, "of": 12, "phase": "finetune"}
    assert viewer.said[6] == {"antialiased": False, "background": "white", "live": state}
    for index, splats in viewer.seen.items():
        for name, tensor in viewer.expected[index]._asdict().items():
            assert torch.equal(getattr(splats, name).detach(), tensor), (index, name)
    assert not (viewer.folder / REQUEST).exists()


def test_an_export_checks_the_settings_of_a_subclass() -> None:
    class Often(ExportScene):
        every: Count = 1

    assert Often(every=2).every == 2
    with pytest.raises(ValueError, match="every must be at least 1, got 0"):
        Often(every=0)


def test_nobody_costs_no_file_and_changes_no_bit(demo_scene: Path, tmp_path: Path) -> None:
    quiet, watched = Viewer(set()), Viewer({1, 4, 7})
    first, second = _fit(quiet, demo_scene, tmp_path), _fit(watched, demo_scene, tmp_path)
    assert not quiet.seen
    assert len(watched.seen) == 3
    for name, tensor in first.splats.raw()._asdict().items():
        assert torch.equal(tensor, getattr(second.splats.raw(), name))


def test_showing_takes_a_small_share_of_the_time(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_callback, "SHARE", 1e-9)
    viewer = Viewer(set(range(12)))
    _fit(viewer, demo_scene, tmp_path)
    assert len(viewer.seen) == 1
