from __future__ import annotations

import math
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nsvq_lightning.data.colmap import Pinhole, SceneError, import_pycolmap, lens, read_model, rgb_bytes

SceneFactory = Callable[..., Path]
ROOT = Path(__file__).resolve().parents[2]


def _as_text(root: Path) -> Path:
    """The same scene with a text model."""
    model = root / "sparse" / "0"
    reconstruction = import_pycolmap().Reconstruction(str(model))
    for file in model.iterdir():
        file.unlink()
    reconstruction.write_text(str(model))
    return root


def test_text_and_binary_models_are_equal(make_scene: SceneFactory) -> None:
    binary, text = read_model(make_scene("a")), read_model(_as_text(make_scene("b")))
    assert [i.name for i in binary.images] == [i.name for i in text.images] == [f"{i:03d}.png" for i in range(9)]
    for one, other in zip(binary.images, text.images, strict=True):
        np.testing.assert_allclose(one.viewmat, other.viewmat, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(binary.points, text.points)
    np.testing.assert_array_equal(binary.colors, text.colors)
    assert np.array_equal(binary.cameras[1].calibration_matrix(), text.cameras[1].calibration_matrix())


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_model_may_stand_in_three_places(make_scene: SceneFactory, place: str) -> None:
    root = make_scene()
    kept = shutil.move(root / "sparse" / "0", root / "kept")
    (root / "sparse").rmdir()
    shutil.copytree(kept, root / place, dirs_exist_ok=True)
    assert len(read_model(root).images) == 9


def test_poses_are_world_to_camera_in_colmaps_frame(make_scene: SceneFactory) -> None:
    root = make_scene()
    reconstruction = import_pycolmap().Reconstruction(str(root / "sparse" / "0"))  # oracle: COLMAP's own projection
    point = np.array([0.1, -0.2, 9.0])
    for image in read_model(root).images:
        camera = image.viewmat @ [*point, 1.0]
        pixel = (30 * camera[0] / camera[2] + 21, 31 * camera[1] / camera[2] + 15)
        np.testing.assert_allclose(
            pixel, reconstruction.find_image_with_name(image.name).project_point(point), atol=1e-9
        )


def test_rigs_and_frames_are_not_looked_at(make_scene: SceneFactory) -> None:
    """Programs that edit a model, such as to leave out a photo, know nothing of them."""
    root = make_scene()
    with_rigs = read_model(root)
    for name in ("rigs.bin", "frames.bin"):
        (root / "sparse" / "0" / name).write_bytes(b"anything")
    for one, other in zip(with_rigs.images, read_model(root).images, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "noise": lambda data: np.random.default_rng(0).bytes(400),
    "longer": lambda data: data + b"\0" * 16,
    "boasting": lambda data: struct.pack("<Q", 1 << 60) + data[8:],
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("table", ["cameras", "images", "points3D"])
def test_damaged_binary_table(make_scene: SceneFactory, table: str, damage: str) -> None:
    root = make_scene(views=2)
    path = root / "sparse" / "0" / f"{table}.bin"
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    with pytest.raises(SceneError, match=rf"{table}\.bin.*(truncated|garbled|too few).*model_converter"):
        read_model(root)


def test_every_truncation_of_every_table_is_found(make_scene: SceneFactory) -> None:
    root = make_scene(views=2, points=2)
    for table in ("cameras", "images", "points3D"):
        path = root / "sparse" / "0" / f"{table}.bin"
        whole = path.read_bytes()
        for length in range(0, len(whole), 7):
            path.write_bytes(whole[:length])
            with pytest.raises(SceneError, match=rf"{table}\.bin.*(truncated|garbled|too few).*model_converter"):
                read_model(root)
        path.write_bytes(whole)
    read_model(root)


@pytest.mark.parametrize("table", ["cameras", "images", "points3D"])
def test_damaged_text_table(make_scene: SceneFactory, table: str) -> None:
    root = _as_text(make_scene())
    (root / "sparse" / "0" / f"{table}.txt").write_text("what is this\nno numbers\n")
    with pytest.raises(SceneError, match=rf"{table}\.txt: line 1 has 3 words.*model_converter"):
        read_model(root)


def test_names_in_another_encoding_are_refused_by_file(make_scene: SceneFactory) -> None:
    for root in (make_scene("a"), _as_text(make_scene("b"))):
        path = next((root / "sparse" / "0").glob("images.*"))
        path.write_bytes(path.read_bytes().replace(b"003.png", b"caf\xe9png"))
        with pytest.raises(SceneError, match=r"images\.(bin|txt) names 'caf.*', which is not UTF-8: rename"):
            read_model(root)


@pytest.mark.parametrize(
    ("old", "new"), [("PINHOLE 40 32", "PINHOLE 0 32"), ("PINHOLE 40 32 30", "PINHOLE 40 32 1e300")]
)
def test_cameras_that_cannot_be(make_scene: SceneFactory, old: str, new: str) -> None:
    path = _as_text(make_scene()) / "sparse" / "0" / "cameras.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(SceneError, match=r"cameras\.txt: camera 1 has size .* sizes from 1 to .* finite numbers"):
        read_model(path.parents[2])


def _pose(path: Path, image: int, place: int, *values: float) -> None:
    """Overwrite numbers of the pose of an image in ``images.bin``, whose records all have the same length."""
    data = bytearray(path.read_bytes())
    length = (len(data) - 8) // struct.unpack_from("<Q", data)[0]
    struct.pack_into(f"<{len(values)}d", data, 8 + length * image + 4 + 8 * place, *values)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("place", "values"), [(0, (0, 0, 0, 0)), (1, (math.nan,)), (4, (math.nan,)), (6, (math.inf,)), (4, (1e300,))]
)
@pytest.mark.parametrize("as_text", [False, True])
def test_poses_that_are_none_are_refused_by_photo(
    make_scene: SceneFactory, place: int, values: tuple[float, ...], as_text: bool
) -> None:
    root = make_scene(views=3)
    if as_text:
        path = _as_text(root) / "sparse" / "0" / "images.txt"
        lines = path.read_text().splitlines()
        row = next(row for row, line in enumerate(lines) if line.endswith(" 001.png"))
        words = lines[row].split()
        words[1 + place : 1 + place + len(values)] = map(str, values)
        lines[row] = " ".join(words)
        path.write_text("\n".join(lines))
    else:
        _pose(root / "sparse" / "0" / "images.bin", 1, place, *values)
    with pytest.raises(SceneError, match=r"images\.(bin|txt): 1 poses are no numbers.* that of 001\.png with quat"):
        read_model(root)


def test_quaternions_of_any_length_are_rotations(make_scene: SceneFactory, caplog: pytest.LogCaptureFixture) -> None:
    root = make_scene(views=3)
    expected = [image.viewmat for image in read_model(root).images]
    assert not caplog.text
    _pose(root / "sparse" / "0" / "images.bin", 1, 0, 1.01, 0, 0, 0)
    np.testing.assert_allclose([image.viewmat for image in read_model(root).images], expected, atol=1e-15)
    assert "quaternions are up to 1 % too long or short" in caplog.text


def test_one_photo_has_one_pose_and_a_camera(make_scene: SceneFactory) -> None:
    root = make_scene(views=3)
    path = root / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"001.png", b"002.png"))
    with pytest.raises(SceneError, match=r"images\.bin lists 002\.png twice, as images 2 and"):
        read_model(root)
    path = _as_text(make_scene("other", views=3)) / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace(" 1 001.png", " 7 001.png"))
    with pytest.raises(SceneError, match=r"images\.txt: photo 001\.png is of camera 7, which cameras\.txt does not"):
        read_model(path.parents[2])
    cameras = path.with_name("cameras.txt")
    text = path.read_text()
    path.write_text(text.replace(" 7 001.png", " 1 001.png"))
    (line,) = (line for line in cameras.read_text().splitlines() if not line.startswith("#"))
    cameras.write_text(f"{line}\n{line}\n")
    assert len(read_model(path.parents[2]).cameras) == 1
    cameras.write_text(f"{line}\n{line}5\n")
    with pytest.raises(SceneError, match=r"cameras\.txt has two cameras of one number"):
        read_model(path.parents[2])


def test_text_table_of_fewer_rows_than_announced(make_scene: SceneFactory, caplog: pytest.LogCaptureFixture) -> None:
    path = _as_text(make_scene()) / "sparse" / "0" / "points3D.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-3]))
    assert len(read_model(path.parents[2]).points) == 17
    assert "points3D.txt announces 20 rows but has 17: unless you removed some, copy" in caplog.text


def test_points_may_be_missing(make_scene: SceneFactory) -> None:
    assert len(read_model(make_scene("none", points=0)).points) == 0
    root = make_scene()
    (root / "sparse" / "0" / "points3D.bin").unlink()
    model = read_model(root, observations=True)
    assert model.observations is not None
    assert (len(model.images), len(model.points), model.observations.shape) == (9, 0, (0, 2))


def test_sightings_of_photos_that_are_gone_are_left_out(
    demo_scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pycolmap = import_pycolmap()
    whole = pycolmap.Reconstruction(str(demo_scene / "sparse" / "0"))
    shutil.copytree(demo_scene / "sparse", tmp_path / "scene" / "sparse")
    text = _as_text(tmp_path / "scene") / "sparse" / "0" / "images.txt"
    lines = text.read_text().splitlines(keepends=True)
    row = next(row for row, line in enumerate(lines) if line.strip().endswith("view_004.png"))
    text.write_text("".join(lines[:row] + lines[row + 2 :]))
    model = read_model(tmp_path / "scene", observations=True)
    assert len(model.images) == 8
    assert len(model.points) == len(whole.points3D)
    gone = whole.find_image_with_name("view_004.png").image_id
    kept = {
        (row, element.image_id)
        for row, (_, point) in enumerate(sorted(whole.points3D.items()))
        for element in point.track.elements
        if element.image_id != gone
    }
    assert model.observations is not None
    assert len(model.observations) == len(kept)
    assert "sightings by images that the model does not have" in caplog.text


@pytest.mark.parametrize("place", ["sparse/1", "colmap/sparse/0", "dense/sparse", "model"])
def test_the_only_model_anywhere_in_a_folder_is_read(
    make_scene: SceneFactory, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="nsvq_lightning")
    root = make_scene()
    shutil.copytree(root / "sparse" / "0", root / "kept")
    shutil.rmtree(root / "sparse")
    (root / place).parent.mkdir(parents=True, exist_ok=True)
    (root / "kept").rename(root / place)
    assert len(read_model(root).images) == 9
    assert f"the COLMAP model is the one in {place}" in caplog.text
    shutil.copytree(root / place, root / "z")
    with pytest.raises(SceneError, match=rf"models in {place}, z: choose one, such as --data\.model={place}"):
        read_model(root)


def test_tables_may_be_binary_or_text_and_in_capitals(make_scene: SceneFactory) -> None:
    mixed, text = make_scene("mixed"), _as_text(make_scene("text"))
    (mixed / "sparse/0/points3D.bin").unlink()
    shutil.copy(text / "sparse/0/points3D.txt", mixed / "sparse/0/Points3D.TXT")
    np.testing.assert_array_equal(read_model(mixed).points, read_model(text).points)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((0.0, 0.5, 1.0), (0, 128, 255)),
        ((0.0, 127.6, 255.0), (0, 128, 255)),
        ((0, 1, 1), (0, 1, 1)),
        ((0, 128 * 257, 65535), (0, 128, 255)),
        ((math.nan, -3, 200), (0, 0, 200)),
    ],
)
def test_colours_of_any_kind_are_bytes(values: tuple[float, ...], expected: tuple[int, ...]) -> None:
    assert rgb_bytes(np.array([values], np.float64)).tolist() == [list(expected)]
    assert rgb_bytes(np.array([(1.0, 0, 1)]), floats=True).tolist() == [[255, 0, 255]]


@pytest.mark.parametrize("odd", [1.004, 255.5, math.inf, math.nan, -3.0])
@pytest.mark.parametrize("white", [1, 255, 4095, 65535])
def test_a_single_odd_value_does_not_change_all_colours(white: int, odd: float) -> None:
    levels = np.linspace(0, 1, 99).reshape(33, 3)
    values = levels * white if white == 1 else (levels * white).round()
    values[7, 2] = odd
    found = rgb_bytes(values, floats=white == 1)
    expected = np.rint(255 * levels)
    kept = ~np.isclose(levels, levels[7, 2])
    assert np.abs(found - expected)[kept].max() <= 1
    assert rgb_bytes(np.zeros((0, 3))).shape == (0, 3)


def test_colours_that_most_points_lack_are_bytes_still() -> None:
    values = np.zeros((100, 3))
    values[:5] = 200.5
    assert rgb_bytes(values, floats=True)[:6].tolist() == [[200] * 3] * 5 + [[0] * 3]


def test_missing_folder_and_missing_model(tmp_path: Path, make_scene: SceneFactory) -> None:
    with pytest.raises(SceneError, match="does not exist"):
        read_model(tmp_path / "nowhere")
    with pytest.raises(SceneError, match=r"no COLMAP model.*sparse/0, sparse, \."):
        read_model(tmp_path)
    root = make_scene()
    (root / "sparse" / "0" / "images.bin").unlink()
    with pytest.raises(SceneError, match=r"cameras and images .*; there is .*sparse/0/cameras\.bin"):
        read_model(root)


def test_png_files_can_be_written_after_a_model_was_read(make_scene: SceneFactory, tmp_path: Path) -> None:
    # with pycolmap imported before OpenCV and Pillow this process would abort
    program = f"""
from pathlib import Path
from nsvq_lightning.data.scene import load_scene
scene = load_scene({str(make_scene())!r})
import cv2, numpy, PIL.Image
image = numpy.random.default_rng(0).integers(0, 256, (300, 400, 3), dtype=numpy.uint8)
assert cv2.imwrite({str(tmp_path / "cv2.png")!r}, image)
PIL.Image.fromarray(image).save({str(tmp_path / "pil.png")!r})
assert (cv2.imread({str(tmp_path / "cv2.png")!r}) == image).all()
print("done", tuple(scene.view(0).image.shape))
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "done (32, 40, 3)"


def test_pycolmap_is_imported_in_one_place_and_late() -> None:
    importing = [
        (path.name, line)
        for path in (ROOT / "nsvq_lightning").rglob("*.py")
        for line in path.read_text().splitlines()
        if line.strip().startswith(("import pycolmap", "from pycolmap"))
    ]
    assert importing == [("colmap.py", "        import pycolmap")]


@pytest.mark.parametrize(
    ("model", "params"), [("PINHOLE", (50.0, 40.0, 11.0, 7.5)), ("SIMPLE_PINHOLE", (50.0, 11.0, 7.5))]
)
def test_a_pinhole_is_that_of_pycolmap(model: str, params: tuple[float, ...]) -> None:
    expected = import_pycolmap().Camera(model=model, width=24, height=16, params=list(params), camera_id=3)
    found = lens(3, model, 24, 16, params)
    assert isinstance(found, Pinhole)
    np.testing.assert_array_equal(found.calibration_matrix(), expected.calibration_matrix())
    assert (found.width, found.height, found.camera_id) == (24, 16, 3)
    np.testing.assert_array_equal(found.scaled(2, 0.5).K, np.diag([2, 0.5, 1]) @ found.K)


def test_a_lens_with_distortion_needs_pycolmap(monkeypatch: pytest.MonkeyPatch) -> None:
    params = (50.0, 11.0, 7.5, 0.1)
    assert lens(1, "SIMPLE_RADIAL", 24, 16, params).model_name == "SIMPLE_RADIAL"
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert lens(1, "PINHOLE", 24, 16, (5.0, 5.0, 1.0, 1.0)).model_name == "PINHOLE"
    with pytest.raises(
        SceneError, match=r"not installed \(it has no wheel for Linux on ARM64\): build it, or undistort"
    ):
        lens(1, "SIMPLE_RADIAL", 24, 16, params)


HANDLED = """
import signal
from nsvq_lightning.data.colmap import import_pycolmap
signal.signal(signal.SIGTERM, lambda *_: print("ours"))
import_pycolmap()
signal.raise_signal(signal.SIGTERM)
"""


def test_pycolmap_leaves_the_end_of_a_process_to_others() -> None:
    """Its wheels come with a handler that shows a stack, so that files would stay."""
    ran = subprocess.run([sys.executable, "-c", HANDLED], capture_output=True, text=True, check=True)
    assert ran.stdout == "ours\n"
