"""The trainer chooses devices that have kernels, and a strategy that keeps replicas equal."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.accelerators import CUDAAccelerator, MPSAccelerator
from lightning.pytorch.callbacks import ModelPruning, StochasticWeightAveraging, WeightAveraging
from lightning.pytorch.trainer.connectors import accelerator_connector
from lightning.pytorch.utilities import rank_zero_only
from splat_scenes import random_splats

from nsvq_lightning.callbacks import ExportScene, PhaseSchedule
from nsvq_lightning.compute import devices
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training import trainer
from nsvq_lightning.training.distributed import ViewParallelStrategy, check_strategy
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.trainer import SplatTrainer


def test_several_devices_are_view_parallel_unless_told_otherwise(tmp_path: Path) -> None:
    settings = {"accelerator": "cpu", "logger": False, "enable_checkpointing": False, "default_root_dir": tmp_path}
    assert type(SplatTrainer(devices=2, **settings).strategy).__name__ == "ViewParallelStrategy"
    assert type(SplatTrainer(devices=2, strategy="ddp", **settings).strategy).__name__ == "DDPStrategy"
    assert type(SplatTrainer(devices=1, **settings).strategy).__name__ == "SingleDeviceStrategy"


def test_a_notebook_gets_processes_that_it_can_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    monkeypatch.setattr(accelerator_connector, "_IS_INTERACTIVE", True)  # read when it was imported
    settings = {"accelerator": "cpu", "devices": 2, "enable_checkpointing": False, "default_root_dir": tmp_path}
    for asked in ("auto", "view_parallel", "view_parallel_notebook"):
        strategy = SplatTrainer(strategy=asked, **settings).strategy
        assert isinstance(strategy, ViewParallelStrategy)
        assert strategy.launcher is not None
        assert strategy.launcher.is_interactive_compatible
    # A trainer of Lightning's own is told a name that it takes, too.
    with pytest.raises(ValueError, match="view_parallel_notebook") as refusal:
        check_strategy(Trainer(strategy="ddp_notebook", **settings).strategy)
    assert "nsvq_lightning.SplatTrainer" in str(refusal.value)


@pytest.mark.parametrize("accelerator", [MPSAccelerator, CUDAAccelerator])
def test_a_gpu_without_kernels_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, demo_scene: Path, accelerator: type[Any]
) -> None:
    name = accelerator.name()
    monkeypatch.setattr(accelerator, "is_available", staticmethod(lambda: True))
    monkeypatch.setattr(accelerator, "parse_devices", staticmethod(lambda _: [0]))
    monkeypatch.setattr(accelerator, "setup_device", lambda *_: None)
    monkeypatch.setattr(devices, "_has_triton", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: accelerator is CUDAAccelerator)
    monkeypatch.setattr(trainer, "best_device", devices.best_device.__wrapped__)
    monkeypatch.setattr(accelerator_connector, "_select_auto_accelerator", lambda: name)
    settings: dict[str, Any] = {"max_steps": 2, "enable_checkpointing": False, "default_root_dir": tmp_path}
    assert SplatTrainer(**settings).strategy.root_device.type == "cpu"
    plain = Trainer(logger=False, accelerator="auto", **settings)
    assert plain.strategy.root_device.type == name
    with pytest.raises(ValueError, match=f"no kernels for {name} here"):
        plain.fit(SplatModule(), ColmapDataModule(str(demo_scene)))


def in_a_notebook(*arguments: object) -> subprocess.CompletedProcess[str]:
    script = Path(__file__).parents[1] / "support" / "notebook_fit.py"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(script.parents[2])}
    command = [sys.executable, str(script), *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.slow
def test_two_processes_of_a_notebook_hand_back_what_they_trained(demo_scene: Path, tmp_path: Path) -> None:
    two, one = (in_a_notebook(demo_scene, tmp_path, how) for how in ("two", "one"))
    assert re.search(r"^trained \w{64}$", two.stdout, re.MULTILINE), two.stderr
    assert two.stdout.splitlines()[-1] == one.stdout.splitlines()[-1]
    refused = in_a_notebook(demo_scene, tmp_path, "rendered")
    assert "restart it and fit before anything is rendered" in refused.stderr


def test_a_trainer_that_is_done_writes_nothing_of_a_new_module(demo_scene: Path, tmp_path: Path) -> None:
    """As where a cell of a notebook is run again."""
    data = ColmapDataModule(str(demo_scene), factor=2)
    callbacks = [PhaseSchedule(), ExportScene()]
    done = SplatTrainer(max_steps=4, callbacks=callbacks, run_folder=str(tmp_path), accelerator="cpu")
    done.fit(SplatModule(codebooks=None), data)
    before = (tmp_path / "scene.nsvq").read_bytes()
    with pytest.raises(ValueError, match=r"in its warmup phase, but iteration 4 .* A new module needs a new trainer"):
        done.fit(SplatModule(codebooks=None), data)
    assert (tmp_path / "scene.nsvq").read_bytes() == before


@pytest.mark.parametrize("average", [StochasticWeightAveraging(0.1), WeightAveraging()])
def test_averages_of_parameters_that_come_and_go_are_refused(
    demo_scene: Path, tmp_path: Path, average: Callback
) -> None:
    settings: dict[str, Any] = {"accelerator": "cpu", "default_root_dir": tmp_path}
    with pytest.raises(ValueError, match="Averaging averages parameters, but splats come and go"):
        SplatTrainer(max_steps=2, callbacks=[average], **settings).fit(SplatModule(), ColmapDataModule(str(demo_scene)))


def test_masks_of_parameters_are_refused_before_the_training(demo_scene: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"accelerator": "cpu", "default_root_dir": tmp_path}
    masks = ModelPruning("l1_unstructured")
    with pytest.raises(ValueError, match="ModelPruning masks parameters, but splats come and go"):
        SplatTrainer(max_steps=2, callbacks=[masks], **settings).fit(SplatModule(), ColmapDataModule(str(demo_scene)))


def test_validation_is_of_all_test_views(demo_scene: Path, tmp_path: Path) -> None:
    module = SplatModule(splats=Splats.from_tensors(*random_splats(50)))
    trainer = SplatTrainer(accelerator="cpu", default_root_dir=tmp_path, enable_progress_bar=False)
    (figures,) = trainer.validate(module, datamodule=ColmapDataModule(str(demo_scene)), verbose=False)
    assert figures["val/psnr"] > 0


def test_epochs_that_end_nothing_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    SplatTrainer(max_epochs=-1, max_steps=100, accelerator="cpu", default_root_dir=tmp_path)
    assert "max_epochs" not in caplog.text
    SplatTrainer(max_epochs=3, max_steps=100, accelerator="cpu", default_root_dir=tmp_path)
    assert "max_epochs ends nothing" in caplog.text


def test_a_job_of_slurm_writes_no_checkpoint_that_other_runs_begin_from(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("PROCID", "LOCALID", "NODEID"):
        monkeypatch.setenv(f"SLURM_{name}", "0")
    monkeypatch.setenv("SLURM_NTASKS", "1")
    environment = SplatTrainer(accelerator="cpu", default_root_dir=tmp_path)._accelerator_connector.cluster_environment
    assert environment.auto_requeue is False


def test_a_process_that_trains_alone_logs_whatever_its_launcher_calls_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    SplatTrainer(default_root_dir=tmp_path)
    assert rank_zero_only.rank == 0


def test_processes_that_each_train_the_whole_scene_are_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    SplatTrainer(accelerator="cpu", default_root_dir=tmp_path)
    assert "processes" not in caplog.text
    for name, value in {"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "3", "RANK": "1", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(name, value)
    SplatTrainer(accelerator="cpu", default_root_dir=tmp_path)
    assert "if 3 processes are started, each trains the whole scene" in caplog.text
