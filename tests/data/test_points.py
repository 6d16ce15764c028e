"""Point clouds of other programs, and random points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nsvq_lightning.compression.viewpoints import look_at
from nsvq_lightning.data.colmap import SceneError
from nsvq_lightning.data.points import cloud_in, random_points, read_points, share_seen
from nsvq_lightning.data.scene import load_scene


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_point_clouds(tmp_path: Path, order: str) -> None:
    kind = [("red", "f4"), ("x", "f8"), ("y", "f4"), ("z", "f4"), ("green", "f4"), ("blue", "f4")]
    names = {"f4": "float", "f8": "double"}
    table = np.array([(0, 1.5, 2, 3, 0.5, 1), (1, -1, -2, 9, 0, 0.25)], [(name, order + code) for name, code in kind])
    head = "".join(f"property {names[code]} {name}\n" for name, code in kind)
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    tail = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path = tmp_path / "points.ply"
    path.write_bytes(
        f"ply\nformat {form} 1.0\ncomment x\nelement vertex 2\n{head}{tail}".encode() + table.tobytes() + b"abc"
    )
    xyz, rgb = read_points(path)
    np.testing.assert_array_equal(xyz, [[1.5, 2, 3], [-1, -2, 9]])
    np.testing.assert_array_equal(rgb, [[0, 128, 255], [255, 0, 64]])
    whole = path.read_bytes()
    for length in range(0, len(whole) - 3, 5):
        path.write_bytes(whole[:length])
        with pytest.raises(SceneError, match=r"points .*points\.ply: .*copy the file again"):
            read_points(path)


def test_what_a_mac_leaves_beside_files_is_no_cloud(tmp_path: Path) -> None:
    (tmp_path / "._scan.ply").write_bytes(b"\0\5\x16\7")
    assert cloud_in([tmp_path]) is None
    (tmp_path / "scan.ply").write_text("ply")
    assert cloud_in([tmp_path]) == tmp_path / "scan.ply"


def test_points_without_colours_are_grey_and_short_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n"
    path.write_text(f"{head}1 2 3\n4 5 6\n")
    xyz, rgb = read_points(path)
    np.testing.assert_array_equal(xyz, [[1, 2, 3], [4, 5, 6]])
    assert (rgb == 128).all()
    for rows in ("1 2 3\n", "1 2 3\n4 5 x\n", "1 2 3\n4 5\n"):
        path.write_text(head + rows)
        with pytest.raises(SceneError, match=r"points\.ply: "):
            read_points(path)


@pytest.mark.parametrize(
    ("kind", "names", "values"),
    [
        ("float", "red green blue", "0 128 255"),
        ("double", "red green blue", "0 0.5 1"),
        ("ushort", "red green blue", "0 32896 65535"),
        ("uchar", "diffuse_red diffuse_green diffuse_blue", "0 128 255"),
        ("float", "scalar_Red scalar_Green scalar_Blue", "0 128 255"),
        ("uchar", "r g b", "0 128 255"),
        ("float", "nx ny nz R G B", "0 0 1 0 128 255"),
        ("float", "f_dc_0 f_dc_1 f_dc_2 nx", "-1.7724539 0.00695 1.7724539 1"),
        ("float", "f_dc_0 f_dc_1 f_dc_2 nx", "-9 0.00695 9 1"),
    ],
)
def test_colours_by_any_name_and_kind(tmp_path: Path, kind: str, names: str, values: str) -> None:
    path = tmp_path / "points.ply"
    properties = [
        *(f"property double {axis}" for axis in "XYZ"),
        *(f"property {kind} {each}" for each in names.split()),
    ]
    head = ["ply", "format ascii 1.0", "element vertex 1", *properties, "end_header"]
    path.write_text("\n".join([*head, f"500000.125 4100000.25 3 {values}", ""]))
    xyz, rgb = read_points(path)
    assert xyz.tolist() == [[500000.125, 4100000.25, 3]]
    assert rgb.tolist() == [[0, 128, 255]]


def test_intensity_is_grey(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    properties = [f"property float {name}" for name in ("x", "y", "z", "intensity")]
    head = ["ply", "format ascii 1.0", "element vertex 2", *properties, "end_header"]
    path.write_text("\n".join([*head, "1 2 3 0.5", "4 5 6 1", ""]))
    assert read_points(path)[1].tolist() == [[128] * 3, [255] * 3]


def test_random_points_fill_what_the_cameras_see_together(demo_scene: Path) -> None:
    cameras = list(load_scene(demo_scene).cameras)
    points = random_points(cameras)
    assert share_seen(points, cameras) > 0.9
    radius = np.linalg.norm(np.stack([camera.position for camera in cameras]), axis=1).mean()
    assert points.std(0).min() > 0.05 * radius
    # Parallel axes meet nowhere.
    ahead = [camera for camera in cameras[:1] for _ in range(3)]
    assert share_seen(random_points(ahead), ahead) == 1


def test_random_points_of_somebody_who_turns_in_place_are_far_away() -> None:
    """A phone that is held at arm's length shows the room, not what lies between its places."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    eyes = 0.5 * np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], 1)
    away = random_points([look_at(3 * eye, eye, 64, 48, 1.0) for eye in eyes])
    inwards = random_points([look_at(0 * eye, eye, 64, 48, 1.0) for eye in eyes])
    assert np.median(np.linalg.norm(inwards, axis=1)) < 0.5
    assert 1.5 < np.median(np.linalg.norm(away, axis=1)) < 10
