"""Our files as two other programs read them, column by column, and theirs as we do.

gaussforge comes with the packages for tests; docs/formats.md says how to install splat-transform.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from compressed_scenes import arrays_of
from gaussforge import GaussForge
from viewer_scenes import (
    angles,
    assert_same,
    coded_scene,
    nearest_in,
    needs_zstd,
    plain_scene,
    read_spz_header,
    read_table,
    sigmoid,
)

from nsvq_lightning.io import read_scene, save
from nsvq_lightning.io.formats import describe

TOOL = os.environ.get("NSVQ_SPLAT_TRANSFORM") or shutil.which("splat-transform")
COUNT = 120
PROGRAMS = ["gaussforge", pytest.param("splat-transform", marks=pytest.mark.viewers)]


def kind(path: Path) -> str:
    """The format of a file, by the end of its name."""
    return path.name.partition(".")[2]


def convert(program: str, source: Path, target: Path, version: int = 3) -> Path:
    """Have another program convert a file."""
    if program == "gaussforge":
        made = GaussForge().convert(source.read_bytes(), kind(source), kind(target), spz_version=version)
        target.write_bytes(made["data"])
        return target
    if TOOL is None or shutil.which("node") is None:
        pytest.skip("node or splat-transform is not here; name the latter in NSVQ_SPLAT_TRANSFORM")
    options = ["--spz-version", str(version)] if kind(target) == "spz" else []
    command = [TOOL, "-w", "-g", "cpu", *options, str(source), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return target


def as_read(program: str, path: Path) -> SimpleNamespace:
    """The scene that another program finds in a file; gaussforge's own arrays lack infinite opacities and degree 0."""
    if program == "gaussforge":
        return arrays_of(read_scene(convert(program, path, path.with_name("read.ply"))))
    return read_table(convert(program, path, path.with_name("read.csv")))


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("make", [plain_scene, coded_scene])
@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".ply", {}),
        (".splat", {}),
        (".spz", {}),
        pytest.param(".spz", {"version": 4}, marks=needs_zstd),
        (".sog", {}),
    ],
)
def test_others_read_what_was_meant(
    tmp_path: Path, suffix: str, options: dict[str, int], make: type, program: str
) -> None:
    path, scene = tmp_path / f"x{suffix}", make(COUNT)
    save(scene, path, **options)
    theirs, ours, written = as_read(program, path), arrays_of(read_scene(path)), arrays_of(scene)
    assert len(theirs.means) == COUNT

    # Exactly what our own reader finds, row for row: the files mean the same to both.
    # splat-transform takes the bytes of .splat for 255ths of [-1, 1], of which none is 0; the authors for 128ths.
    bias = math.asin(2 * 1 / 255) if suffix == ".splat" else 1e-6
    assert_same(theirs, ours, 2 * bias, opacity=5e-5)  # some take an opaque splat for a nearly opaque one

    # And what was written, up to the bits of the format.
    order = nearest_in(theirs, written)
    bits = {".splat": 0.0, ".ply": 0.0}
    if suffix == ".spz":
        bits[suffix] = 0.5 / (1 << read_spz_header(path).fraction_bits)
    extent = np.ptp(np.copysign(np.log1p(np.abs(written.means)), written.means), axis=0)
    log_error = extent * (0.5 / 65535) * (1 + np.abs(written.means[order])) * 1.001
    means_bound = (log_error if suffix == ".sog" else bits[suffix]) + 2e-6
    assert (np.abs(theirs.means - written.means[order]) <= means_bound).all()
    opacity_bound = 0 if suffix == ".ply" else 0.5 / 255
    assert np.abs(sigmoid(theirs.opacities) - sigmoid(written.opacities[order])).max() <= opacity_bound + 2e-6
    degrees = {".ply": 1e-4, ".splat": 1.8, ".spz": 0.28, ".sog": 1.1}[suffix]
    assert np.degrees(angles(theirs.quats, written.quats[order])).max() <= degrees
    scale_bound = {".ply": 0, ".splat": 2e-6, ".spz": 1 / 32, ".sog": 0.03}[suffix]
    assert np.abs(theirs.scales - written.scales[order]).max() <= scale_bound + 2e-6


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("degree", range(4))
def test_others_read_our_compressed_ply(tmp_path: Path, degree: int, program: str) -> None:
    save(plain_scene(COUNT + 256, degree), tmp_path / "x.compressed.ply")
    ours = arrays_of(read_scene(tmp_path / "x.compressed.ply"))
    assert_same(as_read(program, tmp_path / "x.compressed.ply"), ours, opacity=1.1e-3)


@pytest.mark.viewers
@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_our_streamed_sog_and_we_its_glb(tmp_path: Path, degree: int) -> None:
    scene = plain_scene(COUNT, degree)
    save(scene, tmp_path / "lod-meta.json")
    ours = arrays_of(read_scene(tmp_path / "lod-meta.json"))
    theirs = read_table(convert("splat-transform", tmp_path / "lod-meta.json", tmp_path / "read.csv"))
    order = nearest_in(theirs, ours)
    for name, values in vars(ours).items():
        np.testing.assert_allclose(getattr(theirs, name), values[order], atol=2e-5, err_msg=name)
    save(scene, tmp_path / "x.ply")
    glb = convert("splat-transform", tmp_path / "x.ply", tmp_path / "x.glb")
    assert_same(arrays_of(read_scene(glb)), arrays_of(scene), opacity=5e-5)


@pytest.mark.parametrize("program", PROGRAMS)
def test_others_read_the_ply_of_a_compressed_scene(tmp_path: Path, program: str) -> None:
    save(coded_scene(COUNT), tmp_path / "x.nsvq")
    scene = read_scene(tmp_path / "x.nsvq")
    save(scene, tmp_path / "x.ply")
    theirs, ours = as_read(program, tmp_path / "x.ply"), arrays_of(scene)
    for name, values in vars(ours).items():
        np.testing.assert_array_equal(getattr(theirs, name), values, err_msg=name)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("version", [3, pytest.param(4, marks=needs_zstd)])
def test_spz_of_others_is_read_as_they_read_it(tmp_path: Path, version: int, degree: int, program: str) -> None:
    scene = plain_scene(COUNT, degree)
    save(scene, tmp_path / "x.ply")
    path = convert(program, tmp_path / "x.ply", tmp_path / "x.spz", version)
    header = read_spz_header(path)
    assert (header.version, header.count, header.sh_degree, header.system) == (version, COUNT, degree, 0)
    ours = arrays_of(read_scene(path))
    assert_same(as_read(program, path), ours)

    # And what was written, up to the bits of the format; SH are rounded to 5 and 4 bits.
    order, written = nearest_in(ours, arrays_of(scene)), arrays_of(scene)
    assert np.abs(ours.means - written.means[order]).max() <= 0.5 / (1 << header.fraction_bits) + 2e-6
    assert np.abs(ours.scales - written.scales[order]).max() <= 1 / 32 + 2e-6
    assert np.abs(sigmoid(ours.opacities) - sigmoid(written.opacities[order])).max() <= 0.5 / 255 + 2e-6
    assert np.abs(ours.sh0 - written.sh0[order]).max() <= 0.5 / 255 / 0.15 + 2e-6
    assert np.degrees(angles(ours.quats, written.quats[order])).max() <= 0.28
    assert degree == 0 or np.abs(ours.shN - written.shN[order]).max() <= 8.5 / 128 + 2e-6


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("degree", range(4))
def test_compressed_ply_of_others_is_read_as_they_read_it(tmp_path: Path, degree: int, program: str) -> None:
    scene = plain_scene(COUNT + 256, degree)
    save(scene, tmp_path / "x.ply")
    path = convert(program, tmp_path / "x.ply", tmp_path / "x.compressed.ply")
    ours = arrays_of(read_scene(path))
    assert_same(as_read(program, path), ours, opacity=1.1e-3)  # gaussforge keeps that far from 0 and 1
    facts = describe(path)
    assert (facts["format"], facts["splats"], facts["sh_degree"]) == ("compressed.ply", COUNT + 256, degree)
    assert facts["bytes"] == path.stat().st_size
    order, written = nearest_in(ours, arrays_of(scene)), arrays_of(scene)
    assert np.abs(ours.scales - written.scales[order]).max() <= 0.005
    assert np.degrees(angles(ours.quats, written.quats[order])).max() <= 0.3
    if program != "gaussforge":  # which writes the coefficients in another order than it reads them
        assert degree == 0 or np.abs(ours.shN - written.shN[order]).max() <= 0.5 * 8 / 255


@pytest.mark.parametrize("degree", range(4))
def test_sog_of_gaussforge_is_read_as_it_reads_it(tmp_path: Path, degree: int) -> None:
    save(plain_scene(COUNT, degree), tmp_path / "x.ply")
    path = convert("gaussforge", tmp_path / "x.ply", tmp_path / "x.sog")
    assert_same(as_read("gaussforge", path), arrays_of(read_scene(path)))


@pytest.mark.viewers
@pytest.mark.parametrize("suffix", [".ply", ".sog", ".spz"])
def test_splat_transform_reads_that_a_scene_is_antialiased(tmp_path: Path, suffix: str) -> None:
    save(replace(plain_scene(20), config={"antialiased": True}), tmp_path / f"x{suffix}")
    for target in ("y.compressed.ply", "y.spz"):
        assert read_scene(convert("splat-transform", tmp_path / f"x{suffix}", tmp_path / target)).antialiased
