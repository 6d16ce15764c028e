from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest
from small_demo import write_small_demo

from nsvq_lightning.commands.main import main
from nsvq_lightning.data import reconstruct
from nsvq_lightning.data.scene import load_scene


def _noise(path: Path, seed: int = 0) -> None:
    pixels = np.random.default_rng(seed).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    PIL.Image.fromarray(pixels).save(path)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def _fails(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["prepare", *map(str, arguments)]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith("nsvq prepare: ")
    return said[-1]


def test_sources_that_are_none_are_refused(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene"
    assert "no such file or folder" in _fails(capsys, tmp_path / "gone", scene)
    (tmp_path / "a.txt").write_text("")
    assert "neither a folder of photos nor a video" in _fails(capsys, tmp_path / "a.txt", scene)
    assert "no photos; it must hold files" in _fails(capsys, photos, scene)
    (tmp_path / "a.mp4").write_bytes(b"x")
    assert "no frame can be read" in _fails(capsys, tmp_path / "a.mp4", tmp_path / "other")
    _noise(photos / "a.png")
    assert "1 pictures are too few" in _fails(capsys, photos, scene)


def test_folders_of_others_are_left_alone(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "mine.txt").write_text("precious")
    _noise(photos / "a.png")
    assert "not empty and was not made by this command" in _fails(capsys, photos, scene)
    assert "not empty and was not made by this command" in _fails(capsys, photos, scene, "--again")
    assert [path.name for path in scene.iterdir()] == ["mine.txt"]
    (scene / "mine.txt").rename(scene / ".DS_Store")  # the Finder's
    (scene / "._masks").write_bytes(b"")  # where a disk has no room for what macOS notes of masks/
    (scene / "masks").mkdir()
    assert "1 pictures are too few" in _fails(capsys, photos, scene)


def test_other_options_need_a_new_beginning(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene"
    _noise(photos / "a.png")
    _fails(capsys, photos, scene)
    assert "was prepared from" in _fails(capsys, photos, scene, "--max-size", "800")
    (scene / "mine.txt").write_text("precious")
    assert "too few" in _fails(capsys, photos, scene, "--max-size", "800", "--again")
    assert json.loads((scene / "prepare.json").read_text())["max_size"] == 800
    assert (scene / "mine.txt").exists()


def test_another_video_of_the_same_name_needs_a_new_beginning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, scene = tmp_path / "walk.mp4", tmp_path / "scene"
    video.write_bytes(b"x")
    assert "no frame can be read" in _fails(capsys, video, scene)
    video.write_bytes(b"another")
    assert "--again begins anew" in _fails(capsys, video, scene)
    assert "no frame can be read" in _fails(capsys, video, scene, "--again")


def test_photos_may_lie_in_their_place(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    _noise(scene / "images" / "a.png")
    before = (scene / "images" / "a.png").read_bytes()
    for more in ([], ["--again"]):
        assert "too few" in _fails(capsys, scene / "images", scene, *more)
        assert (scene / "images" / "a.png").read_bytes() == before
        _noise(photos / "a.png", 1)  # of another photo
        assert "holds photos themselves, no copies" in _fails(capsys, photos, scene, *more)
        assert (scene / "images" / "a.png").read_bytes() == before


def test_photos_of_nothing_in_common_are_told(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in range(4):
        _noise(photos / f"{seed}.png", seed)
    said = _fails(capsys, photos, tmp_path / "scene")
    assert "no two photos show enough of the same things" in said
    assert "Photos with a partner: 0 of 4" in said
    (photos / "3.png").unlink()
    said = _fails(capsys, photos, tmp_path / "scene")
    assert "3 photos are hardly enough" in said
    assert "of the same things" not in said
    assert "Photos with a partner: 0 of 3" in said


def test_folders_with_cameras_are_told_from_photos(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(2):
        _noise(photos / f"{seed}.png", seed)
    (photos / "transforms.json").write_text("{}")
    assert main(["prepare", str(photos), str(tmp_path / "scene")]) == 1
    assert f"{photos} has cameras already: nsvq fit --data.root {photos} uses them" in "".join(capsys.readouterr())


def test_photos_that_cannot_be_read_are_told(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a.HEIC", "b.nef", "c.jxl"):
        (photos / name).write_bytes(b"x")
    said = _fails(capsys, photos, tmp_path / "scene")
    assert "0 pictures are too few, a scene takes 50 to 300; left out: a.HEIC, b.nef, c.jxl: cannot be read: " in said
    assert "convert to JPEG" in said
    for seed in range(4):
        _noise(photos / f"{seed}.png", seed)
    assert main(["prepare", str(photos), str(tmp_path / "scene")]) == 1
    assert "left out: a.HEIC, b.nef, c.jxl: cannot be read" in capsys.readouterr().out


def test_photos_are_added_and_leave_by_the_same_command(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, found = tmp_path / "scene", []

    def fake(scene: Path, names: list[str], *_: object) -> reconstruct.Verdict:
        (scene / "database.db").touch()
        (scene / "photos.json").write_text(json.dumps(dict.fromkeys(names, "")))
        if "odd.png" in names:
            raise ValueError("no place")
        found.append(list(names))
        (scene / "sparse").mkdir(exist_ok=True)
        shutil.copy(scene / "photos.json", scene / "sparse")
        return reconstruct.Verdict(tuple(names), {}, 1, 0.1, 2.0, 1)

    monkeypatch.setattr(reconstruct, "reconstruct", fake)
    monkeypatch.setattr("nsvq_lightning.commands.doctor.check_folder", lambda _: iter(()))

    def copies() -> list[str]:
        return sorted(path.name for path in (scene / "images").iterdir())

    for name in ("a", "b", "c"):
        _noise(photos / f"{name}.png")
    assert main(["prepare", str(photos), str(scene)]) == 0
    (scene / "images/mine.png").write_bytes(b"of the user")
    (photos / "c.png").unlink()
    _noise(photos / "odd.png")
    assert "no place" in _fails(capsys, photos, scene)
    assert copies() == ["a.png", "b.png", "c.png", "mine.png", "odd.png"]  # what the scene of before needs, too
    assert "no place" in _fails(capsys, photos, scene, "--again", "--max-size", "800")
    assert (scene / "sparse").is_dir()
    assert "c.png" in copies()
    (photos / "odd.png").rename(photos / "d.png")
    assert main(["prepare", str(photos), str(scene), "--max-size", "800"]) == 0
    assert found == [["a.png", "b.png", "c.png"], ["a.png", "b.png", "d.png"]]
    assert copies() == ["a.png", "b.png", "d.png", "mine.png"]
    said = capsys.readouterr().out
    assert "database.db (0 MB) saves time when photos are added, and may be deleted" in said


def test_a_model_whose_photos_are_all_in_a_larger_one_is_left_out() -> None:
    def model(*names: str) -> SimpleNamespace:
        images = dict(enumerate(SimpleNamespace(name=name, has_pose=True) for name in names))
        return SimpleNamespace(images=images, num_reg_images=lambda: len(names))

    part, whole, other = model("b", "c"), model("a", "b", "c", "d"), model("d", "e")
    assert reconstruct._adding([part, other, whole]) == [whole, other]
    assert reconstruct._adding([]) == []


@pytest.mark.slow
def test_cameras_are_found_and_a_killed_run_continues(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = write_small_demo(tmp_path / "made", views=40, width=480, height=360, points=500)
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    photos.mkdir()
    for index in range(12):
        shutil.copy(made / f"images/view_{index:03d}.png", photos)
    _noise(photos / "zz_odd.png")
    import pycolmap

    whole = pycolmap.incremental_mapping

    def killed(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pycolmap, "incremental_mapping", killed)
    assert main(["prepare", str(photos), str(scene)]) == 130
    first = (scene / "database.db").stat().st_size
    monkeypatch.setattr(pycolmap, "incremental_mapping", whole)
    capsys.readouterr()
    assert main(["prepare", str(photos), str(scene)]) == 0
    said = capsys.readouterr()
    assert (scene / "database.db").stat().st_size <= 1.1 * first
    assert "12 of 13 photos have found their place" in said.out
    assert "zz_odd.png: overlaps no other" in said.out
    assert f"next: nsvq fit --data.root {scene}" in said.out
    true, found = load_scene(made), load_scene(scene)
    assert found.names == true.names[:12]
    here, there = (np.array([camera.position.numpy() for camera in each.cameras[:12]]) for each in (true, found))
    sides = [np.linalg.norm(each[:, None] - each[None], axis=2) for each in (here, there)]
    scale = np.median(sides[0][sides[1] > 0] / sides[1][sides[1] > 0])
    assert np.abs(sides[0] - scale * sides[1]).max() < 0.02 * sides[0].max()
    assert main(["prepare", str(photos), str(scene)]) == 0
    assert "12 of 13 photos" in capsys.readouterr().out
    shutil.copy(made / "images/view_012.png", photos)
    (photos / "zz_odd.png").unlink()
    assert main(["prepare", str(photos), str(scene)]) == 0
    assert "13 of 13 photos have found their place" in capsys.readouterr().out
    assert load_scene(scene).names == true.names[:13]
    assert not (scene / "images/zz_odd.png").exists()
