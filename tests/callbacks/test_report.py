"""A report watches a run, and never ends it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lightning.pytorch import LightningDataModule

from nsvq_lightning.callbacks import MetricReport
from nsvq_lightning.commands.fit import RunLogger
from nsvq_lightning.commands.main import main
from nsvq_lightning.training.module import SplatModule

HELD = ("curve.csv", "report.html", "preview.png", "views.csv", "viewer.html", "scene.ply", "view_000.png")


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of files that another program holds open, as Windows says it."""
    names: list[str] = []
    replace = os.replace

    def refuse(source: Any, target: Any) -> None:
        if Path(target).name in names:
            raise PermissionError(13, "The file is used by another process", str(target))
        replace(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    return names


def fit(scene: Path, folder: Path) -> int:
    arguments = ["fit", f"--data.root={scene}", "--data.factor=2", "--trainer.max_steps=8", "--model.sh_degree=0"]
    more = [f"--trainer.run_folder={folder}", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
    return main([*arguments, *more, "--model.codebooks=null", "--callbacks.report.every=3", "--splats=400"])


def test_files_that_are_held_open_cost_only_themselves(
    demo_scene: Path, tmp_path: Path, held: list[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("WARNING", logger="nsvq_lightning")

    def refuse(*_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(RunLogger.__mro__[1], "save", refuse)
    held += HELD
    assert fit(demo_scene, tmp_path / "run") == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["views"] == 2
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()
    assert (tmp_path / "run" / "scene.nsvq").is_file()
    assert not any(path.name in HELD or path.suffix == ".tmp" for path in (tmp_path / "run").rglob("*"))
    for name in (*HELD, "run"):
        assert f"{name} cannot be written (" in caplog.text


@pytest.mark.parametrize("name", ["last.ckpt", "scene.nsvq"])
def test_what_a_run_is_for_must_be_written(
    demo_scene: Path, tmp_path: Path, held: list[str], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    held.append(name)
    assert fit(demo_scene, tmp_path / "run") == 1
    assert name in capsys.readouterr().err


def test_a_data_module_without_a_scene_has_no_curve() -> None:
    trainer: Any = SimpleNamespace(global_step=7, fast_dev_run=False, datamodule=LightningDataModule())
    module = SplatModule()
    MetricReport().on_fit_end(trainer, module)
    assert module.history == []
