from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import PIL.Image
import PIL.ImageOps
import pytest
import torch
from lightning.fabric.utilities import move_data_to_device
from moved_scenes import write_moved
from runs import quiet_trainer
from scipy.spatial.transform import Rotation
from transforms_scenes import write_blender, write_nerfstudio

from nsvq_lightning.data import colmap
from nsvq_lightning.data import scene as scene_module
from nsvq_lightning.data.colmap import SceneError, import_pycolmap, larger_models, read_model
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.images import ImageHead, ImageStore, Picture, same_shape
from nsvq_lightning.data.photo_files import photos_below
from nsvq_lightning.data.points import RANDOM_POINTS, in_picture, projected
from nsvq_lightning.data.reconstruct import reconstruct
from nsvq_lightning.data.scene import (
    View,
    check_cameras,
    check_colors,
    detailed_pixels,
    is_elsewhere,
    load_cameras,
    load_scene,
    seen_by,
    spread,
    stretch,
    usable,
)
from nsvq_lightning.data.transforms import read_poses
from nsvq_lightning.io.ply import write_elements
from nsvq_lightning.rendering.camera import Camera, camera_of
from nsvq_lightning.rendering.frame import EXTENT, Frame
from nsvq_lightning.rendering.poses import view_from
from nsvq_lightning.splats.conventions import SH_C0
from nsvq_lightning.training.module import SplatModule

SceneFactory = Callable[..., Path]


def test_a_scene_far_from_the_origin_has_another(
    make_scene: SceneFactory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    near, shift = load_scene(make_scene()), np.array([5e5, 4.1e6, 120.0])
    assert "positions are relative" not in caplog.text
    far = load_scene(write_moved(near.root, tmp_path / "far", 1.0, shift))
    assert re.search(r"far: positions are relative to \(.*\), as 0 is \d+ extents away", caplog.text)
    middle = np.array(near.frame.middle)
    np.testing.assert_allclose(far.frame.origin, middle + shift, rtol=1e-9)
    np.testing.assert_allclose(far.points, near.points.numpy() - middle, atol=1e-5)
    for one, other in zip(near.standard.cameras, far.standard.cameras, strict=True):
        torch.testing.assert_close(one.viewmat, other.viewmat, atol=2e-5, rtol=0)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize("apart", [0.0, 30.0])
def test_along_a_way_what_is_near_is_before_no_near_plane(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch, unit: float, apart: float
) -> None:
    """Oracle: photos of rooms in a row, in each the points of its own."""
    poses = read_poses(demo_scene)
    shifts = np.arange(len(poses.images))[:, None] * [apart, 0, 0]
    images = []
    for image, shift in zip(poses.images, shifts, strict=True):
        view = image.viewmat.copy()
        view[:3, 3] = unit * (view[:3, 3] - view[:3, :3] @ shift)
        images.append(replace(image, viewmat=view))
    points = np.concatenate([unit * (poses.points + shift) for shift in shifts])
    moved = replace(poses, images=tuple(images), points=points, colors=np.tile(poses.colors, (len(shifts), 1)))
    monkeypatch.setattr(scene_module, "read_poses", lambda *_, **__: moved)
    cameras = load_cameras(demo_scene)
    nears = {camera.near for camera in cameras.values()}
    frame = Frame.around(np.stack([image.centre for image in images]))
    pictures = [(camera, unit * (poses.points + shift)) for camera, shift in zip(cameras.values(), shifts, strict=True)]
    depths = np.concatenate([projected(points, camera)[2][in_picture(points, camera)] for camera, points in pictures])
    assert len(nears) == 1
    assert (depths < max(nears)).mean() < 0.01
    assert nears == {frame.near} if apart == 0 else max(nears) < 0.1 * frame.near


@pytest.mark.parametrize(
    ("model", "params", "is_odd"),
    [
        ("PINHOLE", (30.0, 31.0, 21.0, 15.0), False),
        ("PINHOLE", (30.0, 31.0, 33.0, 9.0), False),  # cropped
        ("PINHOLE", (30.0, 31.0, 0.5, 0.5), True),  # in shares
        ("PINHOLE", (60.0, 62.0, 42.0, 30.0), True),  # of photos twice as large
        ("PINHOLE", (30.0, 80.0, 21.0, 15.0), True),
        ("PINHOLE", (3.0, 3.1, 21.0, 15.0), True),  # in millimetres
        ("SIMPLE_RADIAL", (30.0, 20.0, 16.0, 0.1), False),
        ("SIMPLE_RADIAL", (30.0, 20.0, 16.0, -30.0), True),
    ],
)
def test_numbers_that_no_lens_has_are_told(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture, model: str, params: tuple[float, ...], is_odd: bool
) -> None:
    load_scene(make_scene(model=model, params=params))
    assert ("camera 1 is odd: focal lengths " in caplog.text) == is_odd


def test_null_in_a_config(make_scene: SceneFactory) -> None:
    root: Any = make_scene()
    with pytest.raises(ValueError, match="test_every must be at least 2"):
        load_scene(root, test_every=None)  # type: ignore[arg-type]
    assert len(load_scene(root, images_folder=None)) == len(load_scene(root))  # type: ignore[arg-type]


def test_a_focal_length_of_zero_is_refused(make_scene: SceneFactory) -> None:
    root = make_scene(model="PINHOLE", params=(30.0, 0.0, 21.0, 15.0))
    with pytest.raises(SceneError, match=r"camera 1 of image .*: Camera\.K needs positive, finite focal lengths"):
        load_scene(root)


def test_what_is_far_from_all_others_is_named(
    make_scene: SceneFactory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_scene()
    usual = load_scene(root)
    model = import_pycolmap().Reconstruction(str(root / "sparse/0"))
    image = model.find_image_with_name("004.png")
    pose = image.cam_from_world().matrix()
    pose[:, 3] = 500
    image.frame.set_cam_from_world(image.camera_id, import_pycolmap().Rigid3d(pose))
    for place in (1e6, -1e7):
        model.add_point3D(np.full(3, place), import_pycolmap().Track(), np.zeros(3, np.uint8))
    model.write_binary(str(root / "sparse/0"))
    scene = load_scene(root)
    assert "1 photos are far from all others, first 004.png: check its pose" in caplog.text
    assert "left out 2 of 22 points" in caplog.text
    assert scene.extent == pytest.approx(usual.extent, rel=0.3)
    assert torch.equal(scene.points, usual.points)


def test_photos_of_another_shape_than_their_camera_are_warned_of(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_scene()
    load_scene(root)
    assert not caplog.messages
    path = sorted((root / "images").iterdir())[2]
    assert cv2.imwrite(str(path), cv2.rotate(cv2.imread(str(path)), cv2.ROTATE_90_CLOCKWISE))
    load_scene(root)
    (message,) = caplog.messages
    assert re.match(r"1 of \d+ photos have another aspect ratio than their camera: they were cropped, rotated", message)


def test_photos_whose_distortion_was_taken_out_in_their_place_are_warned_of(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_scene()
    for path in (root / "images").iterdir():
        picture = cv2.imread(str(path))
        height, width = (round(0.92 * side) for side in picture.shape[:2])
        assert cv2.imwrite(str(path), picture[2 : 2 + height, 3 : 3 + width])
    load_scene(root)
    assert "photos have another aspect ratio than their camera: they were cropped, rotated, undistorted" in caplog.text


def test_a_model_in_sparse_itself_is_the_later_one(make_scene: SceneFactory) -> None:
    root = make_scene(views=9)
    for path in (make_scene("undistorted", views=5) / "sparse/0").iterdir():
        shutil.copy(path, root / "sparse")
    assert len(load_scene(root)) == 5
    assert len(load_scene(root, model="0")) == 9
    shutil.copytree(make_scene("more", views=10) / "sparse/0", root / "sparse/1")
    assert larger_models(root) is None  # than a model that is not read


def test_a_larger_model_beside_the_first_is_named(make_scene: SceneFactory, caplog: pytest.LogCaptureFixture) -> None:
    root = make_scene(views=9)
    shutil.copytree(make_scene("more", views=10) / "sparse/0", root / "sparse/1")
    model = import_pycolmap().Reconstruction(str(root / "sparse/1"))
    shutil.rmtree(root / "sparse/1")
    (root / "sparse/1").mkdir()
    model.write_text(str(root / "sparse/1"))
    shutil.copytree(make_scene("equal", views=9) / "sparse/0", root / "sparse/2")
    load_scene(root)
    assert caplog.messages == [f"{root}: {larger_models(root)}"]
    assert "sparse/0 has 9 images, sparse/1 has 10: COLMAP could not join them; --data.model=N" in caplog.text


def test_view_carries_its_own_name_pose_and_picture(make_scene: SceneFactory) -> None:
    root = make_scene(views=18)
    scene = load_scene(root)
    assert scene.test == (0, 8, 16)
    assert sorted(scene.train + scene.test) == list(range(18))
    reconstruction = import_pycolmap().Reconstruction(str(root / "sparse" / "0"))
    for i in range(len(scene)):
        view = scene.view(i)
        assert (view.index, view.name) == (i, f"{i:03d}.png")
        np.testing.assert_array_equal(view.image.numpy(), np.array(PIL.Image.open(root / "images" / view.name)))
        pose = reconstruction.find_image_with_name(view.name).cam_from_world().matrix()
        np.testing.assert_allclose(view.camera.viewmat[:3].numpy(), pose, rtol=1e-6)
    view = scene.view(3)
    pair = (each.smaller(2).image.int() for each in (view, replace(view, image=view.image / 255)))
    torch.testing.assert_close(*pair, atol=1, rtol=0)  # halves are rounded either way
    moved = move_data_to_device(view, torch.device("cpu"))  # Lightning's way to move a batch
    assert (moved.name, moved.index, moved.image.dtype) == ("003.png", 3, torch.uint8)


def test_a_view_that_is_where_it_should_be_is_not_rebuilt(make_scene: SceneFactory) -> None:
    view = load_scene(make_scene()).view(0)
    assert view.to("cpu") is view
    moved = view.to("meta")
    assert moved.image.device.type == "meta"
    assert moved.camera is view.camera  # kernels take its numbers from the host
    assert view.camera.to(dtype=torch.float64).K.dtype == torch.float64


def test_points_and_extent(make_scene: SceneFactory) -> None:
    root = make_scene()
    scene = load_scene(root)
    reconstruction = import_pycolmap().Reconstruction(str(root / "sparse" / "0"))
    ids = sorted(reconstruction.points3D)
    np.testing.assert_allclose(scene.points.numpy(), [reconstruction.points3D[i].xyz for i in ids], rtol=1e-6)
    np.testing.assert_allclose(scene.colors.numpy() * 255, [reconstruction.points3D[i].color for i in ids], atol=1e-4)
    assert scene.points.dtype == scene.colors.dtype == torch.float32
    centres = np.stack([-camera.viewmat[:3, 3].numpy() for camera in scene.cameras])  # rotations are 1
    expected = 1.1 * np.linalg.norm(centres - np.median(centres, axis=0), axis=1).max()
    assert scene.extent == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("noise", "apart"), [(0.0, False), (1e-6, False), (1e-2, True)])
def test_what_rounding_leaves_of_one_place_is_no_extent(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch, noise: float, apart: bool
) -> None:
    poses = read_poses(demo_scene)
    images = []
    for image, shift in zip(poses.images, np.random.default_rng(0).normal(0, noise, (9, 3)), strict=True):
        view = image.viewmat.copy()
        view[:3, 3] = -view[:3, :3] @ (poses.images[0].centre + shift)
        images.append(replace(image, viewmat=view))
    monkeypatch.setattr(scene_module, "read_poses", lambda *_, **__: replace(poses, images=tuple(images)))
    assert (load_scene(demo_scene).extent > 0) is apart


@pytest.mark.parametrize("value", [0, 255])
def test_points_that_have_no_colours_start_grey(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture, value: int
) -> None:
    """As those of programs that never look at the photos; a splat that starts black gets no gradient."""
    caplog.set_level("INFO", logger="nsvq_lightning")
    model = make_scene() / "sparse" / "0"
    before = load_scene(model.parents[1])
    assert not before.grey
    reconstruction = import_pycolmap().Reconstruction(str(model))
    for point in reconstruction.points3D.values():
        point.color = np.full(3, value, np.uint8)
    reconstruction.write_binary(str(model))
    scene = load_scene(model.parents[1])
    assert scene.grey
    assert torch.equal(scene.points, before.points)
    assert scene.colors.unique().tolist() == pytest.approx([128 / 255])
    assert f"the points of {scene.root} have no colours: they start grey" in caplog.text


def test_points_at_a_camera_centre_are_left_out(make_scene: SceneFactory, caplog: pytest.LogCaptureFixture) -> None:
    root = make_scene()
    scene = load_scene(root)
    assert not caplog.text
    model = root / "sparse" / "0"
    reconstruction = import_pycolmap().Reconstruction(str(model))
    beside = 0.01 * scene.extent * torch.eye(3)[0].double().numpy()
    for i in (0, 3):  # a test view and a train view
        centre = -scene.cameras[i].viewmat[:3, 3].double().numpy()  # rotations are 1
        for xyz in (centre, centre + 1e-5 * beside, centre + beside):
            reconstruction.add_point3D(xyz, import_pycolmap().Track(), np.zeros(3, np.uint8))
    reconstruction.write_binary(str(model))
    points = load_scene(root).points
    assert "left out 4 of 26 points: they are at the centre of a camera" in caplog.text
    assert torch.equal(points[:20], scene.points)
    assert len(points) == 22


@pytest.mark.parametrize(
    ("file", "arguments", "size"),
    [
        ((40, 32), {}, (40, 32)),
        ((40, 32), {"max_width": 30}, (30, 24)),
        ((40, 32), {"max_width": None}, (40, 32)),
        ((40, 32), {"factor": 1, "max_width": 30}, (40, 32)),
        ((40, 32), {"factor": 2}, (20, 16)),
        ((40, 32), {"factor": 8}, (5, 4)),
        ((20, 8), {}, (20, 8)),  # not what the model says
        ((1700, 100), {}, (1600, 94)),  # the published rule for wide pictures
    ],
)
def test_size_and_intrinsics(
    make_scene: SceneFactory, file: tuple[int, int], arguments: dict[str, int], size: tuple[int, int]
) -> None:
    view = load_scene(make_scene(views=2, image_size=file), **arguments).view(1)  # type: ignore[arg-type]
    assert tuple(view.image.shape) == (size[1], size[0], 3)
    assert (view.camera.width, view.camera.height) == size
    x, y = size[0] / 40, size[1] / 32
    assert view.camera.intrinsics == pytest.approx((30 * x, 31 * y, 21 * x, 15 * y))


def test_small_photos_of_other_names_are_told_with_the_way_out(make_scene: SceneFactory) -> None:
    root = make_scene()
    (root / "images_4").mkdir()
    for number in range(9):
        assert cv2.imwrite(str(root / "images_4" / f"image{number}.png"), np.zeros((8, 10, 3), np.uint8))
    with pytest.raises(SceneError, match="under the same names, or leave factor out"):
        load_scene(root, factor=4)


def test_downscaled_folder_is_used_where_there_is_one(make_scene: SceneFactory) -> None:
    root = make_scene()
    (root / "images_4").mkdir()
    for path in (root / "images").iterdir():  # another suffix and an odd size, as some data sets have it
        picture = np.full((8, 11, 3), int(path.stem), np.uint8)
        assert cv2.imwrite(str(root / "images_4" / f"{path.stem}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 100])
    view = load_scene(root, factor=4).view(5)
    assert tuple(view.image.shape) == (8, 11, 3)
    assert view.name == "005.png"
    assert set(view.image.flatten().tolist()) == {5}
    assert view.camera.intrinsics == pytest.approx((30 * 11 / 40, 31 / 4, 21 * 11 / 40, 15 / 4))
    assert tuple(load_scene(root, factor=2).view(5).image.shape) == (16, 20, 3)


def test_missing_and_damaged_pictures(make_scene: SceneFactory) -> None:
    root = make_scene()
    (root / "images" / "003.png").unlink()
    (root / "images" / "007.png").unlink()
    with pytest.raises(SceneError, match=r"2 of 9 images .* first 003\.png"):
        load_scene(root)
    root = make_scene("other")
    (root / "images" / "004.png").write_bytes(b"")
    with pytest.raises(SceneError, match=r"004\.png cannot be decoded"):
        load_scene(root).view(4)


@pytest.mark.parametrize("damage", ["empty", "cut", "masked", "transparent"])
def test_views_without_a_picture_are_left_out(
    make_scene: SceneFactory, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_scene()
    photo = root / "images" / "004.png"
    whole = usable(load_scene(root))
    assert (whole.train, whole.test) == ((1, 2, 3, 4, 5, 6, 7), (0, 8))
    match damage:
        case "empty":
            photo.write_bytes(b"")
        case "cut":
            photo.write_bytes(photo.read_bytes()[:-100])
        case "masked":
            write_masks(root, ["004.png"], np.zeros((32, 40), np.uint8))
        case _:
            assert cv2.imwrite(str(photo), np.zeros((32, 40, 4), np.uint8))
            with pytest.raises(SceneError, match="counts by its transparency: masks are white and photos opaque"):
                load_scene(root).view(4)
    scene = usable(load_scene(root))
    assert (scene.train, scene.test) == ((1, 2, 3, 5, 6, 7), (0, 8))
    assert scene.names == whole.names
    assert "left out 1 of 9 photos, first: " in caplog.text
    assert "004.png" in caplog.text
    for name in ("000.png", "008.png"):
        (root / "images" / name).write_bytes(b"")
    with pytest.raises(SceneError, match=r"000\.png cannot be decoded"):
        usable(load_scene(root))


CLOUD_ROW = [(axis, "<f8") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
MOVES: dict[str, tuple[np.ndarray, float]] = {
    "right": (np.eye(3), 0.0),
    "turned": (np.diag([1.0, -1.0, -1.0]), 0.0),
    "mirrored": (np.diag([-1.0, 1.0, 1.0]), 0.0),
    "exchanged": (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), 0.0),
    "millimetres": (1000 * np.eye(3), 0.0),
    "map": (np.eye(3), 5e5),
}


def cloud_scene(demo: Path, root: Path, move: str, gray: float | None = None) -> Path:
    """The demo scene with its points in a file of their own, moved; ``gray``: contrast of intensities for colours."""
    scene = load_scene(demo)
    shutil.copytree(demo, root)
    (root / "sparse/0/points3D.bin").unlink()
    rows = np.zeros(len(scene.points), CLOUD_ROW)
    turn, shift = MOVES[move]
    for axis, values in zip("xyz", (scene.points.double().numpy() @ turn.T + shift).T, strict=True):
        rows[axis] = values
    for name, channel in zip(("red", "green", "blue"), scene.colors.T, strict=True):
        rows[name] = (255 * channel).round() if gray is None else 128 + gray * scene.colors[:, 0]
    write_elements(root / "points3D.ply", {"vertex": rows})
    return root


@pytest.mark.parametrize("move", MOVES)
def test_points_that_are_not_where_photos_show_them_make_way(
    demo_scene: Path, tmp_path: Path, move: str, caplog: pytest.LogCaptureFixture
) -> None:
    scene = load_scene(cloud_scene(demo_scene, tmp_path / "scene", move))
    wrong = move != "right"
    assert (scene.cloud, scene.grey, is_elsewhere(scene)) == (True, False, wrong)
    found = usable(scene)
    assert (found.grey, ("are not where the photos show their colours" in caplog.text)) == (wrong, wrong)
    assert (len(found.points) == RANDOM_POINTS) == wrong
    assert found.extent == pytest.approx(EXTENT * found.frame.unit)  # also where points are too far for parallax
    if wrong:
        assert seen_by(found.train_cameras, found.points.numpy()).any(0).mean() > 0.9


@pytest.mark.parametrize("track", ["", " 1 0"])
def test_points_of_a_table_that_no_two_photos_saw_may_be_elsewhere(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, track: str
) -> None:
    monkeypatch.setattr(colmap, "MAX_UNSEEN", 100)
    for move in ("right", "turned"):
        root = cloud_scene(demo_scene, tmp_path / move, move)
        scene = load_scene(root)
        (root / "points3D.ply").unlink()
        lines = []
        for number, (point, color) in enumerate(zip(scene.points.tolist(), scene.colors.tolist(), strict=True), 1):
            rgb = [round(255 * channel) for channel in color]
            lines.append(" ".join(map(str, [number, *point, *rgb, 0])) + track + "\n")
        (root / "sparse/0/points3D.txt").write_text("".join(lines))
        scene = load_scene(root)
        assert (scene.cloud, scene.grey, is_elsewhere(scene)) == (True, False, move == "turned")
        observations = read_model(root, observations=True).observations
        assert observations is not None
        assert not len(observations)  # doctor would take them for what photos share


def test_points_that_masks_leave_out_say_nothing_of_the_others(shared_scenes: Path, tmp_path: Path) -> None:
    """Those before and behind an object, which is all that masks leave."""
    root = tmp_path / "scene"
    root.mkdir()
    for path in (shared_scenes / "kitchen25").iterdir():
        (root / path.name).symlink_to(path)
    scene = load_scene(root, factor=8)
    middle = scene.points.median(0).values.double().numpy()[None]
    (root / "masks").mkdir()
    for name, camera in zip(scene.names, scene.cameras, strict=True):
        mask = np.zeros((camera.height, camera.width), np.uint8)
        column, row, _ = projected(middle, camera)
        cv2.circle(mask, (int(column[0]), int(row[0])), camera.height // 4, 255, -1)
        cv2.imwrite(str(root / "masks" / f"{name}.png"), mask)
    scene = load_scene(root, factor=8)
    for turn, wrong in (1.0, False), (-1.0, True):
        points = scene.points * torch.tensor([1.0, turn, turn])
        assert is_elsewhere(replace(scene, points=points, cloud=True)) == wrong


def test_poses_that_do_not_show_the_points_of_their_model_are_told(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    right = load_scene(demo_scene)
    wrong = replace(right, points=right.points * torch.tensor([1.0, -1, -1]))
    assert usable(wrong) is wrong  # they are few
    monkeypatch.setattr("nsvq_lightning.data.scene._FEW_POINTS", len(right.points) - 1)
    assert usable(right) is right
    assert "show their colours" not in caplog.text
    assert usable(wrong) is wrong
    assert "poses from world to camera and quaternions wxyz" in caplog.text
    assert "random ones" not in caplog.text


@pytest.mark.parametrize(("scale", "degrees", "wrong"), [(1, 0, False), (0.3, 0, True), (3, 0, True), (1, 30, True)])
def test_splats_in_another_frame_than_the_photos_are_told_by_their_colors(
    demo_scene: Path, monkeypatch: pytest.MonkeyPatch, scale: float, degrees: float, wrong: bool
) -> None:
    """As nerfstudio's and gsplat's, scaled and turned about the cameras, which then show them all the same."""
    scene = load_scene(demo_scene)
    sh0 = ((scene.colors - 0.5) / SH_C0)[:, None].numpy()
    middle = np.mean([camera.packed_view[12:] for camera in scene.cameras], axis=0)
    turn = scale * Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    means = ((scene.points.numpy() - middle) @ turn.T + middle).astype(np.float32)
    check_cameras(scene.cameras, means)
    check_colors(scene, means, sh0)  # few
    monkeypatch.setattr("nsvq_lightning.data.scene._FEW_POINTS", len(means) - 1)
    with pytest.raises(ValueError, match="not where the photos show") if wrong else contextlib.nullcontext():
        check_colors(scene, means, sh0)


def test_damaged_photos_say_nothing_of_splats(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Runs leave them out; they took the cameras of all others away."""
    shutil.copytree(demo_scene, tmp_path / "scene")
    photo = tmp_path / "scene/images/view_003.png"
    photo.write_bytes(photo.read_bytes()[:300])
    scene = load_scene(tmp_path / "scene")
    monkeypatch.setattr("nsvq_lightning.data.scene._FEW_POINTS", len(scene.points) - 1)
    check_colors(scene, scene.points.numpy(), scene.colors[:, None].numpy())


def test_a_cast_and_points_that_are_in_photos_by_chance_say_nothing_of_places(demo_scene: Path) -> None:
    """Where all is green, colours are alike wherever they are taken from."""
    cast = torch.tensor([0.1, 0.9, 0.4])
    scene = load_scene(demo_scene)
    green = [Picture((image * cast).to(torch.uint8), mask) for image, mask in (scene.images[k] for k in range(9))]
    scene = replace(scene, images=ImageStore((), held=green), colors=scene.colors * cast, cloud=True)
    assert not is_elsewhere(scene)
    assert is_elsewhere(replace(scene, points=0.3 * scene.points))
    far = scene.points.clone()
    far[2:] += 1000
    assert is_elsewhere(replace(scene, points=far))


def test_points_are_taken_where_nothing_says_that_they_are_wrong(demo_scene: Path, tmp_path: Path) -> None:
    for contrast, colourless in ((0.0, True), (100.0, False)):
        scene = load_scene(cloud_scene(demo_scene, tmp_path / str(contrast), "turned", contrast))
        assert (scene.cloud, scene.grey) == (True, colourless)
        assert not is_elsewhere(scene)
    assert not load_scene(demo_scene).cloud


def test_home_is_a_tilde(make_scene: SceneFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    root = make_scene()
    monkeypatch.setenv("HOME", str(root.parent))
    assert load_scene("~/scene").root == root
    assert ColmapDataModule("~/scene").root == root


def test_a_photo_that_is_deleted_while_a_run_reads_it_is_named(make_scene: SceneFactory) -> None:
    root = make_scene()
    scene = load_scene(root, cache_bytes=0)
    (root / "images" / "003.png").unlink()
    with pytest.raises(SceneError, match=r"003\.png cannot be read any more \(No such file .*\): it was there when"):
        scene.view(3)


@pytest.mark.parametrize("name", [b"../3.pn", b"/03.png", b"x/../.p"])
def test_photos_outside_the_folder_are_refused(name: bytes, make_scene: SceneFactory) -> None:
    root = make_scene()
    table = root / "sparse" / "0" / "images.bin"
    table.write_bytes(table.read_bytes().replace(b"003.png", name))
    with pytest.raises(SceneError, match=rf"the COLMAP model of {root} names {name.decode()}, which is not in"):
        load_scene(root)
    if name == b"../3.pn":
        (root / "images" / "003.png").rename(root / "3.pn")
        data = ColmapDataModule(str(root), allow_outside=True)
        assert data.scene.names[0] == "../3.pn"
        assert data.scene.view(0).image.shape == (32, 40, 3)


def test_names_that_are_not_utf_8_are_refused(make_scene: SceneFactory) -> None:
    root = make_scene()
    with pytest.raises(SceneError, match=r"--data\.root names '.*\\udcff', which is not UTF-8: rename"):
        load_scene(make_scene("plain").rename(root.with_name("scene\udcff")))
    with pytest.raises(SceneError, match=r"the scene to prepare names 'a\\udcff\.jpg', which is not UTF-8"):
        reconstruct(root, {"a\udcff.jpg": ImageHead((1, 1), 1, has_alpha=False)}, print)


def test_missing_image_folder(make_scene: SceneFactory) -> None:
    root = make_scene()
    shutil.move(root / "images", root / "images_2")
    assert len(load_scene(root)) == 9
    assert len(load_scene(root, factor=2)) == 9
    shutil.copytree(root / "images_2", root / "images_4")
    with pytest.raises(SceneError, match=r"such as .*dense/0, as the scene; they are in images_2 and images_4$"):
        load_scene(root)
    assert len(load_scene(root, images_folder="images_2")) == 9
    shutil.rmtree(root / "images_2")
    shutil.rmtree(root / "images_4")
    with pytest.raises(SceneError, match=r"they are in no other folder up to two levels down$"):
        load_scene(root)


def test_split_without_train_views(make_scene: SceneFactory) -> None:
    with pytest.raises(SceneError, match="leave 0 train and 1 test views"):
        load_scene(make_scene(views=1))
    assert load_scene(make_scene("two", views=2)).train == (1,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"factor": 3}, "factor must be .* got 3"),
        ({"test_every": 1}, "test_every must be at least 2"),
        ({"max_width": 0}, "max_width"),
    ],
)
def test_arguments_out_of_range(make_scene: SceneFactory, arguments: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_scene(make_scene(), **arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "views", "test", "points", "size"),
    [("flower25", 25, 4, 19679, (696, 521)), ("fox", 50, 7, 13450, (448, 800)), ("horns", 62, 8, 5527, (499, 374))],
)
def test_real_captures(
    shared_scenes: Path, name: str, views: int, test: int, points: int, size: tuple[int, int]
) -> None:
    if not (shared_scenes / name).is_dir():
        pytest.skip(f"the capture {name} is not here")
    scene = load_scene(shared_scenes / name)
    assert (len(scene), len(scene.test), len(scene.points)) == (views, test, points)
    view = scene.view(scene.test[1])
    assert (view.camera.width, view.camera.height) == size
    assert tuple(view.image.shape) == (size[1], size[0], 3)
    # the points this photo was matched at must project onto pixels of their colour; one model comes without matches
    reconstruction = import_pycolmap().Reconstruction(str(shared_scenes / name / "sparse" / "0"))
    ids = {p.point3D_id for p in reconstruction.find_image_with_name(view.name).points2D if p.has_point3D()}
    rows = torch.tensor([not ids or i in ids for i in sorted(reconstruction.points3D)])
    local = scene.points[rows] @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
    pixels = local @ view.camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inside = (pixels >= 0).all(1) & (pixels < torch.tensor(size)).all(1)
    assert inside.float().mean() > (0.99 if ids else 0.7)
    x, y = pixels[inside].long().T
    pair = view.image[y, x].double().mean(1), scene.colors[rows][inside].double().mean(1)
    assert torch.corrcoef(torch.stack(pair))[0, 1] > (0.85 if ids else 0.6)


HALF = np.zeros((32, 40), np.uint8)
HALF[:, :20] = 255
KEPT = torch.from_numpy(HALF > 0)


def write_masks(root: Path, names: list[str], mask: np.ndarray = HALF) -> None:
    (root / "masks").mkdir(exist_ok=True)
    for name in names:
        assert cv2.imwrite(str(root / "masks" / name), mask)


def mask_of(root: Path, index: int, **options: Any) -> torch.Tensor:
    mask = load_scene(root, **options).view(index).mask
    assert mask is not None
    return mask


def test_masks_of_colmap_and_nerfstudio_are_found_by_their_names(make_scene: SceneFactory) -> None:
    root = make_scene(views=4)
    write_masks(root, ["000.png.png", "001.png", "002.jpg"])
    scene = load_scene(root)
    for index in range(3):
        view = scene.view(index)
        assert torch.equal(mask_of(root, index), KEPT)
        assert (view.image[:, 20:] == 0).all()
        assert view.image[:, :20].float().mean() > 20
    assert scene.view(3).mask is None
    assert load_scene(root, masks=None).view(0).mask is None
    assert load_scene(root, masks="elsewhere").view(0).mask is None


@pytest.mark.parametrize("levels", [(0, 1), (0, 255), (3, 200)])
@pytest.mark.parametrize("size", [(40, 32), (80, 64), (20, 16)])
def test_masks_of_any_levels_and_sizes(
    make_scene: SceneFactory, levels: tuple[int, int], size: tuple[int, int]
) -> None:
    root = make_scene(views=2)
    mask = cv2.resize(np.where(HALF > 0, np.uint8(levels[1]), np.uint8(levels[0])), size, interpolation=0)
    write_masks(root, ["000.png", "001.png"], mask)
    assert torch.equal(mask_of(root, 0), KEPT)


def test_masks_of_full_size_fit_photos_that_were_rounded() -> None:
    assert same_shape((194, 130), (25, 16))
    assert same_shape((25, 17), (25, 16))
    assert not same_shape((194, 130), (25, 12))


def test_a_pixel_counts_only_if_all_that_it_is_made_of_counts(make_scene: SceneFactory) -> None:
    root = make_scene(views=2)
    mask = HALF.copy()
    mask[:, 20] = 255  # 21 columns: the middle one at half size is mixed
    write_masks(root, ["000.png"], mask)
    kept = mask_of(root, 0, factor=2)
    assert kept.shape == (16, 20)
    assert kept.sum(1).tolist() == [10] * 16


def test_masks_are_undistorted_with_their_photo(make_scene: SceneFactory) -> None:
    root = make_scene(views=2, model="SIMPLE_RADIAL", params=(30.0, 20.0, 16.0, 0.1))
    photo = np.repeat(HALF[..., None], 3, 2)
    for name in ("000.png", "001.png"):
        assert cv2.imwrite(str(root / "images" / name), photo)
    write_masks(root, ["000.png"])
    mask, whole = mask_of(root, 0), load_scene(root).view(1).image
    assert (whole[mask] > 250).all()
    assert (whole[~mask] > 250).float().mean() < 0.1


def test_pixels_that_a_wide_lens_never_saw_do_not_count(make_scene: SceneFactory) -> None:
    root = make_scene(views=2, model="SIMPLE_RADIAL", params=(30.0, 20.0, 16.0, 0.1))
    write_masks(root, ["000.png"])
    scene = load_scene(root)
    undistortion = scene.images.sources[0].undistortion
    assert undistortion is not None
    _, _, blank = undistortion.maps()
    blank[:4] = True
    masked, kept = scene.view(0).mask, scene.view(1).mask
    assert kept is not None
    assert torch.equal(kept, torch.from_numpy(~blank))
    assert masked is not None
    assert not masked[:4].any()
    assert masked[4:].float().mean() < 0.6


def test_transparent_pixels_do_not_count(make_scene: SceneFactory) -> None:
    root = make_scene(views=3)
    for name, alpha in (("000.png", HALF), ("001.png", np.full_like(HALF, 255))):
        path = root / "images" / name
        assert cv2.imwrite(str(path), np.dstack([cv2.imread(str(path)), alpha]))
    assert torch.equal(mask_of(root, 0), KEPT)
    assert load_scene(root).view(1).mask is None
    upper = np.flipud(np.tri(32, 40, dtype=np.uint8) * 255)
    write_masks(root, ["000.png"], upper)
    assert torch.equal(mask_of(root, 0), KEPT & torch.from_numpy(upper > 0))


def test_scenes_of_nerf_synthetic_are_in_front_of_white(demo_scene: Path, tmp_path: Path) -> None:
    root = write_blender(demo_scene, tmp_path / "lego")
    scene = load_scene(root)
    view = scene.view(4)
    assert view.mask is None
    assert (view.image[:, :24] == 255).all()
    assert (view.image[:, 24:] < 250).any()
    trainer = quiet_trainer(tmp_path, 2)
    module, data = SplatModule(sh_degree=0, codebooks=None), ColmapDataModule(str(root))
    trainer.fit(module, data)
    assert module.background == "white"
    with pytest.raises(ValueError, match=r"white around their objects, model\.background is black: leave it at auto"):
        trainer.fit(SplatModule(sh_degree=0, codebooks=None, background="black"), ColmapDataModule(str(root)))


def test_transparent_photos_that_their_object_fills_are_in_front_of_white(demo_scene: Path, tmp_path: Path) -> None:
    root = write_blender(demo_scene, tmp_path / "lego")
    for path in root.glob("*/*.png"):
        photo = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        photo[:2] = 40, 40, 40, 255
        assert cv2.imwrite(str(path), photo)
    assert load_scene(root).white


@pytest.mark.parametrize(("behind", "white"), [(0, False), (240, False), (255, True)])
def test_opaque_photos_of_such_scenes_have_the_background_that_they_show(
    demo_scene: Path, tmp_path: Path, behind: int, white: bool
) -> None:
    root = write_blender(demo_scene, tmp_path / "lego")
    for path in root.glob("*/*.png"):
        photo = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        photo[photo[..., 3] == 0] = behind
        photo[:2] = behind
        assert cv2.imwrite(str(path), photo[..., :3])
    scene = load_scene(root)
    assert scene.white == white
    assert (scene.view(4).image[:, :24] == behind).all()


def test_opaque_photos_with_an_alpha_channel_have_the_background_that_they_show(
    demo_scene: Path, tmp_path: Path
) -> None:
    root = write_blender(demo_scene, tmp_path / "lego")
    for path in root.glob("*/*.png"):  # as Blender writes them
        photo = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        photo[:2] = 30
        photo[..., 3] = 255
        assert cv2.imwrite(str(path), photo)
    assert not load_scene(root).white
    first = load_scene(root).images.sources[0].path
    first.write_bytes(first.read_bytes()[:60])
    assert not load_scene(root).white


def walls(rooms: int) -> Any:
    """Rooms in a row, 4 units apart, with noise on the walls between them; a photo of each wall, far ones behind it."""
    rng, width = np.random.default_rng(0), 64
    cameras, pictures, points, colors = [], [], [], []
    for room in range(rooms):
        texture = cv2.resize(rng.integers(0, 256, (8, 8, 3), np.uint8), (width, width), interpolation=cv2.INTER_CUBIC)
        view = torch.eye(4)
        view[2, 3] = -4.0 * room
        cameras.append(Camera(torch.tensor([[32.0, 0, 32], [0, 32, 32], [0, 0, 1]]), view, width, width))
        pictures.append(Picture(torch.from_numpy(texture), None))
        at = rng.integers(2, width - 2, (200, 2))
        points.append(np.c_[(at + 0.5 - 32) / 32 * 3, np.full(200, 4.0 * room + 3)])
        colors.append(texture[at[:, 1], at[:, 0]] / 255)
    places, shown = torch.from_numpy(np.concatenate(points)).float(), torch.from_numpy(np.concatenate(colors)).float()
    return SimpleNamespace(
        cloud=True, points=places, colors=shown, train=range(rooms), images=pictures, cameras=cameras
    )


def test_walls_between_rooms_make_no_points_wrong() -> None:
    scene = walls(16)
    assert not is_elsewhere(scene)
    scene.points.neg_()
    scene.points[:, 2] *= -1
    assert is_elsewhere(scene)


def test_points_that_are_no_numbers_are_left_out(demo_scene: Path, tmp_path: Path) -> None:
    cloud = cloud_scene(demo_scene, tmp_path / "scene", "right") / "points3D.ply"
    content = cloud.read_bytes()
    cloud.write_bytes(content[:-27] + np.float64(np.nan).tobytes() + content[-19:])
    points = load_scene(cloud.parent).points
    assert torch.isfinite(points).all()
    assert len(points) == len(load_scene(demo_scene).points) - 1


def test_photos_of_a_model_inside_are_those_beside_it(demo_scene: Path, tmp_path: Path) -> None:
    root = tmp_path / "scene"
    shutil.copytree(demo_scene, root / "dense")
    shutil.copytree(demo_scene / "images", root / "images")
    for path in (root / "images").iterdir():
        path.write_bytes(cv2.imencode(path.suffix, 255 - cv2.imread(str(path)))[1].tobytes())
    expected = load_scene(demo_scene).view(2).image
    for model in (None, "dense/sparse/0", str(root / "dense" / "sparse" / "0")):
        assert torch.equal(load_scene(root, model=model).view(2).image, expected)
    shutil.copytree(demo_scene / "sparse", root / "sparse")
    assert not torch.equal(load_scene(root).view(2).image, expected)


def test_what_a_transforms_file_inside_names_lies_beside_it(demo_scene: Path, tmp_path: Path) -> None:
    root = tmp_path / "scene"
    inside = write_nerfstudio(demo_scene, root / "export")
    shutil.copytree(inside / "images", root / "images")
    for path in (root / "images").iterdir():
        path.write_bytes(cv2.imencode(path.suffix, 255 - cv2.imread(str(path)))[1].tobytes())
    scene, expected = load_scene(root, model=str(inside / "transforms.json")), load_scene(inside)
    assert torch.equal(scene.view(2).image, expected.view(2).image)
    assert torch.equal(scene.points, expected.points)
    other = load_scene(root, model="export/transforms.json", images_folder="./images")
    assert not torch.equal(other.view(2).image, expected.view(2).image)


def test_a_folder_of_masks_that_is_asked_for_counts_before_those_named(demo_scene: Path, tmp_path: Path) -> None:
    root = write_nerfstudio(demo_scene, tmp_path / "scene")
    document = json.loads((root / "transforms.json").read_text())
    for name, rows in (("named", 10), ("asked", 20)):
        mask = np.full((72, 96), 255, np.uint8)
        mask[:rows] = 0
        for frame in document["frames"]:
            path = root / name / Path(frame["file_path"]).with_suffix(".png").name
            path.parent.mkdir(exist_ok=True)
            assert cv2.imwrite(str(path), mask)
            frame["mask_path"] = f"named/{path.name}"
    (root / "transforms.json").write_text(json.dumps(document))
    for masks, rows in (("masks", 10), ("asked", 20)):
        assert int((~load_scene(root, masks=masks).view(1).mask).sum()) == rows * 96
    shutil.rmtree(root / "named")
    assert int((~load_scene(root, masks="asked").view(1).mask).sum()) == 20 * 96


def test_folders_that_are_links_are_searched(demo_scene: Path, tmp_path: Path) -> None:
    root = tmp_path / "scene"
    shutil.copytree(demo_scene, root)
    (tmp_path / "elsewhere").mkdir()
    for path in (root / "images").iterdir():
        assert cv2.imwrite(str(tmp_path / "elsewhere" / f"{path.stem}.png"), np.eye(72, 96, dtype=np.uint8))
    (root / "masks").mkdir()
    (root / "masks" / "all").symlink_to(tmp_path / "elsewhere")
    names = [path.name for path in photos_below(root / "masks")]
    assert names == sorted(path.name for path in (tmp_path / "elsewhere").iterdir())


def test_masks_that_a_transforms_file_names(demo_scene: Path, tmp_path: Path) -> None:
    root = write_nerfstudio(demo_scene, tmp_path / "scene")
    (root / "other").mkdir()
    mask = np.full((72, 96), 255, np.uint8)
    mask[:10] = 0
    assert cv2.imwrite(str(root / "other/m.png"), mask)
    document = json.loads((root / "transforms.json").read_text())
    first = min(document["frames"], key=lambda frame: frame["file_path"])
    first["mask_path"] = "other/m.png"
    (root / "transforms.json").write_text(json.dumps(document))
    assert int((~mask_of(root, 0)).sum()) == 960
    assert load_scene(root).view(1).mask is None
    first["mask_path"] = "other/gone.png"
    (root / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(SceneError, match=r"1 masks do not exist, first .*gone\.png"):
        load_scene(root)


def test_useless_masks_are_named(make_scene: SceneFactory, caplog: pytest.LogCaptureFixture) -> None:
    root = make_scene(views=2)
    write_masks(root, ["nobody.png"])
    load_scene(root)
    assert "masks has no mask of any photo: that of 000.png would be 000.png.png or 000.png" in caplog.text
    for mask, message in (
        (np.zeros((32, 40), np.uint8), r"no pixel of .*000\.png counts by its mask .*masks/000\.png: masks are white"),
        (np.full((40, 32), 255, np.uint8), r"mask .*000\.png is of 32x40, its photo of 40x32, another shape"),
        (np.full((35, 44), 255, np.uint8), r"mask .*000\.png is of 44x35, its photo of 40x32, another shape"),
    ):
        write_masks(root, ["000.png"], mask)
        with pytest.raises(SceneError, match=message):
            load_scene(root).view(0)
    (root / "masks/000.png").write_bytes(b"text")
    with pytest.raises(SceneError, match=r"masks/000\.png cannot be decoded"):
        load_scene(root).view(0)


def test_excluded_pixels_carry_no_loss_and_no_metric(demo_scene: Path, tmp_path: Path) -> None:
    """Two folders whose photos differ in excluded pixels only train to the same splats and scores, bit for bit."""
    mask = np.full((72, 96), 255, np.uint8)
    mask[20:50, 30:80] = 0
    results = []
    for number, spoiled in enumerate((False, True)):
        root = tmp_path / f"scene{number}"
        for folder in ("images", "masks"):
            (root / folder).mkdir(parents=True)
        os.symlink(demo_scene / "sparse", root / "sparse", target_is_directory=True)
        for path in sorted((demo_scene / "images").iterdir()):
            photo = cv2.imread(str(path))
            if spoiled:
                photo[mask == 0] = np.random.default_rng(1).integers(0, 256, (1500, 3))
            assert cv2.imwrite(str(root / "images" / path.name), photo)
            assert cv2.imwrite(str(root / "masks" / f"{path.name}.png"), mask)
        trainer = quiet_trainer(tmp_path, 5)
        module, data = SplatModule(sh_degree=0, codebooks=None), ColmapDataModule(str(root))
        trainer.fit(module, data)
        scores = trainer.test(module, data, verbose=False)[0]
        results.append((scores, module.splats.means.detach().clone(), module.splats.sh0.detach().clone()))
        image = module.scene.render(module.splats.raw(), data.scene.cameras[0]).image.detach()
        assert (image[mask == 0] > 0.05).any()  # something is there all the same
    (scores, *splats), (others, *others_splats) = results
    assert scores == others
    assert all(torch.equal(a, b) for a, b in zip(splats, others_splats, strict=True))
    assert 5 < scores["test/psnr"] < 40


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_photos_are_turned_where_their_cameras_are(
    make_scene: SceneFactory, orientation: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Some programs calibrate photos as they are shown, COLMAP as they are stored."""
    caplog.set_level("INFO", logger="nsvq_lightning")
    root = make_scene(views=2, size=(32, 40))
    pixels = np.zeros((32, 40, 3), np.uint8)
    pixels[:8, :20] = 250, 10, 10
    tags = PIL.Image.Exif()
    tags[274] = orientation
    for path in (root / "images").iterdir():
        PIL.Image.fromarray(pixels).save(path, "JPEG", quality=95, exif=tags)
    scene = load_scene(root)
    assert "2 of 2 photos are turned by their EXIF orientation" in caplog.text
    with PIL.Image.open(root / "images/000.png") as stored:
        shown = np.asarray(PIL.ImageOps.exif_transpose(stored)).astype(int)
    assert np.abs(scene.view(0).image.numpy() - shown).max() < 25
    assert "stored on their side" not in caplog.text
    assert load_scene(make_scene("stored", views=2)).images.sources[0].orientation == 1
    assert "stored on their side" not in caplog.text


def test_photos_on_their_side_with_cameras_that_are_too_are_told(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture
) -> None:
    """As those of a phone that COLMAP was run on by itself: the whole scene lies."""
    root = make_scene(views=3, size=(32, 40))
    tags = PIL.Image.Exif()
    tags[274] = 6
    for number in range(2):
        PIL.Image.fromarray(np.zeros((40, 32, 3), np.uint8)).save(root / f"images/00{number}.png", "JPEG", exif=tags)
    assert [source.orientation for source in load_scene(root).images.sources] == [1, 1, 1]
    assert "2 photos are stored on their side, so the scene is: nsvq prepare" in caplog.text


@pytest.mark.parametrize("orientation", [2, 3, 4])
def test_photos_that_keep_their_shape_are_turned_where_others_are(make_scene: SceneFactory, orientation: int) -> None:
    """What one photo says of the program holds for all."""
    root = make_scene(views=3, size=(32, 40))
    pixels = np.zeros((40, 32, 3), np.uint8)
    pixels[:8, :20] = 250, 10, 10
    for number in range(3):
        tags = PIL.Image.Exif()
        tags[274] = (orientation, 6, 1)[number]
        stored = pixels.transpose(1, 0, 2) if number == 1 else pixels
        PIL.Image.fromarray(stored).save(root / f"images/00{number}.png", "JPEG", quality=95, exif=tags)
    scene = load_scene(root)
    assert [source.orientation for source in scene.images.sources] == [orientation, 6, 1]
    for number in range(3):
        with PIL.Image.open(root / f"images/00{number}.png") as photo:
            shown = np.asarray(PIL.ImageOps.exif_transpose(photo)).astype(int)
        assert np.abs(scene.view(number).image.numpy() - shown).max() < 25


def test_detail_is_seen_in_fog_and_in_the_dark_and_rounding_is_none(make_scene: SceneFactory) -> None:
    """Photos of chequers of 8 pixels: at their edges, a pixel differs from its neighbours, whatever the contrast."""
    root, found = make_scene(), []
    chequers = np.kron(np.indices((4, 5)).sum(0) % 2, np.ones((8, 8)))[:, :, None].repeat(3, 2)
    for low, high in ((0, 255), (100, 125), (0, 12), (100, 101)):
        for path in (root / "images").iterdir():
            cv2.imwrite(str(path), (low + (high - low) * chequers).astype(np.uint8))
        found.append(detailed_pixels(load_scene(root)))
    bright, fog, dark, rounding = found
    assert bright > 0
    assert fog == dark == bright
    assert rounding == 0
    # What masks leave out is black, and no contrast.
    for path in (root / "images").iterdir():
        cv2.imwrite(str(path), (100 + 4 * chequers).astype(np.uint8))
    write_masks(root, [path.name for path in (root / "images").iterdir()])
    assert detailed_pixels(load_scene(root)) > 0.4 * fog


@pytest.mark.parametrize(("photos", "expected"), [(4, 1.0), (40, 4.0), (400, 8.0)])
@pytest.mark.parametrize("way", ["a wall", "a tunnel"])
def test_a_walk_stretches_farther_than_what_all_photos_show(photos: int, expected: float, way: str) -> None:
    """Beside each camera is a point that two show from near; in a tunnel, all that come before show it from afar."""
    axes = {"a wall": np.eye(3), "a tunnel": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])}[way]
    lens = (50.0, 50.0, 50.0, 50.0)
    cameras = [camera_of(view_from(axes, np.array([x, 0.0, 0.0])), lens, 100, 100) for x in range(photos)]
    first = np.array({"a wall": [0.5, 0, 1], "a tunnel": [1.1, 0, 1]}[way])
    points = torch.tensor(first + np.eye(3)[0] * np.arange(photos - 1)[:, None]).float().repeat(1000, 1)
    scene: Any = SimpleNamespace(train_cameras=cameras, points=points)
    assert stretch(scene) == pytest.approx(expected, rel=0.01)
    scene.points = points + torch.tensor([0.0, 999, 0])  # in no picture
    assert stretch(scene) == 1.0


def test_cameras_of_a_survey_show_it() -> None:
    """A camera of 3000 shows a thousandth of the ground, and every tenth of them a tenth of it."""
    down = np.diag([1.0, -1, -1])
    lens = (50.0, 50.0, 50.0, 50.0)
    places = np.stack(np.meshgrid(np.arange(60.0), np.arange(50.0), [0.5]), axis=-1).reshape(-1, 3)
    cameras = [camera_of(view_from(down, place), lens, 100, 100) for place in places]
    ground = np.random.default_rng(0).uniform((-0.5, -0.5, 0), (59.5, 49.5, 0), (50_000, 3)).astype(np.float32)
    check_cameras(cameras, ground)
    with pytest.raises(ValueError, match="of another scene"):
        check_cameras(cameras, 3 * ground)


def test_a_rig_whose_first_camera_is_the_test_is_told(
    make_scene: SceneFactory, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_scene(views=24)
    load_scene(root)
    assert not caplog.records
    model = import_pycolmap().Reconstruction(root / "sparse/0")
    for image in model.images.values():
        number = int(image.name[:3])
        (root / "images" / image.name).rename(root / f"images/{number // 8:05d}_{number % 8}.png")
        image.name = f"{number // 8:05d}_{number % 8}.png"
    model.write(root / "sparse/0")
    scene = load_scene(root)
    assert {scene.names[view][-6:] for view in scene.test} == {"_0.png"}
    assert "all 3 test photos end in 0" in caplog.text
    assert "--data.test_every=9 takes turns" in caplog.text
    caplog.clear()
    load_scene(root, test_every=9)
    assert not caplog.records


def test_some_rows_are_spread_over_all() -> None:
    assert spread(range(10), 4) == range(0, 10, 3)
    assert spread((), 4) == ()
    assert spread([1, 2], 4) == [1, 2]


@pytest.mark.parametrize("kind", [torch.int64, torch.uint16, torch.float32])
def test_photos_of_other_numbers_are_refused(kind: torch.dtype) -> None:
    photo = 255 * torch.rand(8, 8, 3)
    camera = Camera(torch.eye(3), torch.eye(4), 8, 8)
    with pytest.raises(ValueError, match=rf"the photo a.png is {kind} of up to 2\d\d.*, not uint8 or float in"):
        View("a.png", 0, camera, photo.to(kind))
    with pytest.raises(ValueError, match=r"float32 of up to \S+, from -0.9\d+, not uint8 or float in"):
        View("a.png", 0, camera, photo / 127.5 - 1)
    assert View("a.png", 0, camera, photo / 255).to("cpu").image.dtype == torch.float32
