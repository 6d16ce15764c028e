from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compressed_scenes import arrays_of
from numpy.typing import NDArray
from PIL import Image
from splat_scenes import random_splats
from viewer_scenes import coded_scene, plain_scene

from nsvq_lightning.io import CompressedScene, FormatError, read_scene, save

COUNT = 40


def contents(scene: CompressedScene, folder: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What ``meta.json`` of a file says, and its pictures."""
    save(scene, folder / "x.sog")
    with zipfile.ZipFile(folder / "x.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return json.loads(files.pop("meta.json")), files


def bundled(path: Path, meta: dict[str, Any], files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(name, data)
    return path


def picture(texels: NDArray[np.uint8], kind: str = "WEBP", width: int = 8) -> bytes:
    """Texels ``[N, 4]``, a multiple of the width."""
    buffer = io.BytesIO()
    image = Image.fromarray(texels.reshape(-1, width, 4))
    image.save(buffer, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}))
    return buffer.getvalue()


def texels(data: bytes) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).reshape(-1, 4).copy()


@pytest.mark.unguarded  # rows are merged one by one, 19,000 calls of a kernel with all of them
def test_a_palette_may_have_more_texels_than_the_file_has_bytes(tmp_path: Path) -> None:
    """15 for each of up to 65536 rows, also where splats are few."""
    splats = random_splats(18_000, sh_degree=3)
    splats.shN[:] = 0.2 * splats.shN.sign()
    save(splats, path := tmp_path / "x.sog")
    assert 15 * len(splats.means) > max(1 << 18, path.stat().st_size // 2)
    np.testing.assert_allclose(abs(read_scene(path).rows("shN")), 0.2, atol=0.01)


def test_a_scene_too_wide_for_its_steps_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    near = random_splats(1000, sh_degree=0)
    save(near, tmp_path / "near.sog")
    assert not caplog.records
    near.means[:500, 0] += 4000
    near.scales[:] -= 3
    save(near, tmp_path / "wide.sog")
    assert "wide.sog: positions are rounded by half a splat" in caplog.text


@pytest.mark.parametrize("bands", range(4))
def test_version_1_has_bounds_in_place_of_codebooks(tmp_path: Path, bands: int) -> None:
    """Oracle: low + (high - low) t / 255, number by number; the last of the colours is the logit of the opacity."""
    meta, files = contents(plain_scene(COUNT, 0), tmp_path)
    rng = np.random.default_rng(bands)
    scales, colors = (rng.integers(0, 256, (COUNT, 4), np.uint8) for _ in range(2))
    coefficients = (bands + 1) ** 2 - 1
    palette, labels = rng.integers(0, 256, (3 * 64 * coefficients, 4), np.uint8), rng.integers(0, 192, COUNT)
    files |= {"scales.webp": picture(scales), "sh0.webp": picture(colors)}
    old = {
        "means": meta["means"] | {"shape": [COUNT, 3], "dtype": "float32"},
        "quats": meta["quats"] | {"shape": [COUNT, 4], "encoding": "quaternion_packed"},
        "scales": {"mins": [-9, -8, -7], "maxs": [1, 0, -1], "files": ["scales.webp"]},
        "sh0": {"mins": [-2, -1, 0, -5], "maxs": [2, 1, 0.5, 6], "files": ["sh0.webp"]},
    }
    if bands:
        numbers = np.zeros((COUNT, 4), np.uint8)
        numbers[:, 0] = labels
        files |= {"c.webp": picture(palette, width=64 * coefficients), "l.webp": picture(numbers)}
        old["shN"] = {"mins": -4, "maxs": 3.5, "quantization": 8, "files": ["c.webp", "l.webp"]}
    whole = arrays_of(read_scene(tmp_path / "x.sog"))
    back = arrays_of(read_scene(bundled(tmp_path / "y.sog", old, files)))
    for name in ("means", "quats"):
        np.testing.assert_array_equal(getattr(back, name), getattr(whole, name))
    low, size = np.array([-9, -8, -7]), np.array([10, 8, 6])
    np.testing.assert_allclose(back.scales, low + size * scales[:, :3] / 255, atol=1e-6)
    np.testing.assert_allclose(back.sh0[:, 0], [-2, -1, 0] + np.array([4, 2, 0.5]) * colors[:, :3] / 255, atol=1e-6)
    np.testing.assert_allclose(back.opacities, -5 + 11 * (colors[:, 3] / 255), atol=1e-6)
    rows = palette.reshape(192, coefficients, 4)[labels, :, :3]
    np.testing.assert_allclose(back.shN, -4 + 7.5 * rows / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda old: old["means"].update(shape=[]), "'count'"),
        (lambda old: old["sh0"].update(mins=[0, 0, 0]), "'mins' in meta.json must be a list of 4 to 4"),
        (lambda old: old.update(shN={"mins": 0, "maxs": 1, "files": ["quats.webp", "quats.webp"]}), "'bands'"),
    ],
)
def test_a_wrong_description_of_version_1(tmp_path: Path, change: Any, message: str) -> None:
    meta, files = contents(plain_scene(COUNT, 0), tmp_path)
    del meta["version"], meta["count"]
    meta["means"]["shape"] = [COUNT, 3]
    for name, numbers in (("scales", 3), ("sh0", 4)):
        meta[name] |= {"mins": [0] * numbers, "maxs": [1] * numbers}
    change(meta)
    with pytest.raises(FormatError, match=message):
        read_scene(bundled(tmp_path / "y.sog", meta, files))


def test_the_size_of_a_palette_may_be_that_of_its_picture(tmp_path: Path) -> None:
    """As LichtFeld Studio leaves it out."""
    meta, files = contents(coded_scene(COUNT, 2), tmp_path)
    whole = read_scene(bundled(tmp_path / "x.sog", meta, files))
    del meta["shN"]["count"]
    found = read_scene(bundled(tmp_path / "y.sog", meta, files))
    np.testing.assert_array_equal(found.rows("shN"), whole.rows("shN"))


def test_null_in_place_of_a_palette_is_none(tmp_path: Path) -> None:
    meta, files = contents(plain_scene(COUNT, 0), tmp_path)
    found = read_scene(bundled(tmp_path / "y.sog", meta | {"shN": None}, files))
    np.testing.assert_array_equal(found.rows("sh0"), read_scene(tmp_path / "x.sog").rows("sh0"))
    assert found.sh_degree == 0


@pytest.mark.parametrize(("kind", "below"), [("PNG", ""), ("WEBP", ""), ("WEBP", "pictures/")])
def test_a_folder_of_pictures(tmp_path: Path, kind: str, below: str) -> None:
    meta, files = contents(coded_scene(COUNT, 1), tmp_path)
    suffix = f".{kind.lower()}"
    text = json.dumps(meta)
    for name in files:
        text = text.replace(name, below + name.replace(".webp", suffix))
    files = {below + name: data for name, data in files.items()}
    (tmp_path / below).mkdir(exist_ok=True)
    (tmp_path / "meta.json").write_bytes(b"\xef\xbb\xbf" + text.encode())  # as editors of Windows write it
    Image.new("RGB", (9, 9)).save(tmp_path / f"photo{suffix}")  # of no concern
    for name, data in files.items():
        size = Image.open(io.BytesIO(data)).width
        (tmp_path / name).with_suffix(suffix).write_bytes(picture(texels(data), kind, size))
    whole, back = read_scene(tmp_path / "x.sog"), read_scene(tmp_path / "meta.json")
    for name, values in vars(arrays_of(whole)).items():
        np.testing.assert_array_equal(getattr(arrays_of(back), name), values)
    pictures = sum((tmp_path / name).with_suffix(suffix).stat().st_size for name in files)
    assert back.stored_bytes == 3 + len(text) + pictures


def test_large_splats_keep_their_lengths_among_dust(tmp_path: Path) -> None:
    scene, rng = plain_scene(4000, 0), np.random.default_rng(1)
    scales = scene.values("scales")
    scales[:] = rng.uniform(-12, -6, scales.shape)
    scales[:20] = rng.uniform(-1, 2, (20, 3))
    scene.opacities[:] = 3
    save(scene, tmp_path / "x.sog")
    back = read_scene(tmp_path / "x.sog")
    large = np.sort(back.values("scales")[back.values("scales").min(1) > -2], axis=0)
    np.testing.assert_allclose(large, np.sort(scales[:20], axis=0), atol=0.02)


def test_null_in_a_codebook_is_in_line_with_the_other_levels(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    meta, files = contents(coded_scene(COUNT, 1), tmp_path)
    for name, missing in (("scales", [0]), ("sh0", [100, 101]), ("shN", [254, 255])):
        meta[name]["codebook"] = [None if level in missing else 0.01 * level for level in range(256)]
    rows = np.arange(COUNT * 4, dtype=np.uint8).reshape(COUNT, 4)
    files |= {"scales.webp": picture(rows), "sh0.webp": picture(rows)}
    back = read_scene(bundled(tmp_path / "y.sog", meta, files))
    np.testing.assert_allclose(back.values("scales"), 0.01 * rows[:, :3], atol=1e-6)
    np.testing.assert_allclose(back.values("sh0")[:, 0], 0.01 * rows[:, :3], atol=1e-6)
    assert np.isfinite(back.values("shN")).all()
    assert "levels of scales are null" in caplog.text
    meta["sh0"]["codebook"] = [None, None, 1]
    with pytest.raises(FormatError, match="'codebook'"):
        read_scene(bundled(tmp_path / "y.sog", meta, files))


def test_a_few_rotations_without_a_mark_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    meta, files = contents(plain_scene(COUNT, 1), tmp_path)
    marks = texels(files["quats.webp"])
    marks[[3, 9], 3] = 0, 251
    width = Image.open(io.BytesIO(files["quats.webp"])).width
    back = read_scene(bundled(tmp_path / "y.sog", meta, files | {"quats.webp": picture(marks, width=width)}))
    kept = np.delete(np.arange(COUNT), [3, 9])
    np.testing.assert_array_equal(back.means, read_scene(tmp_path / "x.sog").means[kept])
    assert f"2 of {COUNT} rotations have no mark" in caplog.text
    marks[: COUNT // 2 + 1, 3] = 0
    with pytest.raises(FormatError, match="most rotations have no mark"):
        read_scene(bundled(tmp_path / "y.sog", meta, files | {"quats.webp": picture(marks, width=width)}))
