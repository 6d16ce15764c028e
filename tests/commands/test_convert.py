from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compressed_scenes import arrays_of
from viewer_scenes import WRITTEN, coded_scene, nearest_in, needs_zstd, plain_scene, read_spz_header

from nsvq_lightning.commands.main import main as nsvq
from nsvq_lightning.data.colmap import find_model, import_pycolmap
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io import CompressedScene, read_scene, save
from nsvq_lightning.io.formats import describe
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.rendering.poses import up_of
from nsvq_lightning.splats.splats import Splats
from tests.support.splat_scenes import ball


def main(arguments: list[str]) -> int:
    return nsvq(["convert", *arguments])


def exported(scene: CompressedScene, folder: Path, storage: Storage, *formats: str) -> dict[str, Path]:
    """The files that a run writes of a scene."""
    paths = {suffix: folder / f"scene.{suffix}" for suffix in formats}
    for path in paths.values():
        save(scene, path, storage)
    return paths


def test_every_readable_format_becomes_every_writable_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = coded_scene(30, 1)
    (tmp_path / "new").mkdir()
    for source in WRITTEN:
        save(scene, tmp_path / f"a{source}")
        for target in WRITTEN:
            output = tmp_path / "new" / f"b{target}"
            assert main([str(tmp_path / f"a{source}"), str(output)]) == 0
            assert f"30 splats in {describe(output)['bytes']:,} bytes" in capsys.readouterr().out
            nearest_in(arrays_of(read_scene(output)), arrays_of(scene))


def test_codebooks_survive_where_the_format_has_them(tmp_path: Path) -> None:
    scene = coded_scene(50, 2)
    save(scene, tmp_path / "a.nsvq", Storage("paper"))
    assert main([str(tmp_path / "a.nsvq"), str(tmp_path / "b.nsvq"), "--level", "paper"]) == 0
    assert (tmp_path / "b.nsvq").read_bytes() == (tmp_path / "a.nsvq").read_bytes()
    assert main([str(tmp_path / "a.nsvq"), str(tmp_path / "c.sog")]) == 0
    assert main([str(tmp_path / "c.sog"), str(tmp_path / "d.nsvq"), "--level", "paper"]) == 0
    codebook = read_scene(tmp_path / "d.nsvq").codebooks["shN"]
    np.testing.assert_array_equal(codebook, read_scene(tmp_path / "c.sog").codebooks["shN"])


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("suffix", [".sog", ".spz", ".splat"])
def test_exports_and_conversions_of_a_scene_are_the_same_file(tmp_path: Path, suffix: str, level: str) -> None:
    paths = exported(coded_scene(300), tmp_path, Storage(level), "nsvq", "ply", suffix[1:])
    assert main([str(paths["nsvq"]), str(tmp_path / f"converted{suffix}")]) == 0
    expected = paths[suffix[1:]].read_bytes()
    assert (tmp_path / f"converted{suffix}").read_bytes() == expected
    assert main([str(paths["nsvq"]), str(tmp_path / "converted.ply")]) == 0
    assert (tmp_path / "converted.ply").read_bytes() == paths["ply"].read_bytes()
    if suffix != ".spz":  # which is ordered by the codes, and a .ply has none
        assert main([str(paths["ply"]), str(tmp_path / f"plain{suffix}")]) == 0
        assert (tmp_path / f"plain{suffix}").read_bytes() == expected


@needs_zstd
def test_version_and_axes_of_spz_are_chosen(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(coded_scene(30, 1), tmp_path / "a.nsvq")
    for options, version, system in (
        ([], 3, 0),
        (["--spz-version", "3", "--spz-axes", "rub"], 3, 4),
        (["--spz-version", "4"], 4, 6),
    ):
        assert main([str(tmp_path / "a.nsvq"), str(tmp_path / "b.spz"), *options]) == 0
        header = read_spz_header(tmp_path / "b.spz")
        assert (header.version, header.system, caplog.text) == (version, system, "")


def test_measuring_says_how_the_pictures_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(coded_scene(20, 1), tmp_path / "a.nsvq")
    assert main([str(tmp_path / "a.nsvq"), str(tmp_path / "b.ply"), "--measure"]) == 0
    assert "error 0 (inf dB against a.nsvq in 24 pictures)" in capsys.readouterr().out


def test_a_place_that_a_reader_puts_into_positions_is_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(replace(ball(50, 1), origin=(30.0, 4.0, -20.0)), tmp_path / "a.nsvq", "paper")
    assert main([str(tmp_path / "a.nsvq"), str(tmp_path / "b.glb"), "--measure"]) == 0
    decibels = re.search(r"\((\S+) dB against", capsys.readouterr().out)
    assert decibels
    assert float(decibels[1]) > 80


@pytest.mark.parametrize(
    ("arguments", "message", "status"),
    [
        ("missing.ply b.spz", "nsvq convert: missing.ply", 1),
        ("bad.spz b.ply", "nsvq convert: bad.spz: ", 1),
        ("a.nsvq b.obj", "unknown suffix '.obj'", 1),
        ("a.nsvq new/b.ply", "cannot write new/b.ply: the folder new does not exist; create it first", 1),
        ("a.nsvq b.sog --palette 0", "palette must be in 1..65536", 1),
        ("a.nsvq b.ply --crop 5 5 5 6 6 6", "no splat of a.nsvq is in the box 5.0 5.0 5.0 6.0 6.0 6.0", 1),
        ("a.nsvq b.ply --up z --up-from 0 0 0", "--up-from 0.0 0.0 0.0 is no direction", 1),
        ("a.nsvq b.ply --palette 8", "--palette is an option of .sog files", 2),
        ("a.nsvq b.sog --level paper", "--level is an option of .nsvq files", 2),
        ("a.nsvq b.sog --spz-version 4", "--spz-version is an option of .spz files", 2),
        ("a.nsvq b.ply --spz-axes rub", "--spz-axes is an option of .spz files", 2),
        ("a.nsvq b.sog --data.root x", "add --measure", 2),
        ("a.nsvq b.ply --up z", "--up needs to know where up is now: add --data.root or --up-from", 2),
        ("a.nsvq b.ply --up-from 0 0 1", "--up-from says where up is: add --up", 2),
        ("a.nsvq b.ply --floaters", "--floaters asks the photos: add --data.root", 2),
        ("a.nsvq a.nsvq --measure", "the input, which would be overwritten: name another output", 2),
        ("a.nsvq b.ply --crop 1 1 1 2 2 2 --measure", "--measure compares with the input as it is", 2),
        ("a.nsvq a.nsvq b.ply --measure", "--measure compares with the input as it is", 2),
        ("a.nsvq a.nsvq b.ply --splats 50%", "thin each scene before they are joined", 2),
        ("a.nsvq b.ply --align x", "--align moves the cameras of a scene folder: add --data.root", 2),
        ("a.nsvq b.ply --up y --matrix 1 0 0 0 0 1 0 0 0 0 1 0", "not allowed with argument", 2),
        ("a.nsvq b.ply --matrix 1 0 0 0 0 2 0 0 0 0 1 0", "splats can be turned and scaled evenly only", 1),
        ("a.nsvq b.ply --splats 0", "expected a number of splats, or a share such as 25%", 2),
        ("a.nsvq none/meta.json", "the folder none does not exist", 1),
    ],
)
def test_what_cannot_be_is_told_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    message: str,
    status: int,
) -> None:
    monkeypatch.chdir(tmp_path)
    save(coded_scene(30, 1), tmp_path / "a.nsvq")
    (tmp_path / "bad.spz").write_bytes(b"nothing")
    with pytest.raises(SystemExit) as stop:
        sys.exit(main(arguments.split()))
    error = capsys.readouterr().err
    assert stop.value.code == status
    assert message in error
    assert error.count("\n") == 1 or status == 2
    assert {path.name for path in tmp_path.iterdir()} == {"a.nsvq", "bad.spz"}


def test_results_are_cropped_and_turned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = coded_scene(300)
    save(scene, tmp_path / "a.nsvq", Storage("paper"))
    box = ["--crop", "-0.5", "-99", "-99", "99", "99", "99"]
    assert main([str(tmp_path / "a.nsvq"), str(tmp_path / "b.nsvq"), "--level", "paper", *box]) == 0
    kept = read_scene(tmp_path / "b.nsvq")
    means = arrays_of(read_scene(tmp_path / "a.nsvq")).means
    inside = int((means[:, 0] >= -0.5).sum())
    assert 0 < len(kept) == inside < 300
    assert f"crop: {300 - inside} of 300 splats are outside" in capsys.readouterr().out
    assert set(kept.codes) == set(scene.codes)
    assert main([str(tmp_path / "b.nsvq"), str(tmp_path / "c.ply"), "--up", "z", "--up-from", "0", "-1", "0"]) == 0
    x, y, z = arrays_of(kept).means.T
    turned = arrays_of(read_scene(tmp_path / "c.ply"))
    order, others = np.lexsort(turned.means.T), np.lexsort(np.stack([x, z, -y]))
    np.testing.assert_allclose(turned.means[order], np.stack([x, z, -y], 1)[others], atol=1e-5)


def test_up_is_where_the_cameras_hold_it(demo_scene: Path, tmp_path: Path) -> None:
    save(coded_scene(30, 1), tmp_path / "a.ply")
    assert main([str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--data.root", str(demo_scene), "--up", "y"]) == 0
    before, after = (arrays_of(read_scene(tmp_path / f"{name}.ply")).means for name in "ab")
    up = up_of(load_scene(demo_scene).cameras)
    np.testing.assert_allclose(np.sort(after[:, 1]), np.sort(before @ up), atol=1e-5)


def test_floaters_ask_the_photos(demo_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = load_scene(demo_scene)
    splats = Splats.from_points(scene.points, scene.colors, 0)
    save(splats, tmp_path / "a.ply")
    arguments = ["--data.root", str(demo_scene), "--floaters"]
    assert main([str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), *arguments]) == 0
    out = capsys.readouterr().out
    found = re.search(r"floaters: ([\d,]+) of 500 splats; test photos at ([\d.]+) dB before, ([\d.]+) dB after", out)
    assert found is not None
    assert len(read_scene(tmp_path / "b.ply")) == 500 - int(found[1])
    assert float(found[3]) >= float(found[2])


def test_scenes_are_joined_moved_and_lose_bands(tmp_path: Path) -> None:
    small, large = coded_scene(20, 1), plain_scene(30, 2)
    save(small, tmp_path / "a.nsvq", Storage("paper"))
    save(large, tmp_path / "b.ply")
    matrix = ["0", "-2", "0", "1", "2", "0", "0", "2", "0", "0", "2", "3"]
    files = [str(tmp_path / name) for name in ("a.nsvq", "b.ply", "c.ply")]
    assert main([*files, "--matrix", *matrix, "--sh-degree", "1"]) == 0
    both, parts = read_scene(tmp_path / "c.ply"), [arrays_of(small), arrays_of(large)]
    x, y, z = np.concatenate([part.means for part in parts]).T
    np.testing.assert_allclose(both.means, np.stack([1 - 2 * y, 2 + 2 * x, 3 + 2 * z], 1), rtol=1e-5, atol=1e-5)
    scales = np.concatenate([part.scales for part in parts])
    np.testing.assert_allclose(both.values("scales"), scales + np.log(2), rtol=1e-5, atol=1e-5)
    assert (both.sh_degree, both.values("shN").shape) == (1, (50, 3, 3))
    before = (tmp_path / "c.ply").read_bytes()
    with pytest.raises(SystemExit) as stop:
        main(files)
    assert stop.value.code == 2
    assert (tmp_path / "c.ply").read_bytes() == before


def test_scenes_with_codebooks_keep_them_when_joined(tmp_path: Path) -> None:
    paths = [tmp_path / f"{rows}.nsvq" for rows in (20, 12)]
    for rows, path in zip((20, 12), paths, strict=True):
        save(coded_scene(rows, 2, rows), path, Storage("paper"))
    assert main([*map(str, paths), str(tmp_path / "c.nsvq"), "--level", "paper"]) == 0
    parts, both = [read_scene(path) for path in paths], read_scene(tmp_path / "c.nsvq")
    assert set(both.codes) == {"scales", "sh0", "shN"}
    for name in ("means", "scales", "sh0", "shN"):
        np.testing.assert_array_equal(both.values(name), np.concatenate([part.values(name) for part in parts]))


def test_a_moved_scene_is_aligned_with_the_cameras_of_another(demo_scene: Path, tmp_path: Path) -> None:
    """Oracle: cameras and splats moved by the same similarity, the cameras by pycolmap."""
    pycolmap = import_pycolmap()
    matrix = np.array([[0.0, -2, 0, 5], [2, 0, 0, -1], [0, 0, 2, 3]])
    there = pycolmap.Reconstruction(str(find_model(demo_scene)["cameras"].parent))
    there.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(matrix[:, :3] / 2), matrix[:, 3]))
    (tmp_path / "other" / "sparse").mkdir(parents=True)
    there.write(str(tmp_path / "other" / "sparse"))
    scene = plain_scene(20, 1)
    save(scene, tmp_path / "a.ply")
    align = ["--data.root", str(demo_scene), "--align", str(tmp_path / "other")]
    assert main([str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), *align]) == 0
    expected = scene.means @ matrix[:, :3].T + matrix[:, 3]
    np.testing.assert_allclose(read_scene(tmp_path / "b.ply").means, expected, atol=1e-4)


def test_thinning_keeps_what_shows(tmp_path: Path) -> None:
    scene = ball(400, 1)
    hidden = replace(scene, opacities=np.where(np.arange(400) < 300, scene.opacities, np.float32(-9)))
    save(hidden, tmp_path / "a.ply")
    assert main([str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--splats", "50%"]) == 0
    kept = read_scene(tmp_path / "b.ply")
    assert len(kept) == 200
    assert kept.opacities.min() > -8
