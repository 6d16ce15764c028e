import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_scenes import front_camera, random_splats

from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.camera_paths import orbit, read_camera_path, read_cameras, reframed, smooth_path
from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.poses import looked_at
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import Splats


def camera(position: Any, rotation: Rotation | None = None, focal: float = 100.0) -> Camera:
    """A camera of 80x60 whose rotation leads from its axes to those of the world."""
    matrix = np.eye(3) if rotation is None else rotation.as_matrix()
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = matrix.T, -matrix.T @ np.asarray(position, float)
    intrinsics = torch.tensor([[focal, 0.0, 41.0], [0.0, focal, 30.0], [0.0, 0.0, 1.0]])
    return Camera(intrinsics, torch.from_numpy(view).float(), 80, 60)


def around(angles: Any, radius: float = 2.0) -> list[Camera]:
    """Cameras on a level circle about (1, 2, 3) that look at it; y is down."""
    made = []
    for angle in angles:
        arm = radius * np.array([math.sin(angle), -0.5, -math.cos(angle)])
        tilt = -math.atan(0.5)
        made.append(camera(np.array([1.0, 2.0, 3.0]) + arm, Rotation.from_euler("YX", [-angle, tilt])))
    return made


def pose(seen: Camera) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    packed = np.array(seen.packed_view)
    return packed[12:], packed[:9].reshape(3, 3)


def test_a_path_passes_every_camera_at_even_speed() -> None:
    generator = np.random.default_rng(3)
    places = generator.normal(size=(5, 3)) + 3 * np.arange(5)[:, None] * [1, 0, 0]
    turns = Rotation.from_rotvec(0.3 * generator.normal(size=(5, 3)))
    given = [camera(place, turn, 100 + 10 * k) for k, (place, turn) in enumerate(zip(places, turns, strict=True))]
    path = smooth_path(given, 400)
    assert len(path) == 400
    positions = np.array([pose(seen)[0] for seen in path])
    for key in given:
        place, rotation = pose(key)
        nearest = int(np.argmin(np.linalg.norm(positions - place, axis=1)))
        assert np.linalg.norm(positions[nearest] - place) < 0.05
        assert pose(path[nearest])[1] == pytest.approx(rotation, abs=0.05)
        assert path[nearest].intrinsics[0] == pytest.approx(key.intrinsics[0], abs=0.5)
    for end, key in ((path[0], given[0]), (path[-1], given[-1])):
        assert end.viewmat.numpy() == pytest.approx(key.viewmat.numpy(), abs=1e-4)
    unit = np.median(np.linalg.norm(places - places.mean(axis=0), axis=1))
    rotations = Rotation.from_matrix([pose(seen)[1].T for seen in path])
    turned = (rotations[:-1].inv() * rotations[1:]).magnitude()
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / unit + turned
    assert speed.max() < 1.1 * speed.min()
    for seen in path:
        matrix = seen.viewmat[:3, :3].double().numpy()
        assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-5)
        assert np.linalg.det(matrix) > 0


def test_cameras_at_one_place_are_passed_once() -> None:
    one, other = around([0.0, 0.5])
    path = smooth_path([one, one, one, other], 11)
    positions = np.array([pose(seen)[0] for seen in path])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() < 1.2 * steps.min()
    assert [seen.viewmat.tolist() for seen in smooth_path([one, one], 3)] == [one.viewmat.tolist()] * 3


def test_a_path_needs_cameras_of_one_size() -> None:
    with pytest.raises(ValueError, match="at least one camera and one frame, got 0 and 5"):
        smooth_path([], 5)
    with pytest.raises(ValueError, match="one size; reframe them first"):
        smooth_path([camera([0, 0, 0]), reframed(camera([1, 0, 0]), 40, 30)], 5)


@pytest.mark.parametrize(("count", "most"), [(12, 2 * math.pi), (5, math.radians(120))])
def test_an_orbit_looks_at_what_the_cameras_look_at(count: int, most: float) -> None:
    given = around(np.linspace(0.3, 0.3 + most, count, endpoint=most < 6))
    path = orbit(given, 48)
    middle, angles = np.array([1.0, 2.0, 3.0]), []
    for seen in path:
        position, rotation = pose(seen)
        arm = position - middle
        assert np.hypot(arm[0], arm[2]) == pytest.approx(2.0, abs=0.02)
        assert arm[1] == pytest.approx(-1.0, abs=0.02)
        assert rotation[2] @ -arm / np.linalg.norm(arm) == pytest.approx(1.0, abs=1e-3)
        assert rotation[0, 1] == pytest.approx(0.0, abs=1e-2)  # level: the picture's right is not up or down
        assert rotation[1, 1] > 0.8  # and upright: its down is the world's
        angles.append(math.atan2(arm[0], -arm[2]))
    turned = np.ptp(np.unwrap(angles))
    assert turned == pytest.approx(2 * math.pi * 47 / 48 if most > 6 else most, abs=0.02)
    if most < 6:
        assert min(angles) == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("tilt", [0.3, 1.0, 2.0])
def test_what_a_survey_looks_at_is_below_it(tilt: float) -> None:
    """Axes that are parallel but for a degree or two do not tell how far away the ground is."""
    generator = np.random.default_rng(0)
    for _ in range(5):
        places = np.stack(np.meshgrid(20.0 * np.arange(15), 20.0 * np.arange(12), [60.0]), axis=-1).reshape(-1, 3)
        places += generator.normal(size=places.shape)
        turns = Rotation.from_rotvec(np.radians(tilt) * generator.normal(size=places.shape))
        down = Rotation.from_matrix(np.diag([1.0, -1, -1]))
        point = looked_at([camera(place, turn * down) for place, turn in zip(places, turns, strict=True)])
        assert -500 < point[2] < 60
        assert point[:2] == pytest.approx([140, 110], abs=20)


def test_what_parting_cameras_look_at_is_in_front_of_them() -> None:
    cameras = [camera([0.1 * x, 0, 0], Rotation.from_euler("Y", 0.05 * x)) for x in range(-5, 6)]
    assert looked_at(cameras) == pytest.approx([0, 0, 2], abs=0.3)


def test_cameras_that_look_one_way_have_an_orbit() -> None:
    path = orbit([camera([x, 0, 0]) for x in (-1.0, 0.0, 1.0)], 8)
    assert all(torch.isfinite(seen.viewmat).all() for seen in path)
    assert all(pose(seen)[1][2][2] > 0 for seen in path)


def test_a_frame_of_another_shape_shows_all_of_the_photo() -> None:
    given = around([0.4])[0]
    for width, height in ((160, 120), (300, 60), (30, 200)):
        made = reframed(given, width, height)
        assert (made.width, made.height) == (width, height)
        fx, fy, cx, cy = made.intrinsics
        gx, gy, dx, dy = given.intrinsics
        factor = min(width / 80, height / 60)
        assert (fx, fy) == pytest.approx((factor * gx, factor * gy))
        left, right = (0 - dx) / gx * fx + cx, (80 - dx) / gx * fx + cx
        top, bottom = (0 - dy) / gy * fy + cy, (60 - dy) / gy * fy + cy
        assert -1e-4 <= left < right <= width + 1e-4
        assert -1e-4 <= top < bottom <= height + 1e-4
        assert (left + right) / 2 == pytest.approx(width / 2, abs=1e-3)


def _written(path: Path, entries: list[dict[str, Any]], key: str = "camera_path", **more: Any) -> Path:
    head = {"camera_type": "perspective", "render_width": 80, "render_height": 60}
    path.write_text(json.dumps({**head, key: entries, **more}))
    return path


def _opengl(seen: Camera) -> np.ndarray[Any, Any]:
    """Camera to world with y up, looking along -z."""
    position, rotation = pose(seen)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T * [1, -1, -1]
    matrix[:3, 3] = position
    return matrix


@pytest.mark.parametrize("form", ["rows", "columns", "text of columns"])
def test_nerfstudio_paths_are_read(tmp_path: Path, form: str) -> None:
    given = around([0.0, 0.7])
    field = math.degrees(2 * math.atan(30 / 100))
    entries: list[dict[str, Any]] = []
    for seen in given:
        matrix = _opengl(seen)
        numbers = (matrix if form == "rows" else matrix.T).ravel().tolist()
        stored = json.dumps(numbers) if form.startswith("text") else numbers
        entries.append({"camera_to_world" if form == "rows" else "matrix": stored, "fov": field, "aspect": 4 / 3})
    path = _written(tmp_path / "a.json", entries, "camera_path" if form == "rows" else "keyframes", fps=30)
    cameras, fps = read_camera_path(path)
    assert fps == 30
    for found, seen in zip(cameras, given, strict=True):
        assert found.viewmat.numpy() == pytest.approx(seen.viewmat.numpy(), abs=1e-5)
        assert found.intrinsics == pytest.approx((100, 100, 40, 30), abs=1e-3)
        assert (found.width, found.height) == (80, 60)


ENTRY = json.dumps({"matrix": np.eye(4).ravel().tolist(), "fov": 50})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("nothing", "Expecting value"),
        ("[1]", "no attribute 'get'"),
        ('{"camera_path": []}', "lacks 'keyframes'"),
        ('{"keyframes": [], "render_width": 4, "render_height": 3}', "it has no cameras"),
        ('{"keyframes": [{}], "render_width": 4, "render_height": 3}', "lacks 'matrix'"),
        ('{"keyframes": [{}]}', "lacks 'render_width'"),
        ('{"camera_type": "equirectangular", "keyframes": []}', "camera_type is equirectangular, and only perspective"),
        (f'{{"keyframes": [{ENTRY}], "render_width": 4, "render_height": 3, "fps": 0}}', "its fps is 0"),
        ('{"keyframes": [{"matrix": [1], "fov": 50}], "render_width": 4, "render_height": 3}', "reshape"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=f"a.json is not a camera path .*{words}"):
        read_camera_path(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scale": 2.0}, "must be world to camera, a rotation and a translation"),
        ({"fov": 180.0}, "field of view is 180"),
        ({"last": 2.0}, "rigid"),
    ],
)
def test_poses_that_cannot_be_are_refused(tmp_path: Path, change: dict[str, float], words: str) -> None:
    matrix = _opengl(around([0.0])[0])
    matrix[:3, :3] *= change.get("scale", 1.0)
    matrix[3, 3] = change.get("last", 1.0)
    entry = {"camera_to_world": matrix.ravel().tolist(), "fov": change.get("fov", 50.0)}
    with pytest.raises(ValueError, match=words):
        read_camera_path(_written(tmp_path / "a.json", [entry]))


def _inria(seen: Camera, name: str, **change: Any) -> dict[str, Any]:
    """Oracle: rotation and position of the inverse of the view, as the trainer writes them."""
    pose = np.linalg.inv(seen.viewmat.double().numpy())
    lens = {"width": seen.width, "height": seen.height, "fx": 100.0, "fy": 90.0}
    rotation = [row.tolist() for row in pose[:3, :3]]
    return {"id": 7, "img_name": name, **lens, "position": pose[:3, 3].tolist(), "rotation": rotation} | change


def test_cameras_of_inrias_trainer(tmp_path: Path) -> None:
    given = around([0.0, 0.7, 1.5])
    entries = [_inria(seen, name) for seen, name in zip(given, ("a", "b", "a"), strict=True)]
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    cameras = read_cameras(tmp_path / "cameras.json")
    assert list(cameras) == ["a", "b", "a (7)"]
    for found, seen in zip(cameras.values(), given, strict=True):
        np.testing.assert_allclose(found.viewmat, seen.viewmat, atol=1e-5)
        assert found.intrinsics == (100, 90, seen.width / 2, seen.height / 2)
        assert (found.width, found.height) == (seen.width, seen.height)


@pytest.mark.parametrize("apart", [0.1, 1.0, 50.0])
def test_cameras_of_inrias_trainer_have_its_near_plane_at_most(tmp_path: Path, apart: float) -> None:
    given = [
        replace(seen, viewmat=seen.viewmat * torch.tensor([[1, 1, 1, apart]] * 3 + [[1, 1, 1, 1]]))
        for seen in around([0.0, 1.0, 2.0])
    ]
    centres = np.stack([seen.position.numpy() for seen in given])
    entries = [_inria(seen, str(number)) for number, seen in enumerate(given)]
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    (near,) = {camera.near for camera in read_cameras(tmp_path / "cameras.json").values()}
    assert near == pytest.approx(min(0.2, Frame.around(centres.astype(np.float64)).near))


@pytest.mark.parametrize(
    ("arguments", "times"),
    [(None, 2), ("-1", 2), ("1", 1), ("8", 8), ("800", 4), ("0", 2), ("-1, images='i_4'", 4), ("1, images='a_24'", 1)],
)
def test_cameras_of_inrias_trainer_have_the_size_it_trained(
    tmp_path: Path, arguments: str | None, times: float
) -> None:
    entry = _inria(around([0.0])[0], "a", width=3200, height=1600)
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    if arguments is not None:
        (tmp_path / "cfg_args").write_text(f"Namespace(sh_degree=3, images='images', resolution={arguments})")
    (camera,) = read_cameras(tmp_path / "cameras.json").values()
    assert (camera.width, camera.height) == (3200 / times, 1600 / times)
    assert camera.intrinsics == (100 / times, 90 / times, 1600 / times, 800 / times)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}, "must be world to camera, a rotation and a translation"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "must be world to camera, a rotation and a translation"),
        ({"rotation": [[1, 0], [0, 1]]}, "could not broadcast"),
        ({"position": [0, float("nan"), 0]}, "must be world to camera, a rotation and a translation"),
        ({"position": [0, 1e300, 0]}, "must be world to camera, a rotation and a translation"),
        ({"position": [0, "x", 0]}, "could not convert"),
        ({"width": 10**9}, "a picture of 1000000000x"),
        ({"height": 0}, "numbers of pixels, at least one"),
        ({"fx": 0}, "positive, finite focal lengths"),
        ({"fx": 0.1}, "finite focal lengths and a centre, in pixels, got .0.1"),
        ({"fx": None}, "float"),
    ],
)
def test_other_lists_of_cameras_are_refused_in_one_line(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([_inria(around([0.0])[0], "a", **change)]))
    with pytest.raises(
        ValueError, match=rf"cameras\.json is no list of cameras .*{words}.*: move it away, or"
    ) as caught:
        read_cameras(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["{", "7", '{"cameras": 1}', "[1]", "[{}]", "[[]]", 9000 * "[", "\ud800"])
def test_what_is_no_list_of_cameras_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "cameras.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(ValueError, match=r"cameras\.json is no list of cameras"):
        read_cameras(tmp_path / "cameras.json")


def test_a_wide_picture_shows_what_a_photo_of_portrait_shape_shows() -> None:
    """Splats beside the photo are no streaks across it."""
    splats, photo = Splats.from_tensors(*random_splats(300, log_scale=-1.0)), front_camera(40, 80)
    wide = reframed(photo, 160, 80)
    middle, expected = render(splats, wide).image[:, 60:100], render(splats, photo).image
    torch.testing.assert_close(middle, expected, atol=1e-4, rtol=0)
    own = render(splats, replace(wide, limits=())).image[:, 60:100]
    assert (own - expected).abs().max() > 0.02
    moved = replace(wide, viewmat=torch.eye(4))
    for each in (*orbit([wide, moved], 3), *smooth_path([wide, moved], 3), Frame(2.0).camera(wide)):
        assert each.slope_limits == pytest.approx(photo.slope_limits)
