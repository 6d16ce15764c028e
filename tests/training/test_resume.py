"""Checkpoints that cannot be used: refused by name, with the reason, and without running what they hold."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.quantize import NSVQ, StraightThrough
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.resume import (
    PlainCheckpointIO,
    changes,
    check_continuation,
    check_scene,
    check_settings,
    read_checkpoint,
    scene_record,
)
from nsvq_lightning.training.schedule import Schedule

SCENE = {"splats.means": torch.arange(300.0).view(100, 3), "_extra_state": torch.zeros(4)}


def begins(path: Path) -> str:
    """What an error about a file matches."""
    return f"^{re.escape(str(path))}:"


def write(path: Path, state: dict[str, Tensor] = SCENE, **more: Any) -> bytes:
    """Write a checkpoint; returns its bytes."""
    own = {"history": [], "schedule": {}, "quantizer_settings": {}}
    torch.save({"state_dict": state, "global_step": 7, "pytorch-lightning_version": "2.6.6", **own, **more}, path)
    return path.read_bytes()


class Harmful:
    """Leaves a folder behind when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self.mark = str(mark)

    def __reduce__(self) -> Any:
        return os.mkdir, (self.mark,)


def test_a_whole_checkpoint_is_read(tmp_path: Path) -> None:
    write(tmp_path / "a.ckpt")
    for read in (read_checkpoint, PlainCheckpointIO().load_checkpoint):
        found = read(tmp_path / "a.ckpt")
        assert found["global_step"] == 7
        assert torch.equal(found["state_dict"]["splats.means"], SCENE["splats.means"])


@pytest.mark.parametrize("part", [0.0, 0.02, 0.5, 0.9, 0.999])
def test_truncated_checkpoints_are_refused(part: float, tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    whole = write(path)
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(FormatError, match=rf"{begins(path)} truncated, .*; pass a checkpoint that nsvq fit"):
        read_checkpoint(path)


def test_a_single_changed_number_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    whole = bytearray(write(path))
    whole[whole.index(SCENE["splats.means"][40:60].numpy().tobytes())] ^= 1
    path.write_bytes(whole)
    torch.load(path, weights_only=True)  # torch does not see it
    with pytest.raises(FormatError, match=rf"{begins(path)} damaged, its part \S+ is not what was written"):
        read_checkpoint(path)


def test_code_is_not_run(tmp_path: Path) -> None:
    path, mark = tmp_path / "a.ckpt", tmp_path / "mark"
    write(path, extra=Harmful(mark))
    for read in (read_checkpoint, lambda p: PlainCheckpointIO().load_checkpoint(p, weights_only=False)):
        with pytest.raises(FormatError, match=rf"{begins(path)} refused, it holds an object of posix.mkdir"):
            read(path)
    assert not mark.exists()
    torch.load(path, weights_only=False)  # it would have been
    assert mark.is_dir()


NAMED = "nsvq_lightning.quantize.NSVQ"


@pytest.mark.parametrize(
    "settings",
    [
        {"quantizer": "evilmod.f"},
        {"quantizer": {"class_path": "evilmod.f"}},
        {"quantizer.class_path": "evilmod.f"},
        {"quantizer": '{"class_path": "evilmod.f"}'},
        {"quantizer": {"class_path": NAMED, "init_args": {"start": ["evilmod.f"]}}},
        {"quantizer": "evil.yaml"},
        {"quantizer": "evil"},
        {"quantizer": "os.system"},
        {"quantizer": "torch.os.system"},
        {"rates": {"class_path": "evilmod.f"}},
        {"_class_path": "evilmod.f"},
        {"_instantiator": "evilmod.f"},
    ],
    ids=str,
)
def test_a_checkpoint_imports_nothing(
    settings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "evilmod.py").write_text("open('mark', 'w')\n")
    for name in ("evil", "evil.yaml"):
        (tmp_path / name).write_text("class_path: evilmod.f\n")
    write(
        tmp_path / "a.ckpt", hyper_parameters={"_instantiator": "lightning.pytorch.cli.instantiate_module"} | settings
    )
    with pytest.raises(FormatError, match=r"^a.ckpt: refused, it"):
        SplatModule.load_from_checkpoint("a.ckpt")
    assert not (tmp_path / "mark").exists()


def test_what_the_user_has_named_is_loaded() -> None:
    for settings in ({"quantizer": f"{__name__}.Harmful"}, {"init_from": "old.ply", "codebooks": "0.5k"}):
        check_settings("a.ckpt", settings)
    with pytest.raises(FormatError, match=r"its model.quantizer.table is a/b.txt, .*: --model.quantizer.table=a/b.txt"):
        check_settings("a.ckpt", {"quantizer": {"class_path": NAMED, "init_args": {"table": "a/b.txt"}}})
    check_settings("a.ckpt", {"quantizer": {"class_path": NAMED, "init_args": {"table": "a/b.txt"}}}, ["a/b.txt"])


def test_a_scene_is_the_same_with_other_photos_in_another_place(
    demo_scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    checkpoint = {"scene": scene_record(load_scene(demo_scene))}
    assert checkpoint["scene"]["folder"] == demo_scene.name
    moved = shutil.copytree(demo_scene, tmp_path / "moved")
    (moved / "masks").mkdir()
    check_scene(checkpoint, load_scene(moved))
    assert "other photos" not in caplog.text
    fewer = load_scene(moved, factor=2)
    for other in (
        fewer,
        load_scene(moved, test_every=3),
        replace(fewer, names=fewer.names[2:], cameras=fewer.cameras[2:], test=()),
    ):
        caplog.clear()
        check_scene(checkpoint, other)
        assert "moved has other photos, sizes or test views than the run so far" in caplog.text
    for other in (
        replace(fewer, names=fewer.names[::-1]),
        replace(fewer, names=tuple(f"cam/{name}" for name in fewer.names)),
    ):
        with pytest.raises(
            ValueError, match=r"was trained on scene with 9 views, and [01] of the 9 views of .*moved are"
        ):
            check_scene(checkpoint, other)


def test_what_is_no_checkpoint_of_this_package_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    write(path, nn.Linear(2, 3).state_dict())
    with pytest.raises(FormatError, match=rf"{begins(path)} a checkpoint of another model, which has weight, bias but"):
        read_checkpoint(path)
    torch.save({"state_dict": SCENE, "pytorch-lightning_version": "2.6.6", "history": []}, path)
    with pytest.raises(FormatError, match=rf"{begins(path)} a checkpoint of another version, without quantizer_sett"):
        read_checkpoint(path)
    torch.save({"weights": torch.ones(2)}, path)
    with pytest.raises(FormatError, match=rf"{begins(path)} not a checkpoint of Lightning"):
        read_checkpoint(path)
    path.write_text("no archive at all")
    with pytest.raises(FormatError, match=rf"{begins(path)} truncated, or not a checkpoint"):
        read_checkpoint(path)
    with pytest.raises(FormatError, match=rf"{begins(tmp_path)} damaged, or not a checkpoint \(.*[Dd]irectory"):
        read_checkpoint(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"none\.ckpt: no such checkpoint; pass a checkpoint"):
        read_checkpoint(tmp_path / "none.ckpt")


def test_another_schedule_is_told_of() -> None:
    module = SplatModule(sh_degree=1)
    module.schedule = Schedule(min_reset_interval=11, saved=3)
    stored: dict[str, Any] = {"state_dict": module.state_dict()}
    module.on_save_checkpoint(stored)
    assert not changes(stored, replace(module.schedule, saved=0), {})
    stored["hyper_parameters"] = {"antialiased": True, "sh_degree": 1, "init_from": "a.ply"}
    others = changes(
        stored, Schedule(total=7, min_reset_interval=12), {"antialiased": False, "sh_degree": 1, "init_from": "/a.ply"}
    )
    assert others.split() == [
        "--trainer.max_steps=45000", "--callbacks.phases.min_reset_interval=11", "--model.antialiased=True",
    ]  # fmt: skip


def test_the_options_that_are_told_can_be_pasted() -> None:
    module = SplatModule(sh_degree=1)
    stored: dict[str, Any] = {"state_dict": module.state_dict()}
    module.on_save_checkpoint(stored)
    stored["hyper_parameters"] = {"codebooks": None, "rates": {"means": 1e-4, "sh0": 2.0}}
    told = changes(stored, module.schedule, {"codebooks": "4k", "rates": {}})
    assert shlex.split(told) == ["--model.codebooks=null", "--model.rates={'means': 0.0001, 'sh0': 2.0}"]


def check(checkpoint: dict[str, Any], module: SplatModule) -> None:
    check_continuation(checkpoint, module.state_dict(), module.quantizer_settings)


def quantizing(**settings: Any) -> SplatModule:
    module = SplatModule(**{"sh_degree": 0, "quantizer": NSVQ, "codebooks": {"scales": 12, "sh0": 8}, **settings})
    return module


def saved(module: SplatModule) -> dict[str, Any]:
    """What a checkpoint holds of a module."""
    checkpoint: dict[str, Any] = {"state_dict": module.state_dict(), "optimizer_states": [{}]}
    module.on_save_checkpoint(checkpoint)
    return checkpoint


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"codebooks": {"scales": 24, "sh0": 8}}, "this one would with NSVQ (scales: 24, sh0: 8)"),
        ({"codebooks": {"scales": 12}}, "this one would with NSVQ (scales: 12)"),
        ({"codebooks": None}, "this one would with no codebooks"),
        ({"quantizer": StraightThrough}, "this one would with StraightThrough (scales: 12, sh0: 8)"),
    ],
)
def test_a_run_cannot_go_on_with_other_quantizers(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as refusal:
        check(saved(quantizing()), quantizing(**settings))
    assert "is of a run that quantizes with NSVQ (scales: 12, sh0: 8)" in str(refusal.value)
    assert "pass the --model.quantizer and --model.codebooks that it was trained with" in str(refusal.value)
    with pytest.raises(ValueError, match=r"quantizes with no codebooks, and this one would with NSVQ"):
        check(saved(quantizing(codebooks=None)), quantizing())


def test_the_same_quantizers_go_on_whatever_they_are_called() -> None:
    module = quantizing()
    scales = module.codebooks["scales"]
    assert isinstance(scales, NSVQ)
    scales.fit(torch.arange(9.0).reshape(3, 3))  # fewer rows than codes
    assert scales.num_codes == 3
    for same in (quantizing(), quantizing(quantizer=partial(NSVQ, kmeans_steps=3))):
        check(saved(module), same)
    paper = quantizing(codebooks="0.5k")  # without SH coefficients there are three codebooks
    check(saved(paper), quantizing(codebooks={"scales": 512, "quats": 512, "sh0": 128, "shN": 7}))


def test_checkpoints_are_written_where_they_belong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder of temporary files may be small, or on another disk."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    path = tmp_path / "new" / "a.ckpt"
    PlainCheckpointIO().save_checkpoint({"a": torch.ones(3)}, path)
    assert torch.equal(torch.load(path)["a"], torch.ones(3))
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(
        ValueError, match=r"a callback keeps an object of numpy\..* which no run could read: make it a tensor"
    ):
        PlainCheckpointIO().save_checkpoint({"callbacks": {"Own": {"seen": np.zeros(3)}}}, path)
    assert torch.equal(torch.load(path)["a"], torch.ones(3))
