from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nsvq_lightning.data.colmap import SceneError, import_pycolmap, read_model

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
    assert binary.cameras[1].params.tolist() == text.cameras[1].params.tolist()


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


def test_legacy_models_without_rigs_load(make_scene: SceneFactory) -> None:
    root = make_scene()
    with_rigs = read_model(root)
    for name in ("rigs.bin", "frames.bin"):
        (root / "sparse" / "0" / name).unlink()
    for one, other in zip(with_rigs.images, read_model(root).images, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "noise": lambda data: np.random.default_rng(0).bytes(400),
    "longer": lambda data: data + b"\0" * 16,
    "boasting": lambda data: struct.pack("<Q", 1 << 60) + data[8:],
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("table", ["cameras", "images", "points3D", "rigs", "frames"])
def test_damaged_binary_table(make_scene: SceneFactory, table: str, damage: str) -> None:
    root = make_scene(views=2)
    path = root / "sparse" / "0" / f"{table}.bin"
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    with pytest.raises(SceneError, match=rf"{table}\.bin.*(truncated|garbled|too few).*model_converter"):
        read_model(root)


def test_every_truncation_of_every_table_is_found(make_scene: SceneFactory) -> None:
    root = make_scene(views=2, points=2)
    for table in ("cameras", "images", "points3D", "rigs", "frames"):
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
    with pytest.raises(SceneError, match=r"cannot read.*damaged"):
        read_model(root)


def test_names_in_another_encoding_are_refused_by_file(make_scene: SceneFactory) -> None:
    for root in (make_scene("a"), _as_text(make_scene("b"))):
        path = next((root / "sparse" / "0").glob("images.*"))
        path.write_bytes(path.read_bytes().replace(b"003.png", b"caf\xe9png"))
        with pytest.raises(SceneError, match=r"images\.(bin|txt): the name of a photo is not UTF-8"):
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


def test_poses_that_float32_cannot_hold(make_scene: SceneFactory) -> None:
    path = make_scene() / "sparse" / "0" / "frames.bin"
    data = bytearray(path.read_bytes())
    data[48:56] = struct.pack("<d", 1e300)  # x of the first frame: after the count, two ids, four doubles
    path.write_bytes(data)
    with pytest.raises(SceneError, match=r"images\.bin: 1 poses are not finite"):
        read_model(path.parents[2])


def test_text_table_cut_between_two_lines(make_scene: SceneFactory) -> None:
    path = _as_text(make_scene()) / "sparse" / "0" / "points3D.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-3]))
    with pytest.raises(SceneError, match=r"points3D\.txt announces 20 rows but has 17"):
        read_model(path.parents[2])


def test_no_points(make_scene: SceneFactory) -> None:
    with pytest.raises(SceneError, match=r"points3D\.bin has no points.*point_triangulator"):
        read_model(make_scene(points=0))


def test_missing_folder_and_missing_model(tmp_path: Path, make_scene: SceneFactory) -> None:
    with pytest.raises(SceneError, match="does not exist"):
        read_model(tmp_path / "nowhere")
    with pytest.raises(SceneError, match=r"no COLMAP model.*sparse/0, sparse, \."):
        read_model(tmp_path)
    root = make_scene()
    (root / "sparse" / "0" / "points3D.bin").unlink()
    with pytest.raises(SceneError, match=r"sparse/0 has a \.bin model without points3D\.bin"):
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
