"""Tables of COLMAP models as people and programs leave them; binary ones are damaged in ``test_colmap.py``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from nsvq_lightning.data.colmap import import_pycolmap
from nsvq_lightning.data.colmap_tables import LENSES, read_cameras, read_images, read_points

POSE = "1 0 0 0 0.5 -1e-002 2"
TWO_LINES = f"# IMAGE_ID, ...\n1 {POSE} 1 a b (2).jpg\n1.5 2 -1 3 4.5 6\n2 {POSE} 1 cam/c.png\n\n"
NAMES = ["a b (2).jpg", "cam/c.png"]


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("1 0 0 0", "1\t0\t0\t0"),
        lambda text: text.replace("\n", "\n# comment\n"),
        lambda text: text + "\n\n",
        lambda text: text.replace("1.5 2 -1 3 4.5 6\n", "").strip(),  # one line for each image
        lambda text: text.replace("1.5 2 -1 3 4.5 6\n", "").replace("\n\n", ""),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_images_as_text(tmp_path: Path, change: Callable[[str], str], encoding: str) -> None:
    path = tmp_path / "images.txt"
    path.write_bytes(change(TWO_LINES).encode(encoding))
    images = read_images(path)
    assert [image.name for image in images] == NAMES
    assert images[1].pose == (1, 0, 0, 0, 0.5, -0.01, 2)
    assert [(image.number, image.camera_id) for image in images] == [(1, 1), (2, 1)]


@pytest.mark.parametrize(
    ("line", "tracks"),
    [
        ("7 1 2 3 10 20 30 0.5 4 0 5 1", [4, 5]),
        ("7 1 2 3 10.0 20.0 30.0 0.5", []),
        ("7 1 2 3 10 20 30", []),
        ("1 2 3 10 20 30", []),
    ],
)
def test_points_as_text(tmp_path: Path, line: str, tracks: list[int]) -> None:
    path = tmp_path / "points3D.txt"
    path.write_text(f"{line}\n")
    points = read_points(path, tracks=True)
    assert (points.xyz.tolist(), points.rgb.tolist()) == ([[1, 2, 3]], [[10, 20, 30]])
    assert list(points.tracks) == [tracks]
    assert list(read_points(path).tracks) == [[]]


def test_points_as_text_without_identifiers(tmp_path: Path) -> None:
    """With an error and a track all the same, as DPVO writes them."""
    path = tmp_path / "points3D.txt"
    path.write_text("1.5 2 3 10 20 30 0.0 0 0 0 0\n1.000000e+00 2 3 4 10 20 30 0.5 7 1\n")
    points = read_points(path, tracks=True)
    assert points.xyz.tolist() == [[1.5, 2, 3], [2, 3, 4]]
    assert points.rgb.tolist() == [[10, 20, 30], [10, 20, 30]]
    assert list(points.tracks) == [[0, 0], [7]]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 PINHOLE 40 32 30 30 20", "line 2: camera 1 of model PINHOLE has 3 parameters in place of 4"),
        ("1 PINHOLE 40 32 -nan(ind) 30 20 16", r"line 2 has '-nan\(ind\)' in place of a number"),
        ("1 PINHOLE 40 32 30,5 30 20 16", "line 2 has '30,5' in place of a number; decimals need a point"),
        ("1 FISHEYE_X 40 32 30", "line 2: camera 1 has the model FISHEYE_X; known are SIMPLE_PINHOLE, PINHOLE"),
        ("1 PINHOLE", "line 2 has 2 words"),
    ],
)
def test_cameras_that_cannot_be_read_are_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text(f"# cameras\n{line}\n")
    with pytest.raises(ValueError, match=message):
        read_cameras(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"1 {POSE} 1\n", "line 1 has 9 words; an image has"),
        (f"1 {POSE} x a.jpg\n".replace("0.5", "0,5"), "line 1 has '0,5' in place of a number; decimals"),
        (f"1 {POSE} 1 a.jpg\n1 2 3\n4 5 6\n", "line 3 has 3 words"),
    ],
)
def test_images_that_cannot_be_read_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "images.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_images(path)


def test_labels_with_numbers_are_no_points(tmp_path: Path) -> None:
    path = tmp_path / "images.txt"
    path.write_text("".join(f"{number} {POSE} 1 my frame {number:04}\n\n" for number in range(1, 6)))
    assert [image.name for image in read_images(path)] == [f"my frame {number:04}" for number in range(1, 6)]


def test_points_of_images_may_have_identifiers_with_decimals(tmp_path: Path) -> None:
    path = tmp_path / "images.txt"
    path.write_text(
        "".join(f"{number} {POSE} 1 {number}.jpg\n" + "3.5 -nan(ind) -1.0 " * 4 + "\n" for number in (1, 2))
    )
    assert [image.name for image in read_images(path)] == ["1.jpg", "2.jpg"]


def test_pointers_of_git_lfs_are_told(tmp_path: Path) -> None:
    (tmp_path / "images.bin").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    with pytest.raises(ValueError, match=r"a pointer of Git LFS, .*'git lfs pull'"):
        read_images(tmp_path / "images.bin")


def test_sizes_are_rounded(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("1 PINHOLE 79.99999 60.00001 80 80 40 30\n")
    assert read_cameras(path)[0][2:4] == (80, 60)


def test_the_camera_models_are_those_of_colmap() -> None:
    pycolmap = import_pycolmap()
    known = {name: model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    make = pycolmap.Camera.create_from_model_id
    counts = {int(m.value): (name, len(make(1, m, 1.0, 1, 1).params)) for name, m in known.items()}
    assert counts.items() <= dict(enumerate(LENSES.items())).items()  # older ones know fewer
