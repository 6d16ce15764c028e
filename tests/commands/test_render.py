from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from splat_scenes import random_splats

from nsvq_lightning.commands.main import main
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import load, save
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.camera_paths import read_cameras
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.report.viewer import write_cameras


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save(random_splats(300), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def _run(*arguments: str | Path) -> int:
    return main(["render", *map(str, arguments)])


def _picture(path: Path) -> np.ndarray[Any, Any]:
    return np.asarray(cv2.imread(str(path)))[:, :, ::-1]


def test_cameras_of_the_photos_see_what_they_render(
    scene: Path, demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "frames"
    assert _run(scene, "--data.root", demo_scene, "--path", "cameras", "-o", out) == 0
    cameras = load_scene(demo_scene).cameras
    assert len(list(out.iterdir())) == len(cameras)
    for index in (0, len(cameras) - 1):
        expected = (render(random_splats(300), cameras[index]).image.clamp(0, 1) * 255).numpy()
        assert np.abs(_picture(out / f"{index:05d}.png") - expected).max() <= 0.51
    said = capsys.readouterr()
    assert f"{out}: 9 frames of 96x72\n" in said.out
    assert "9/9" in said.err
    assert "earlier render" not in caplog.text
    assert _run(scene, "--data.root", demo_scene, "--frames", "5", "-o", out) == 0
    assert f"{out / '00005.png'}, and what may follow, are frames of an earlier render" in caplog.text


def test_pictures_have_the_size_of_most_photos(scene: Path, demo_scene: Path, tmp_path: Path) -> None:
    cameras = [
        replace(camera, width=50) if not k else camera for k, camera in enumerate(load_scene(demo_scene).cameras)
    ]
    write_cameras(tmp_path / "cameras.json", {f"{k}.jpg": camera for k, camera in enumerate(cameras)})
    assert _run(scene, "--path", "cameras", "-o", tmp_path / "frames") == 0
    assert _picture(tmp_path / "frames" / "00000.png").shape == (72, 96, 3)


def test_a_run_knows_its_photos(scene: Path, demo_scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    save(random_splats(50), run / "scene.nsvq")
    (run / "config.yaml").write_text(json.dumps({"data": {"class_path": "x", "init_args": {"root": str(demo_scene)}}}))
    assert _run(run, "--frames", "5", "--size", "33x21") == 0
    reader = cv2.VideoCapture(str(run / "render.mp4"))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 5
    assert (reader.get(cv2.CAP_PROP_FRAME_WIDTH), reader.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (32, 20)


def test_a_run_knows_its_cameras_without_its_photos(
    demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    save(random_splats(50), tmp_path / "scene.nsvq")
    cameras = [replace(camera, near=0.003) for camera in load_scene(demo_scene).cameras]
    write_cameras(tmp_path / "cameras.json", dict(zip("<bcdefgh&", cameras, strict=True)))
    (tmp_path / "config.yaml").write_text("data: {class_path: x, init_args: {root: gone}}")
    assert _run(tmp_path, "--path", "cameras", "-o", tmp_path / "frames") == 0
    expected = (render(load(tmp_path / "scene.nsvq"), cameras[4]).image.detach().clamp(0, 1) * 255).numpy()
    assert np.abs(_picture(tmp_path / "frames" / "00004.png") - expected).max() <= 0.51
    assert _run(tmp_path, "--path", "cameras", "--frames", "3", "-o", tmp_path / "few") == 1
    assert "cameras has frames of its own" in capsys.readouterr().err
    assert main(["view", str(tmp_path), "-o", str(tmp_path / "page.html")]) == 0
    found = read_cameras(tmp_path / "cameras.json")
    assert list(found) == list("<bcdefgh&")
    for one, other in zip(found.values(), cameras, strict=True):
        assert torch.allclose(one.viewmat, other.viewmat, atol=1e-6)
        assert one.intrinsics == pytest.approx(other.intrinsics)
        assert (one.width, one.height, one.near) == (other.width, other.height, pytest.approx(other.near))
    assert "guessed" not in capsys.readouterr().err
    (tmp_path / "cameras.json").write_text("[{}]")
    assert _run(tmp_path, "--path", "cameras") == 1
    assert "--path cameras needs cameras of photos: name their folder (--data.root)" in capsys.readouterr().err
    (warning,) = (record.message for record in caplog.records if record.levelname == "WARNING")
    assert "cameras.json is no list of cameras" in warning
    assert "name the photos with --data.root" in warning


def test_without_photos_cameras_are_guessed(tmp_path: Path) -> None:
    scene, out = tmp_path / "few.ply", tmp_path / "frames"
    save(random_splats(100), scene)  # so few that the background shows
    assert _run(scene, "--seconds", "0.25", "--fps", "12", "-o", out, "--size", "40x30", "--background", "white") == 0
    pictures = [_picture(path) for path in sorted(out.iterdir())]
    assert [picture.shape for picture in pictures] == [(30, 40, 3)] * 3
    assert all(picture.max() == 255 and picture.min() < 200 for picture in pictures)


def test_a_folder_with_a_dot_is_a_folder(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "frames.2"
    out.mkdir()
    assert _run(scene, "--seconds", "0.1", "--fps", "20", "-o", out, "--size", "40x30") == 0
    assert len([*out.iterdir()]) == 2


def test_keyframes_are_followed(scene: Path, demo_scene: Path, tmp_path: Path) -> None:
    given = load_scene(demo_scene).cameras[0]
    focal = given.intrinsics[1]
    intrinsics = torch.tensor([[focal, 0.0, 48.0], [0.0, focal, 36.0], [0.0, 0.0, 1.0]])
    camera = Camera(intrinsics, given.viewmat, given.width, given.height)
    matrix = np.linalg.inv(camera.viewmat.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
    field = 2 * np.degrees(np.arctan(36.0 / focal))
    entries = [{"camera_to_world": matrix.ravel().tolist(), "fov": field, "aspect": 4 / 3}] * 2
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"camera_path": entries, "render_width": 96, "render_height": 72, "fps": 6}))
    assert _run(scene, "--path", path, "-o", tmp_path / "out") == 0
    expected = (render(random_splats(300), camera).image.clamp(0, 1) * 255).numpy()
    for index in range(2):
        assert np.abs(_picture(tmp_path / f"out/{index:05d}.png") - expected).max() <= 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--path", "cameras"], "--path cameras needs cameras of photos"),
        (["--path", "gone.json"], "gone.json"),
        (["--path", "circle"], "--path circle: no such file; or name through, cameras or orbit"),
        (["--path", "circle", "--frames", "3"], "--path circle: no such file; or name through, cameras or orbit"),
        (["-o", "a.avi"], "a.avi: name a video (.mp4), or a folder"),
        (["--data.root", "nowhere"], "nowhere"),
    ],
)
def test_errors_are_one_line(scene: Path, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(scene, *arguments) == 1
    said = capsys.readouterr().err
    assert said.startswith("nsvq render: ")
    assert words in said
    assert said.count("\n") == 1


def test_a_checkpoint_is_told_how_it_becomes_a_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "last.ckpt").touch()
    assert _run(tmp_path / "last.ckpt") == 1
    assert "nsvq export --ckpt_path" in capsys.readouterr().err
