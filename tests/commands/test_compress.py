"""``nsvq compress``: from a file to a file."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from splat_scenes import ball, random_splats
from transforms_scenes import write_blender

from nsvq_lightning import compress, render
from nsvq_lightning.commands.main import main
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import CompressedScene, read_header, read_nsvq, write_ply
from nsvq_lightning.io.formats import read_scene, save
from nsvq_lightning.report.pictures import write_png
from nsvq_lightning.splats.splats import Splats, detached


@pytest.fixture(autouse=True)
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nsvq_lightning.compression.viewpoints.VIEWS", 4)


def test_a_file_is_compressed_and_again_to_the_same_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, output = tmp_path / "scene.ply", tmp_path / "new" / "scene.nsvq"
    scene = ball(700)
    scene.raw["sh0"][3] = np.nan
    write_ply(source, scene)
    command = ["compress", str(source), str(output), "--codebooks", "0.5k", "--steps=4"]
    assert main(command) == 0
    assert f"699 of 699 splats in {output.stat().st_size:,} bytes" in capsys.readouterr().out
    stored = read_nsvq(output)
    assert isinstance(stored, CompressedScene)
    assert stored.codebooks.keys() == {"quats", "scales", "sh0", "shN"}
    first = output.read_bytes()
    assert main(command) == 0
    assert output.read_bytes() == first
    assert main(["compress", str(output), str(tmp_path / "again.nsvq"), "--codebooks=none", "--level=paper"]) == 0
    assert read_header(tmp_path / "again.nsvq").level == "paper"
    capsys.readouterr()
    assert main(["compress", str(output), str(output), "--codebooks=none", "--level=paper"]) == 0  # in its place
    assert f", {len(first) / output.stat().st_size:.1f} times smaller than scene.nsvq" in capsys.readouterr().out


@pytest.mark.parametrize(("splats", "left"), [("25%", 100), ("150", 150), ("1", 1), ("100%", 400), ("9000", 400)])
def test_a_share_or_a_number_of_splats_is_left(splats: str, left: int, tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", ball(400, degree=0))
    paths = str(tmp_path / "scene.ply"), str(tmp_path / "x.nsvq")
    assert main(["compress", *paths, "--codebooks=none", "--steps=3", f"--splats={splats}"]) == 0
    assert len(read_nsvq(tmp_path / "x.nsvq")) == left


def test_levels_of_detail_have_a_quarter_of_the_splats_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "scene.ply", ball(400))
    index = tmp_path / "www" / "lod-meta.json"
    assert main(["compress", str(tmp_path / "scene.ply"), str(index), "--levels=3", "--steps=4"]) == 0
    assert "levels of 400, 100, 25 splats" in capsys.readouterr().out
    assert json.loads(index.read_text())["counts"] == [400, 100, 25]
    assert len(read_scene(index)) == 400


def test_photos_are_trained_on(tmp_path: Path, demo_scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, output = tmp_path / "scene.nsvq", tmp_path / "out.nsvq"
    photos = load_scene(demo_scene)
    splats = Splats.from_points(photos.points, photos.colors, opacity=0.9)
    command = ["compress", str(source), str(output), "--codebooks=0.5k", "--steps=3", f"--data.root={demo_scene}"]
    save(splats, source)
    with patch("nsvq_lightning.data.scene.load_scene", wraps=load_scene) as loading:
        assert main(command) == 0
    assert loading.call_count == 1
    assert len(read_nsvq(output)) == len(photos.points)
    assert f"fitted to the photos of {demo_scene}" in capsys.readouterr().out
    save(detached(splats)._replace(sh0=-4 * splats.sh0), source)
    assert main(command) == 1
    assert f"photos of {demo_scene} are not of this scene: it has " in capsys.readouterr().err


@pytest.mark.parametrize(("aim", "value"), [("--target-bytes", "9000"), ("--max-error", "0.2")])
def test_an_aim_is_met(aim: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "scene.ply", ball(400))
    output = tmp_path / "x.nsvq"
    assert main(["compress", str(tmp_path / "scene.ply"), str(output), "--steps=2", aim, value]) == 0
    if aim == "--target-bytes":
        assert output.stat().st_size <= 9000
    else:
        assert float(capsys.readouterr().out.rpartition("error ")[2].split()[0]) <= 0.2


@pytest.mark.parametrize("aim", ["--codebooks=0.5k", "--max-error=0.2"])
def test_ctrl_c_keeps_what_was_reached(
    aim: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from nsvq_lightning.training.module import SplatModule

    interruptions = []

    def interrupted(module: SplatModule, *_: object) -> None:
        if module.global_step == 5:
            interruptions.append(module)
            raise KeyboardInterrupt

    monkeypatch.setattr(SplatModule, "on_train_batch_end", interrupted, raising=False)
    write_ply(tmp_path / "scene.ply", ball(2000))
    output = tmp_path / "x.nsvq"
    assert main(["compress", str(tmp_path / "scene.ply"), str(output), aim, "--steps=50"]) == 130
    assert len(read_nsvq(output)) == 2000
    assert len(interruptions) == 1  # no other training begins
    assert "ended the training early" in capsys.readouterr().err


def test_ctrl_c_ends_all_levels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from nsvq_lightning.training.module import SplatModule

    ends: dict[int, int] = {}

    def interrupted(module: SplatModule, *_: object) -> None:
        ends[len(ends) if module.global_step == 1 else len(ends) - 1] = module.global_step
        if module.global_step == 30:
            raise KeyboardInterrupt

    monkeypatch.setattr(SplatModule, "on_train_batch_end", interrupted, raising=False)
    write_ply(tmp_path / "scene.ply", ball(2000))
    output = tmp_path / "x/lod-meta.json"
    assert main(["compress", str(tmp_path / "scene.ply"), str(output), "--levels=3", "--steps=50"]) == 130
    assert list(ends.values()) == [30, 4]  # the finest level needs no training
    assert len(read_scene(output)) == 2000


@pytest.mark.parametrize("parts", [1, 4])
def test_ctrl_c_before_the_codebooks_of_a_later_training_keeps_the_earlier_ones(
    parts: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from nsvq_lightning.callbacks import CodebookInit
    from nsvq_lightning.compression import compressor

    begin, begun = CodebookInit.before_step, []

    def interrupted(callback: CodebookInit, trainer: Any, module: Any, *args: Any) -> None:
        begun.append(trainer)
        if len(set(begun)) == 2 and begun.count(trainer) == 1:
            raise KeyboardInterrupt
        begin(callback, trainer, module, *args)

    monkeypatch.setattr(CodebookInit, "before_step", interrupted)
    monkeypatch.setattr(compressor, "AT_ONCE", 2000 // parts)
    write_ply(tmp_path / "scene.ply", ball(2000))
    output = tmp_path / "x.nsvq"
    aim = "--codebooks=0.5k" if parts > 1 else "--target-bytes=24000"
    assert main(["compress", str(tmp_path / "scene.ply"), str(output), aim, "--steps=50"]) == 130
    assert len(read_nsvq(output)) == 2000
    assert len(set(begun)) == max(3, parts + 1)  # the second one again, in a few steps
    assert "ended the training early" in capsys.readouterr().err


def test_ctrl_c_before_there_are_codebooks_is_no_other_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from nsvq_lightning.callbacks import CodebookInit

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(CodebookInit, "before_step", interrupted)
    write_ply(tmp_path / "scene.ply", ball(500))
    output = tmp_path / "x.nsvq"
    output.write_bytes(b"what was there")
    assert main(["compress", str(tmp_path / "scene.ply"), str(output), "--codebooks=0.5k", "--steps=50"]) == 130
    assert output.read_bytes() == b"what was there"
    assert "codebook" not in capsys.readouterr().err


def test_a_scene_that_shows_nothing_is_told_before_it_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clear = ball(300)
    clear.opacities[:] = -20
    write_ply(tmp_path / "scene.ply", clear)
    command = ["compress", str(tmp_path / "scene.ply"), str(tmp_path / "x.nsvq"), "--codebooks=0.5k", "--steps=4"]
    with patch("nsvq_lightning.compression.compressor.Compressor.best") as trained:
        assert main(command) == 1
    assert not trained.called
    assert "all 4 pictures of the scene are empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "message"),
    [("missing.ply", "missing.ply"), ("empty.ply", "no finite splat"), ("scene.ply", "100 bytes leave room for 0")],
)
def test_bad_files_and_aims_are_one_line_and_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, message: str
) -> None:
    write_ply(tmp_path / "empty.ply", ball(0))
    write_ply(tmp_path / "scene.ply", ball(300))
    assert main(["compress", str(tmp_path / name), str(tmp_path / "x.nsvq"), "--target-bytes=100"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("nsvq compress: ")
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.ply", "b.ply"], "is a .nsvq file or lod-meta.json"),
        (["a.ply", "b.nsvq", "--levels=2"], "--levels is for lod-meta.json"),
        (["a.ply", "lod-meta.json", "--codebooks=4k"], "no codebooks and no limits"),
        (["a.ply", "lod-meta.json", "--level=paper"], "and one --level"),
        (["a.ply", "b.nsvq", "--max-error", "0"], "must be above 0"),
        (["a.ply", "b.nsvq", "--steps=0"], "--steps: must be above 0, got 0"),
        (["a.ply", "b.nsvq", "--splats=0"], "expected a number of splats, or a share such as 25%, got '0'"),
        (["a.ply", "b.nsvq", "--splats=130%"], "got '130%'"),
        (["a.ply", "b.nsvq", "--max-error", "1", "--target-bytes", "5"], "not allowed with"),
    ],
)
def test_wrong_options_end_with_status_2(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["compress", *arguments])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_an_output_that_cannot_be_written_is_told_before_the_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_ply(tmp_path / "scene.ply", ball(300))
    (tmp_path / "folder.nsvq").mkdir()
    monkeypatch.setattr("nsvq_lightning.compression.compressor.Compressor", None)
    assert main(["compress", str(tmp_path / "scene.ply"), str(tmp_path / "scene.ply" / "x.nsvq")]) == 1
    assert "scene.ply: File exists" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        main(["compress", str(tmp_path / "scene.ply"), str(tmp_path / "folder.nsvq")])
    assert stop.value.code == 2
    assert "is a folder: name a file" in capsys.readouterr().err


def test_levels_end_where_they_would_be_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "scene.ply", ball(20, degree=0))
    paths = str(tmp_path / "scene.ply"), str(tmp_path / "lod" / "lod-meta.json")
    assert main(["compress", *paths, "--levels=8", "--steps=4"]) == 0
    assert "levels of 20, 5, 1 splats" in capsys.readouterr().out


def test_what_was_trained_on_white_is_compressed_and_shown_on_white(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As scenes of NeRF-synthetic are, whose photos are transparent around the object."""
    root = write_blender(demo_scene, tmp_path / "lego")
    photos = load_scene(root)
    splats = random_splats(400)

    def decibels(before: str, after: str) -> float:
        found = re.search(rf"{before}([\d.]+|inf) dB {after}", capsys.readouterr().out)
        assert found is not None
        return float(found[1])

    for index, source in enumerate(photos.images.sources):
        image = render(splats, photos.cameras[index], background=torch.ones(3)).image
        write_png(source.path, image)
    plain, small, page = (tmp_path / name for name in ("scene.ply", "small.nsvq", "page.html"))
    save(splats, plain)
    there = ["--data.root", str(root)]
    assert main(["compress", str(plain), str(small), "--codebooks", "0.5k", "--steps", "8", *there]) == 0
    assert read_header(small).config["background"] == "white"
    assert decibels(r"\(", "against the original") > 20
    assert main(["convert", str(plain), str(tmp_path / "x.ply"), "--floaters", *there]) == 0
    assert decibels("test photos at ", "before") > 40
    for scene, options in ((small, []), (plain, there)):
        assert main(["view", str(scene), "-o", str(page), *options]) == 0
        assert '"background":[1.0,1.0,1.0]' in page.read_text(encoding="utf-8")
    pictures = [render(splats, camera, background=torch.ones(3)).image.detach() for camera in photos.cameras]
    again = compress(read_scene(plain), photos.cameras, pictures, codebooks="0.5k", steps=8, background="white")
    assert again.background == (1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="background must be black or white, got 'grey'"):
        compress(splats, background="grey")
    assert main(["split", str(root), str(tmp_path / "parts"), "--blocks", "1"]) == 0
    assert "--model.background=white" in capsys.readouterr().out
