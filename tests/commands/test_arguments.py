from __future__ import annotations

import argparse
import json
import os
import shutil
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from moved_scenes import write_moved
from splat_scenes import random_splats

from nsvq_lightning.commands.arguments import (
    READ,
    Parser,
    integers,
    known_views,
    names,
    positive,
    scene_file,
    scene_with_views,
    some_of,
    trained_scene,
    unknown_option,
    views_of,
)
from nsvq_lightning.commands.main import main
from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.scene import load_cameras, load_scene
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import read_scene, save
from nsvq_lightning.rendering.sampling import trained_by


def test_lists_have_each_entry_once() -> None:
    assert names(" a, b,,a ") == ("a", "b")
    assert integers("3,1,3") == (3, 1)
    assert some_of("abc")("c, a") == ("c", "a")
    assert some_of("abc")("all") == ("a", "b", "c")


@pytest.mark.parametrize("text", ["", ",", "a,d", "all,a"])
def test_only_known_names_are_taken(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=f"choose some of a, b, c, or all, got '{text}'"):
        some_of("abc")(text)


@pytest.mark.parametrize("text", ["", "1,,2", "1.5", "one"])
def test_only_whole_numbers_are_taken(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected whole numbers with commas between them"):
        integers(text)


@pytest.mark.parametrize(("kind", "text"), [(int, "0"), (int, "-3"), (float, "inf"), (float, "nan"), (float, "-0.0")])
def test_numbers_are_above_0(kind: type[int] | type[float], text: str) -> None:
    assert positive(kind)("2") == 2
    with pytest.raises(argparse.ArgumentTypeError, match=f"must be above 0, got {text}"):
        positive(kind)(text)


def test_a_misspelt_option_is_told_from_other_messages(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--port", "--host", "--data.root", "--data.help", "-o"]
    assert unknown_option("unrecognized arguments: --prot=3", options) == "; did you mean --port?"
    assert unknown_option("Option 'data.rot' is not accepted", options) == "; did you mean --data.root?"
    assert unknown_option("unrecognized arguments: --nothing_like_it", options) == ""
    assert unknown_option("argument --prot: must be above 0", options) == ""
    parser = Parser(prog="nsvq test")
    parser.add_argument("--port")
    with pytest.raises(SystemExit) as stop:
        parser.parse_args(["--prot", "3"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.endswith("unrecognized arguments: --prot 3; did you mean --port?\n")


def test_a_scene_is_a_file_or_that_of_a_run(tmp_path: Path) -> None:
    file = tmp_path / "version_3" / "scene.nsvq"
    file.parent.mkdir()
    file.touch()
    assert scene_file(file) == scene_file(file.parent) == file
    with pytest.raises(ValueError, match=f"holds no scene.nsvq: .*, such as {file.parent}"):
        scene_file(tmp_path)
    newer = tmp_path / "version_10" / "scene.nsvq"
    newer.parent.mkdir()
    newer.touch()
    os.utime(file, (1, 1))
    with pytest.raises(ValueError, match=f", such as {newer.parent}"):
        scene_file(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no file or folder"):
        scene_file(tmp_path / "other.ply")
    (tmp_path / "last.ckpt").touch()
    with pytest.raises(ValueError, match="is a checkpoint; 'nsvq export --ckpt_path "):
        scene_file(tmp_path / "last.ckpt")


def test_a_run_says_where_its_photos_are(tmp_path: Path, demo_scene: Path) -> None:
    config = tmp_path / "config.yaml"
    for content, known in (("root: {folder}", True), ("root: {folder}/gone", False), ("factor: 2", False)):
        config.write_text("data: {init_args: {" + content.format(folder=demo_scene) + "}}")
        for path in (tmp_path, tmp_path / "scene.nsvq"):
            cameras, photos = known_views(path, None)
            assert (bool(cameras), photos is not None) == (known, known)
    # Who names the folder that the run had means its photos as they were.
    config.write_text(f"data: {{init_args: {{root: {demo_scene}, factor: 2}}}}")
    trained, named = (known_views(tmp_path, root)[0] for root in (None, demo_scene))
    assert [view.size for view in named.values()] == [view.size for view in trained.values()]
    config.write_text("data: {init_args: {root: elsewhere, factor: 2}}")
    whole = known_views(tmp_path, demo_scene)[0]
    assert next(iter(whole.values())).width == 2 * next(iter(trained.values())).width
    config.unlink()
    assert known_views(tmp_path, None) == ({}, None)


ENTRY = {"img_name": "a", "width": 8, "height": 6, "fx": 7, "fy": 7, "position": [0, 0, -6]}
ENTRY["rotation"] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize("above", range(4))
def test_cameras_of_inrias_trainer_lie_up_to_two_folders_above_the_scene(tmp_path: Path, above: int) -> None:
    scene = tmp_path / "run" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    scene.parent.mkdir(parents=True)
    (scene.parents[above] / "cameras.json").write_text(json.dumps([ENTRY]))
    assert list(known_views(scene, None)[0]) == ["a"] * (above < 3)
    if above < 3:
        views = views_of(scene, CompressedScene.from_splats(random_splats(9)), 5, None)
        assert [(view.width, view.height) for view in views] == [(8, 6)]
        assert views[0].position.tolist() == [0, 0, -6]


def test_what_inrias_trainer_saw_in_front_of_white_is_white(tmp_path: Path) -> None:
    scene = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    scene.parent.mkdir(parents=True)
    save(random_splats(9), scene)
    (tmp_path / "cameras.json").write_text(json.dumps([ENTRY]))
    for white in (False, True):
        (tmp_path / "cfg_args").write_text(f"Namespace(resolution=-1, white_background={white})")
        assert trained_scene(scene, None).background == (float(white),) * 3


def test_splats_of_a_run_are_shown_in_front_of_what_it_says(tmp_path: Path) -> None:
    save(random_splats(9), tmp_path / "scene.ply")
    for color, shown in (("white", 1.0), ("black", 0.0)):
        (tmp_path / "config.yaml").write_text(f"model:\n  sh_degree: 3\n  background: {color}\ndata: {{}}\n")
        assert trained_scene(tmp_path / "scene.ply", None).background == (shown,) * 3


@pytest.mark.parametrize("origin", [(4e5, 5e6, 30.0), (400.0, 500.0, 30.0)])
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".glb", ".nsvq"])
def test_other_files_of_a_run_have_its_origin_and_background(
    tmp_path: Path, suffix: str, origin: tuple[float, float, float]
) -> None:
    def found(name: str) -> CompressedScene:
        return scene_with_views(read_scene(tmp_path / name), tmp_path / name, None)[0]

    def places(scene: CompressedScene) -> Any:
        return np.sort(scene.means + np.array(scene.origin), axis=0)

    scene = replace(CompressedScene.from_splats(random_splats(9)), origin=origin, config={"background": "white"})
    for name in f"scene{suffix}", f"other{suffix}", "scene.nsvq":
        save(scene, tmp_path / name)
    for name, known in (f"scene{suffix}", True), (f"other{suffix}", suffix == ".nsvq"):
        assert found(name).background == (float(known),) * 3
        if known or suffix == ".glb":
            np.testing.assert_allclose(places(found(name)), places(scene), atol=0.05)
        else:
            assert found(name).origin == (0, 0, 0)
    if suffix == ".ply":  # what is damaged, or of another scene, says nothing
        for data in (tmp_path / "scene.nsvq").read_bytes()[:300], b"":
            (tmp_path / "scene.nsvq").write_bytes(data)
            assert found("scene.ply").origin == (0, 0, 0)
        save(scene.take(np.arange(8)), tmp_path / "scene.nsvq")
        assert found("scene.ply").origin == (0, 0, 0)


def test_a_page_of_guessed_cameras_is_no_source_of_cameras(tmp_path: Path) -> None:
    save(random_splats(30), tmp_path / "scene.ply")
    assert main(["view", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "viewer.html")]) == 0
    assert known_views(tmp_path / "scene.ply", None) == ({}, None)


def test_a_scene_has_the_cameras_that_lie_beside_it(
    tmp_path: Path, demo_scene: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "scene.ply"
    save(random_splats(9), path)
    assert len(trained_scene(path, None).cameras) == 0
    assert len(trained_scene(path, demo_scene).cameras) > 5
    (tmp_path / "cameras.json").write_text(json.dumps([ENTRY]))
    assert trained_scene(path, None).cameras.tolist() == [[0, 0, -6, 7]]
    (tmp_path / "cameras.json").write_text('{"cameras": 7}')
    assert len(trained_scene(path, None).cameras) == 0
    assert "cannot be read" in caplog.text
    with pytest.raises(ValueError, match="does not exist"):
        trained_scene(path, tmp_path / "gone")
    kept = tmp_path / "scene.nsvq"
    save(replace(read_scene(path), cameras=np.array([[1.0, 2, 3, 9]])), kept)
    assert trained_scene(kept, demo_scene).cameras.tolist() == [[1, 2, 3, 9]]  # its own
    scene, cameras, photos = scene_with_views(read_scene(kept), kept, demo_scene)
    assert scene.cameras.tolist() == [[1, 2, 3, 9]]
    assert photos is not None
    assert len(cameras) == len(photos)


@pytest.mark.parametrize(("settings", "width"), [("factor: 4", 24), ("max_width: 48", 48), ("seed: 0", 96)])
def test_photos_of_a_run_have_the_size_that_it_trained(
    tmp_path: Path, demo_scene: Path, settings: str, width: int
) -> None:
    (tmp_path / "config.yaml").write_text(f"data: {{init_args: {{root: {demo_scene}, {settings}}}}}")
    assert {camera.width for camera in known_views(tmp_path, None)[0].values()} == {width}


def test_what_is_read_of_a_folder_is_all_that_loading_a_scene_takes() -> None:
    assert {*READ} == signature(load_scene).parameters.keys() - {"root", "cache_bytes", "origin"}


def test_cameras_of_a_run_are_of_the_model_that_it_trained(tmp_path: Path, demo_scene: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(demo_scene, scene)
    (scene / "images").rename(scene / "photos")
    (scene / "sparse" / "0").rename(scene / "sparse" / "1")
    shutil.copytree(demo_scene / "sparse" / "0", scene / "sparse" / "0")
    for name in ("images.bin", "images.txt"):
        (scene / "sparse" / "0" / name).unlink(missing_ok=True)  # not the model
    settings = "model: '1', images_folder: photos, masks: null"
    (tmp_path / "config.yaml").write_text(f"data: {{init_args: {{root: {scene}, {settings}}}}}")
    cameras, photos = known_views(tmp_path, None)
    assert photos is not None
    assert len(cameras) == len(load_scene(demo_scene))
    shutil.rmtree(scene / "photos")
    assert known_views(tmp_path, None)[0].keys() == cameras.keys()


def test_cameras_of_a_run_are_found_though_a_photo_is_gone(tmp_path: Path, demo_scene: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(demo_scene, scene)
    (tmp_path / "config.yaml").write_text(f"data: {{init_args: {{root: {scene}, factor: 2}}}}")
    before = known_views(tmp_path, None)[0]
    next((scene / "images").iterdir()).unlink()
    cameras, photos = known_views(tmp_path, None)
    assert photos is None
    assert {name: camera.size for name, camera in cameras.items()} == {name: each.size for name, each in before.items()}
    with pytest.raises(SceneError, match=r"1 of 9 images of the model are not in"):
        known_views(tmp_path, scene)


def test_no_cameras_are_found_where_there_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert known_views(Path("scene.ply"), None)[0] == {}
    Path("cameras.json").write_text("[{}]")
    with pytest.raises(ValueError, match=r"cameras\.json is no list of cameras as INRIA's trainer writes it"):
        known_views(Path("scene.ply"), None)[0]


def _without_photos(scene: Path, folder: Path) -> Path:
    """A scene folder with the COLMAP model of another one."""
    shutil.copytree(scene / "sparse", folder / "sparse")
    return folder


def test_cameras_need_no_photos(tmp_path: Path, demo_scene: Path) -> None:
    expected = load_scene(demo_scene)
    points = expected.points[:50]
    scene = CompressedScene.from_splats(random_splats(50)._replace(means=points))
    root = _without_photos(demo_scene, tmp_path / "scene")
    path = tmp_path / "a" / "b" / "c.ply"
    path.parent.mkdir(parents=True)
    assert known_views(path, None)[0] == {}
    for found in (known_views(path, root)[0], load_cameras(root)):
        assert tuple(found) == expected.names
        assert all(
            torch.equal(one.viewmat, other.viewmat) for one, other in zip(found.values(), expected.cameras, strict=True)
        )
        assert [camera.intrinsics for camera in found.values()] == [each.intrinsics for each in expected.cameras]
    assert len(views_of(path, scene, 4, root)) == 3
    assert known_views(path, root, scene)[1] is None
    _without_photos(demo_scene, tmp_path / "a")  # beside the scene, a folder above
    assert tuple(known_views(path, None)[0]) == expected.names


@pytest.mark.parametrize("photos_are_there", [True, False])
def test_cameras_on_a_map_are_seen_from_the_scenes_origin(
    tmp_path: Path, demo_scene: Path, photos_are_there: bool
) -> None:
    near, origin = load_scene(demo_scene), (5e5, 4.1e6, 120.0)
    far = write_moved(demo_scene, tmp_path / "far", shift=origin)
    if not photos_are_there:
        (far / "images").unlink()
    scene = replace(CompressedScene.from_splats(random_splats(50)._replace(means=near.points[:50])), origin=origin)
    cameras, photos = known_views(tmp_path / "scene.nsvq", far, scene)
    assert load_scene(demo_scene).frame.origin == (0, 0, 0)
    for found in (list(cameras.values()), photos.cameras if photos else views_of(tmp_path, scene, 9, far)):
        for one, other in zip(found, near.cameras, strict=True):
            torch.testing.assert_close(one.viewmat, other.viewmat, atol=1e-5, rtol=0)
    if photos:
        torch.testing.assert_close(photos.points, near.points, atol=1e-5, rtol=0)
        assert photos.frame.origin == origin
        np.testing.assert_allclose(photos.frame.middle, near.frame.middle, atol=1e-5)


def test_cameras_of_another_scene_are_not_used(
    tmp_path: Path, demo_scene: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = _without_photos(demo_scene, tmp_path / "scene")
    path = root / "scene.ply"
    photos = load_scene(demo_scene)
    points = photos.points
    own = CompressedScene.from_splats(random_splats(len(points))._replace(means=points))
    moved = replace(own, means=own.means + 20)
    for scene, count in ((own, 9), (moved, 0)):
        save(scene, path)
        assert len(known_views(path, None, scene)[0]) == count
    assert len(trained_scene(path, None).cameras) == 0
    save(own, path)
    assert len(trained_scene(path, None).cameras) == 9  # without photos, nobody knows which were trained by
    assert len(trained_scene(path, demo_scene).cameras) == len(photos.train) == 7
    assert "scene.ply: the cameras of the folders beside it are not used: 9 cameras show " in caplog.text
    for wrong in (root, demo_scene):
        assert known_views(path, wrong, moved) == ({}, None)
        assert f"the cameras of {wrong} are not used: 9 cameras show" in caplog.text


def test_cameras_that_stood_elsewhere_are_not_used(
    tmp_path: Path, demo_scene: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = _without_photos(demo_scene, tmp_path / "scene")
    photos = load_scene(demo_scene)
    points = photos.points
    scene = CompressedScene.from_splats(random_splats(len(points))._replace(means=points))
    own = replace(scene, cameras=trained_by(photos.train_cameras))
    smaller = replace(own, means=0.5 * own.means, cameras=own.cameras * [0.5, 0.5, 0.5, 1])
    one = replace(own, cameras=own.cameras[:1])
    assert [len(known_views(root / "scene.ply", None, each)[0]) for each in (own, smaller, one)] == [9, 0, 9]
    assert "9 cameras stand elsewhere than those that the scene was trained by" in caplog.text
    assert len(known_views(root / "scene.ply", root, smaller)[0]) == 9  # as asked


def test_the_folder_of_a_trainer_may_be_named(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text(json.dumps([ENTRY]))
    assert list(known_views(Path("elsewhere/scene.ply"), tmp_path)[0]) == ["a"]


@pytest.mark.parametrize("number", ["-1", "-.5", "-1.", "-2.2e-16", "-1E+3", "-inf"])
def test_negative_numbers_are_no_options(number: str) -> None:
    parser = Parser()
    parser.add_argument("--up-from", nargs=3, type=float)
    assert parser.parse_args(["--up-from", "0", number, "1"]).up_from == [0.0, float(number), 1.0]
