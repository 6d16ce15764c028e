"""``nsvq split`` and ``nsvq merge``."""

from __future__ import annotations

import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from nsvq_lightning.commands import split
from nsvq_lightning.commands.main import main
from nsvq_lightning.data import blocks
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import CompressedScene, read_scene, save
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.splats.splats import Splats


def test_parts_are_trained_by_fit_and_merged(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = tmp_path / "parts"
    short = ["--config", "demo", "--trainer.max_steps=16", "--data.factor=4"]
    assert main(["split", str(demo_scene), str(parts), "--blocks", "2", *short]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert main(["merge", str(parts), "-o", str(tmp_path / "x.nsvq")]) == 1
    assert re.search(r"2 of 2 parts are not trained yet, first .*1.run.scene\.nsvq: run", capsys.readouterr().err)
    for line in lines:
        assert main(shlex.split(line)[1:]) == 0
    capsys.readouterr()
    assert main(["merge", str(parts), "-o", str(tmp_path / "x.nsvq")]) == 0
    said = capsys.readouterr().out
    kept = [int(n.replace(",", "")) for n in re.findall(r"([\d,]+) of [\d,]+ splats are in its core", said)]
    assert len(kept) == 2
    assert sum(kept) == len(read_scene(tmp_path / "x.nsvq"))
    assert re.search(r"test photos of .*: \d+\.\d\d dB", said)
    assert main(["split", str(demo_scene), str(parts)]) == 1
    assert "exists: remove it, or give another folder" in capsys.readouterr().err


def test_options_of_the_data_hold_for_the_whole(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Photos are halved once, of another folder, one in four to test on; so are those that the merged scene meets."""
    shutil.copytree(demo_scene, tmp_path / "scene")
    (tmp_path / "scene" / "images").rename(tmp_path / "scene" / "photos")
    parts = tmp_path / "parts"
    given = ["--data.factor=2", "--data.images_folder=photos", "--data.test_every=4", "--data.masks=null"]
    assert main(["split", str(tmp_path / "scene"), str(parts), "--blocks", "2", *given]) == 0
    lines = capsys.readouterr().out.splitlines()
    whole = load_scene(tmp_path / "scene", 2, test_every=4, images_folder="photos")
    for line, folder in zip(lines, (parts / "1", parts / "2"), strict=True):
        words = [word.removeprefix("--").partition("=") for word in shlex.split(line)[2:]]
        data = {name: value for name, _, value in words}  # the last one counts
        assert (data["data.factor"], data["data.images_folder"], data["data.masks"]) == ("1", "images", "masks")
        part = load_scene(folder, 1)
        assert sum(image.mask is not None for image in part.images.sources) == len(part)
        assert len(part.test) <= len(whole.test) == 3
        assert max(camera.width for camera in part.cameras) <= whole.cameras[0].width
    splats = Splats.from_points(whole.points, whole.colors, 0)
    for number in "12":
        (parts / number / "run").mkdir()
        save(splats, parts / number / "run" / "scene.nsvq")
    assert main(["merge", str(parts), "-o", str(tmp_path / "x.ply")]) == 0
    shutil.rmtree(parts / "2")
    assert main(["merge", str(parts), "-o", str(tmp_path / "y.ply")]) == 1
    assert "has 1 of 2 parts: copy the others there, too" in capsys.readouterr().err
    assert not (tmp_path / "y.ply").exists()


def test_options_that_fit_does_not_have_are_refused_at_once(demo_scene: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        main(["split", str(demo_scene), str(tmp_path / "parts"), "--data.factr=2"])
    assert not (tmp_path / "parts").exists()


def test_the_whole_is_what_lies_in_the_cores(demo_scene: Path, tmp_path: Path) -> None:
    """Each part holds all points; the merged scene has each once."""
    assert main(["split", str(demo_scene), str(tmp_path / "parts"), "--blocks", "3"]) == 0
    scene = load_scene(demo_scene)
    splats = Splats.from_points(scene.points, scene.colors, 0)
    for number in "123":
        (tmp_path / "parts" / number / "run").mkdir()
        save(splats, tmp_path / "parts" / number / "run" / "scene.nsvq")
    assert main(["merge", str(tmp_path / "parts"), "-o", str(tmp_path / "x.ply")]) == 0
    means = read_scene(tmp_path / "parts" / "1" / "run" / "scene.nsvq").means
    merged = read_scene(tmp_path / "x.ply").means
    assert sorted(map(tuple, merged.tolist())) == sorted(map(tuple, np.asarray(means).tolist()))
    # Those far from 0 by their own size are relative to an origin.
    for number, origin in zip("123", ((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -1.0, 5.0)), strict=True):
        path = tmp_path / "parts" / number / "run" / "scene.nsvq"
        save(CompressedScene.from_splats(splats).relative_to(origin), path, Storage("paper"))
    assert main(["merge", str(tmp_path / "parts"), "-o", str(tmp_path / "x.ply")]) == 0
    merged, means = read_scene(tmp_path / "x.ply").means, splats.means.detach().numpy()
    assert len(merged) == len(means)
    assert cKDTree(merged).query(means)[0].max() < 1e-5


@pytest.mark.skipif(shutil.which("xargs") is None, reason="this system has no xargs")
@pytest.mark.parametrize("page", ["commands/split.py", "large_scenes.md", "sweep.md"])
def test_documented_lines_keep_paths_with_spaces_and_quotes(tmp_path: Path, page: str) -> None:
    docs = Path(__file__).parents[2] / "docs" / page
    text = inspect.getdoc(split) if page.endswith(".py") else docs.read_text(encoding="utf-8")
    (line,) = re.findall(r"(tr .*xargs .* sh -c)", str(text))
    said = tmp_path / "said"
    (tmp_path / "nsvq").write_text(f'#!/bin/sh\nfor each in "$@"; do echo "$each" >> {said}; done\n')
    (tmp_path / "nsvq").chmod(0o755)
    words = ["fit", "--data.root=/my scenes/it's a room/1", '--splats="9"']
    commands = tmp_path / "commands.txt"
    commands.write_text(f"{shlex.join(['nsvq', *words])}\n")
    shell = line.replace("commands.txt", str(commands)) if "<" in line else f"cat {commands} | {line}"
    environment = os.environ | {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run(["sh", "-c", shell], env=environment, check=True, timeout=60)
    assert said.read_text().splitlines() == words


def test_a_damaged_photo_is_left_out_of_all_parts(demo_scene: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(demo_scene, scene)
    photos = sorted((scene / "images").iterdir())
    photos[3].write_bytes(photos[3].read_bytes()[:200])
    assert main(["split", str(scene), str(tmp_path / "parts"), "--blocks", "2"]) == 0
    for part in (tmp_path / "parts").iterdir():
        frames = json.loads((part / "transforms.json").read_text())["frames"]
        assert len(frames) > 5
        assert "images/00003.png" not in [frame["file_path"] for frame in frames]  # named by their number


def test_a_split_that_fails_leaves_nothing(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(blocks, "MIN_SHOWN", 1.1)  # no part is in any photo
    assert main(["split", str(demo_scene), str(tmp_path / "parts"), "--blocks", "2"]) == 1
    assert "ask for fewer parts" in capsys.readouterr().err
    assert not (tmp_path / "parts").exists()


def test_a_folder_without_parts_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["merge", str(tmp_path), "-o", str(tmp_path / "x.nsvq")]) == 1
    assert "has no parts: make them with 'nsvq split'" in capsys.readouterr().err
