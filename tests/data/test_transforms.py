"""Folders with a ``transforms.json``: the same cameras, points and photos as the COLMAP folder they were made from."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from transforms_scenes import APPLIED, opengl_matrix, write_blender, write_nerfstudio

from nsvq_lightning.data import points
from nsvq_lightning.data.colmap import SceneError, read_model
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import Scene, load_scene

SceneFactory = Callable[..., Path]
FEW = 500


@pytest.fixture(autouse=True)
def few_random_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points, "RANDOM_POINTS", FEW)


def change(path: Path, frame: dict[str, Any] | None = None, **head: Any) -> None:
    """Change values of a transforms file, and of its first frame; None removes one."""
    document = json.loads(path.read_text())
    for values, changes in ((document["frames"][0], frame or {}), (document, head)):
        values.update(changes)
        for key in [key for key, value in changes.items() if value is None]:
            del values[key]
    path.write_text(json.dumps(document))


def same_views(one: Scene, other: Scene, atol: float = 1e-6) -> None:
    assert (one.names, one.train, one.test) == (other.names, other.train, other.test)
    for a, b in zip(one.cameras, other.cameras, strict=True):
        torch.testing.assert_close(a.viewmat, b.viewmat, rtol=0, atol=atol)
        torch.testing.assert_close(a.K, b.K, rtol=1e-6, atol=1e-4)
        assert (a.width, a.height) == (b.width, b.height)


def test_nerfstudio_gives_the_same_views_and_points_as_colmap(demo_scene: Path, tmp_path: Path) -> None:
    colmap, scene = load_scene(demo_scene), load_scene(write_nerfstudio(demo_scene, tmp_path / "scene"))
    same_views(scene, colmap)
    assert scene.extent == pytest.approx(colmap.extent, rel=1e-6)
    torch.testing.assert_close(scene.points, colmap.points)
    torch.testing.assert_close(scene.colors, colmap.colors)
    assert all(torch.equal(scene.view(i).image, colmap.view(i).image) for i in range(len(scene)))


@pytest.mark.parametrize("moved_points", [True, False], ids=["as now", "as in old versions"])
def test_points_are_where_the_cameras_see_them(demo_scene: Path, tmp_path: Path, moved_points: bool) -> None:
    colmap = load_scene(demo_scene)
    scene = load_scene(write_nerfstudio(demo_scene, tmp_path / "scene", APPLIED, moved_points))
    turned = torch.from_numpy(APPLIED[:, :3]).float()
    torch.testing.assert_close(scene.points, colmap.points @ turned.T, rtol=0, atol=1e-5)
    local = [s.points @ s.cameras[3].viewmat[:3, :3].T + s.cameras[3].viewmat[:3, 3] for s in (scene, colmap)]
    torch.testing.assert_close(*local, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "distortion", "values"),
    [
        ("OPENCV", (0.1, -0.02, 0.003, 0.001), {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": 0.001}),
        ("FULL_OPENCV", (0.1, -0.02, 0, 0, 0.01, 0, 0, 0), {"k1": 0.1, "k2": -0.02, "k3": 0.01}),
        ("OPENCV_FISHEYE", (0.05, 0.01, 0.002, 0.001),
         {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": 0.01, "k3": 0.002, "k4": 0.001}),
        ("OPENCV_FISHEYE", (0.05, 0.01, 0.002, 0.001),
         {"camera_model": "opencv_fisheye", "k1": 0.05, "k2": 0.01, "k3": 0.002, "k4": 0.001}),
        ("FULL_OPENCV", (0.1, 0, 0.002, 0, 0.01, 0, 0, 0), {"k1": 0.1, "distortion_params": [9, 0, 0.01, 0, 0.002, 0]}),
        ("OPENCV_FISHEYE", (0.05, 0, 0, 0), {"camera_model": None, "is_fisheye": True, "k1": 0.05}),
        ("OPENCV_FISHEYE", (0.05, 0, 0, 0), {"camera_model": None, "is_fisheye": 1, "k1": 0.05}),
    ],
)  # fmt: skip
def test_lenses_are_those_of_colmap(
    make_scene: SceneFactory, tmp_path: Path, model: str, distortion: tuple[float, ...], values: dict[str, Any]
) -> None:
    colmap = make_scene(model=model, params=(30.0, 31.0, 21.0, 15.0, *distortion))
    root = write_pinhole(colmap, tmp_path / "json", **values)
    one, other = load_scene(root), load_scene(colmap)
    same_views(one, other)
    assert torch.equal(one.view(2).image, other.view(2).image)


def write_pinhole(colmap: Path, root: Path, **values: Any) -> Path:
    """The folder with a transforms file of the given lens, whatever COLMAP's is."""
    model = read_model(colmap)
    shutil.copytree(colmap / "images", root / "images")
    head = {"fl_x": 30.0, "fl_y": 31.0, "cx": 21.0, "cy": 15.0, "w": 40, "h": 32, "camera_model": "OPENCV"} | values
    frames = [{"file_path": f"./images/{i.name}", "transform_matrix": opengl_matrix(i.viewmat)} for i in model.images]
    (root / "transforms.json").write_text(json.dumps({**head, "frames": frames}))
    return root


def test_values_of_a_frame_come_first(make_scene: SceneFactory, tmp_path: Path) -> None:
    """As in Polycam's exports: every frame has its own intrinsics; here one differs."""
    root = write_pinhole(make_scene(), tmp_path / "json")
    change(root / "transforms.json", {"fl_x": 33.0, "cx": 20.5})
    cameras = load_scene(root).cameras
    change(root / "transforms.json", {"fl_x": None, "cx": None, "camera_angle_x": 2 * math.atan(20 / 24)})
    assert load_scene(root).cameras[0].intrinsics == pytest.approx((24, 24, 21, 15))
    assert cameras[0].intrinsics == pytest.approx((33, 31, 20.5, 15))
    assert cameras[1].intrinsics == pytest.approx((30, 31, 21, 15))


def test_an_angle_is_a_focal_length(make_scene: SceneFactory, tmp_path: Path) -> None:
    """As instant-ngp writes it; size and centre are those of the photo."""
    angle = 2 * math.atan(20 / 30)
    absent = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    root = write_pinhole(make_scene(), tmp_path / "json", camera_angle_x=angle, **absent)
    assert load_scene(root).cameras[0].intrinsics == pytest.approx((30, 30, 20, 16))
    change(root / "transforms.json", camera_angle_y=2 * math.atan(16 / 25))
    assert load_scene(root).cameras[0].intrinsics == pytest.approx((30, 25, 20, 16))
    change(root / "transforms.json", camera_angle_x=None)
    assert load_scene(root).cameras[0].intrinsics == pytest.approx((25, 25, 20, 16))


def test_scaled_copies_of_the_photos_are_used(make_scene: SceneFactory, tmp_path: Path) -> None:
    root = write_pinhole(make_scene(), tmp_path / "json")
    (root / "images_2").mkdir()
    for path in (root / "images").iterdir():
        assert cv2.imwrite(str(root / "images_2" / path.name), np.full((16, 20, 3), 7, np.uint8))
    assert set(load_scene(root, factor=2).view(4).image.flatten().tolist()) == {7}
    assert load_scene(root, factor=4).view(4).image.shape == (8, 10, 3)


def test_copies_of_another_size_are_not_those_of_another_scene(make_scene: SceneFactory, tmp_path: Path) -> None:
    """Photos lie in two folders, so that of all is the scene's own; beside it, ``room_2`` is another room."""
    colmap = make_scene()
    for name in ("room", "room_2"):
        root = write_pinhole(colmap, tmp_path / name)
        (root / "images" / "003.png").rename(root / "003.png")
        text = (root / "transforms.json").read_text()
        (root / "transforms.json").write_text(text.replace("./images/003.png", "003.png"))
    assert cv2.imwrite(str(root / "003.png"), np.full((32, 40, 3), 7, np.uint8))
    whole, half = (load_scene(tmp_path / "room", factor=factor) for factor in (None, 2))
    assert [source.path for source in half.images.sources] == [source.path for source in whole.images.sources]
    assert half.view(3).image.shape == (16, 20, 3)


def test_masks_beside_photos_elsewhere_are_not_looked_for(make_scene: SceneFactory, tmp_path: Path) -> None:
    root = write_pinhole(make_scene(), tmp_path / "project" / "photos")
    export = tmp_path / "project" / "export" / "transforms.json"
    export.parent.mkdir()
    masks = tmp_path / "project" / "masks" / "photos" / "images"
    masks.mkdir(parents=True)
    for path in (root / "images").iterdir():
        assert cv2.imwrite(str(masks / path.name), np.zeros((32, 40), np.uint8))
    for elsewhere in ("../photos/images", f"{root}/images"):
        export.write_text((root / "transforms.json").read_text().replace("./images", elsewhere))
        scene = load_scene(export.parent, allow_outside=True)
        assert not any(source.mask for source in scene.images.sources)
        assert Path(scene.images.sources[0].path).samefile(root / "images" / "000.png")


def test_a_crop_of_fisheyes_is_told(make_scene: SceneFactory, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    load_scene(write_pinhole(make_scene(), tmp_path / "json", fisheye_crop_radius=9))
    assert "fisheye_crop_radius is not applied: leave out what lies beyond by masks" in caplog.text


def test_blender_scenes_have_their_own_split_and_random_points(
    demo_scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_blender(demo_scene, tmp_path / "lego")
    caplog.set_level("INFO", logger="nsvq_lightning")
    scene = load_scene(root)
    assert f"has no points: {FEW} random ones" in caplog.text
    colmap = read_model(demo_scene)
    assert [scene.names[i] for i in scene.test] == ["test/r_0.png", "test/r_1.png", "test/r_2.png"]
    assert len(scene.train) == 6
    assert scene.split == "as transforms_train.json says"
    np.testing.assert_allclose(scene.cameras[1].viewmat, colmap.images[4].viewmat, atol=1e-6)
    assert scene.cameras[0].intrinsics == pytest.approx((0.78 * 96, 0.78 * 96, 36, 36))
    assert len(scene.points) == FEW
    assert torch.equal(scene.points, load_scene(root).points)
    shutil.copy(root / "transforms_train.json", root / "transforms.json")  # of all frames, as some exporters have it
    assert load_scene(root).names == scene.names
    (root / "transforms.json").unlink()
    (root / "transforms_test.json").rename(root / "transforms_val.json")
    assert len(load_scene(root).test) == 3
    unrendered = shutil.copytree(root, tmp_path / "unrendered")
    shutil.rmtree(unrendered / "test")
    for frames in ({}, {"frames": []}):  # the names that are left are those of train photos
        caplog.clear()
        change(unrendered / "transforms_val.json", **frames)
        scene = load_scene(unrendered)
        assert (len(scene.train), len(scene.test)) == (5, 1)
        assert "transforms_val.json: none of its photos is there, so it is not used" in caplog.text
    train = root / "transforms_train.json"
    shutil.copy(train, root / "transforms_test.json")
    with pytest.raises(SceneError, match=r"transforms_test\.json: train/r_0\.png is a train and a test photo"):
        load_scene(root)
    (root / "transforms_test.json").unlink()
    (root / "transforms_val.json").unlink()
    assert load_scene(root).split == "every 8th by name"


def test_lists_of_train_and_test_photos_are_followed(
    make_scene: SceneFactory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    root = write_pinhole(make_scene(), tmp_path / "json")
    lists = {"train_filenames": [f"images/00{i}.png" for i in (0, 1, 2, 5)], "val_filenames": ["images/003.png"]}
    change(root / "transforms.json", **lists)
    scene = load_scene(root)
    assert scene.names == ("000.png", "001.png", "002.png", "003.png", "005.png")
    assert (scene.test, scene.train) == ((3,), (0, 1, 2, 4))
    assert "4 of 9 photos are not used, by its lists" in caplog.text
    assert "filenames" not in caplog.text
    change(root / "transforms.json", val_filenames=["images/003.png", "images/004.jpeg", 7])
    assert load_scene(root).test == (3,)
    assert "2 of 3 names in val_filenames are of no photo in the file" in caplog.text
    change(root / "transforms.json", train_filenames=[])
    assert (load_scene(root).test, len(load_scene(root).train)) == ((3,), 8)
    change(root / "transforms.json", val_filenames=[], train_filenames=["images/001.png", "images/003.png"])
    assert (load_scene(root).train, len(load_scene(root).test)) == ((1, 3), 7)
    change(root / "transforms.json", train_filenames=[f"images/00{i}.png" for i in (0, 1, 2, 5)])
    change(root / "transforms.json", val_filenames=["images/001.png"])
    with pytest.raises(SceneError, match=r"001\.png is a train and a test photo"):
        load_scene(root)


def test_odd_cameras_of_all_photos_are_told_once(
    make_scene: SceneFactory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_pinhole(make_scene(), tmp_path / "json")
    frames = json.loads((root / "transforms.json").read_text())["frames"]
    change(root / "transforms.json", frames=[{**frame, "cx": 0.1 + k / 100} for k, frame in enumerate(frames)])
    load_scene(root)
    assert caplog.text.count("camera ") == 1
    assert "after it was calibrated? (8 more are odd)" in caplog.text


def test_a_colmap_model_comes_first_and_any_can_be_chosen(make_scene: SceneFactory, tmp_path: Path) -> None:
    root = write_pinhole(make_scene(views=9), tmp_path / "json")
    shutil.copytree(make_scene("five", views=5) / "sparse", root / "sparse")
    shutil.copytree(make_scene("six", views=6) / "sparse/0", root / "sparse/1")
    counts = {model: len(load_scene(root, model=model)) for model in (None, "1", "sparse/0", "transforms.json")}
    assert counts == {None: 5, "1": 6, "sparse/0": 5, "transforms.json": 9}
    assert len(ColmapDataModule(str(root), model=1).scene) == 6  # type: ignore[arg-type]
    with pytest.raises(
        SceneError, match=r"no COLMAP model in .*sparse/7: .*\(--data\.model\); there is sparse/0, sparse/1"
    ):
        load_scene(root, model="7")
    with pytest.raises(SceneError, match=r"other\.json does not exist"):
        load_scene(root, model="other.json")


@pytest.mark.parametrize(
    ("frame", "head", "message"),
    [
        ({}, {"camera_model": "EQUIRECTANGULAR"}, "RECTANGULAR, which cannot .*: cut the panoramas"),
        ({}, {"latlong": True}, "LATLONG, which cannot .*: cut the panoramas"),
        ({}, {"ftheta_p0": 0.0, "ftheta_p1": 0.01}, "FTHETA_P1, which cannot .*: export the photos undistorted"),
        ({}, {"k4": 0.1}, "OPENCV and k4 = 0.1, which cannot"),
        ({}, {"fl_x": None, "fl_y": None}, "frame 0 has no focal length"),
        ({}, {"fl_x": -3}, "focal length -3"),
        ({}, {"fl_x": None, "fl_y": None, "camera_angle_x": 51.3}, r"focal lengths and a centre, in pixels, got \("),
        ({}, {"fl_x": 0.3}, r"image .* focal lengths and a centre, in pixels, got \(0\.3"),
        ({"cx": "wide"}, {}, "frame 0 has cx = 'wide'"),
        ({"cx": float("nan")}, {}, "frame 0 has cx = nan"),
        ({}, {"w": 0}, "size 0x32"),
        ({"transform_matrix": [[1, 2], [3]]}, {}, "no transform_matrix"),
        ({"transform_matrix": None}, {}, "no transform_matrix"),
        ({"transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()}, {}, r"skewed or mirrored \(.*'\./images/000\.png'"),
        ({"transform_matrix": [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, {}, "skewed or mirrored"),
        ({"transform_matrix": (np.eye(4) + np.eye(4)[[3, 0, 1, 2]].T).T.tolist()}, {}, "is it transposed"),
        ({"file_path": None}, {}, "no file_path"),
        ({"file_path": "images/001.png"}, {}, "an earlier frame is of"),
        ({"file_path": "images/gone.png"}, {}, r"first gone\.png"),
        ({}, {"frames": []}, "no list of frames"),
        ({}, {"frames": [3]}, "frame 0 is no table"),
        ({}, {"ply_file_path": "gone.ply"}, r"gone\.ply do not exist"),
        ({"file_path": "../a.png"}, {}, r"names \.\./a\.png, which is"),
        ({"file_path": "/etc/a.png"}, {}, r"names /etc/a\.png, which is"),
        ({"file_path": "..\\a.png"}, {}, r"names \.\./a\.png, which is"),
        ({"mask_path": "../m.png"}, {}, r"names \.\./m\.png, which is"),
        ({"mask_path": "masks/000.png"}, {}, r"1 masks do not exist, first .*masks/000\.png"),
        ({"file_path": "\udcff.png"}, {}, "which is not UTF-8"),
        ({}, {"ply_file_path": "../a.ply"}, r"path in .* names \.\./a\.ply"),
    ],
)
def test_damage_is_named(
    make_scene: SceneFactory, tmp_path: Path, frame: dict[str, Any], head: dict[str, Any], message: str
) -> None:
    path = write_pinhole(make_scene(views=3), tmp_path / "json") / "transforms.json"
    change(path, frame, **head)
    with pytest.raises(SceneError, match=message):
        load_scene(path.parent)
    path.write_text("{")
    with pytest.raises(SceneError, match=r"transforms\.json cannot be read"):
        load_scene(path.parent)


def test_names_are_those_of_the_nearest_photos(
    make_scene: SceneFactory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Names in capitals, of another machine, and lists without suffix; sizes are those of the photos."""
    caplog.set_level("INFO", logger="nsvq_lightning")
    root = write_pinhole(make_scene(), tmp_path / "json", w=None, h=None)
    path = root / "transforms.json"
    document = json.loads(path.read_text())
    for number, frame in enumerate(document["frames"]):
        frame["file_path"] = f"C:\\scans\\one\\images\\00{number}.PNG"
    document |= {"train_filenames": ["images/001", "images/002"], "test_filenames": ["C:/scans/one/images/000.PNG"]}
    path.write_text(json.dumps(document))
    scene = load_scene(root)
    assert scene.names == ("000.png", "001.png", "002.png")
    assert (scene.train, scene.test) == ((1, 2), (0,))
    assert (scene.cameras[0].width, scene.cameras[0].height) == (40, 32)
    assert "9 of 9 files have other names than in" in caplog.text


def test_photos_two_folders_deep_are_those_of_the_model(demo_scene: Path, tmp_path: Path) -> None:
    """As instant-ngp's script writes them that was called from a folder above."""
    root = write_nerfstudio(demo_scene, tmp_path / "scene", APPLIED, ply_file_path=None)
    (root / "points.ply").unlink()
    shutil.copytree(demo_scene / "sparse", root / "colmap_sparse")
    (root / "data").mkdir()
    (root / "images").rename(root / "data/images")
    text = (root / "transforms.json").read_text().replace("images/", "data/images/")
    (root / "transforms.json").write_text(text)
    turned = torch.from_numpy(APPLIED[:, :3]).float()
    torch.testing.assert_close(load_scene(root).points, load_scene(demo_scene).points @ turned.T, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["points3d.ply", "dense.PLY", "colmap/sparse/0"])
def test_points_that_no_file_names_are_used(
    demo_scene: Path, tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Those of COLMAP are where the cameras are, whatever moved these."""
    caplog.set_level("INFO", logger="nsvq_lightning")
    moved = APPLIED if "colmap" in name else None
    root = write_nerfstudio(demo_scene, tmp_path / "scene", moved, ply_file_path=None)
    change(root / "transforms.json", applied_transform=None)
    if moved is not None:
        shutil.copytree(demo_scene / "sparse", root / "colmap/sparse")
        shutil.copytree(demo_scene / "sparse/0", root / "colmap_text")  # instant-ngp leaves the same model twice
        (root / "points.ply").unlink()
    else:
        (root / "points.ply").rename(root / name)
    expected = load_scene(demo_scene).points
    if moved is not None:
        expected = expected @ torch.from_numpy(APPLIED[:, :3]).float().T
    torch.testing.assert_close(load_scene(root).points, expected, rtol=0, atol=1e-4)
    assert f"names no points: those of {root / name} are used" in caplog.text
    if moved is None:
        shutil.copy(root / name, root / f"other_{name}")
        shutil.copy(root / name, root / f"sparse_pc{name[-4:]}")
        (root / name).rename(root / "points3D.ply")
        with pytest.raises(SceneError, match=r"points3D\.ply and .*sparse_pc\.(ply|PLY) may be the points"):
            load_scene(root)
