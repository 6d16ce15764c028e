"""Our files as splat-transform reads them, column by column; docs/formats.md says how to install it."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from viewer_scenes import (
    angles,
    assert_same,
    coded_scene,
    nearest_in,
    needs_zstd,
    plain_scene,
    read_table,
    sigmoid,
)

from nsvq_lightning.io import SplatArrays, read_scene, save
from nsvq_lightning.io.spz_frame import read_spz_header

pytestmark = pytest.mark.viewers

TOOL = os.environ.get("NSVQ_SPLAT_TRANSFORM") or shutil.which("splat-transform")
COUNT = 120


def transform(source: Path, target: Path, *options: str) -> Path:
    """Have splat-transform convert a file."""
    if TOOL is None or shutil.which("node") is None:
        pytest.skip("node or splat-transform is not here; name the latter in NSVQ_SPLAT_TRANSFORM")
    command = [TOOL, "-w", "-g", "cpu", *options, str(source), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return target


def as_read(path: Path) -> SplatArrays:
    """The scene that splat-transform finds in a file."""
    return read_table(transform(path, path.with_suffix(".csv")))


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
def test_splat_transform_reads_what_was_meant(tmp_path: Path, suffix: str, options: dict[str, int], make: type) -> None:
    path, scene = tmp_path / f"x{suffix}", make(COUNT)
    save(scene, path, **options)
    theirs, ours, written = as_read(path), read_scene(path).arrays(), scene.arrays()
    assert len(theirs) == COUNT

    # Exactly what our own reader finds, row for row: the files mean the same to both.
    # It takes the bytes of .splat for 255ths of [-1, 1], of which none is 0; the format's authors for 128ths.
    bias = math.asin(2 * 1 / 255) if suffix == ".splat" else 1e-6
    assert_same(theirs, ours, 2 * bias)

    # And what was written, up to the bits of the format.
    order = nearest_in(theirs, written)
    bits = {".splat": 0.0, ".ply": 0.0}
    if suffix == ".spz":
        bits[suffix] = 0.5 / (1 << read_spz_header(path)[0].fraction_bits)
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


def test_splat_transform_reads_the_ply_of_a_compressed_scene(tmp_path: Path) -> None:
    save(coded_scene(COUNT), tmp_path / "x.nsvq")
    scene = read_scene(tmp_path / "x.nsvq")
    save(scene, tmp_path / "x.ply")
    theirs, ours = as_read(tmp_path / "x.ply"), scene.arrays()
    for name, values in vars(ours).items():
        np.testing.assert_array_equal(getattr(theirs, name), values, err_msg=name)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("version", [3, pytest.param(4, marks=needs_zstd)])
def test_spz_of_splat_transform_is_read_as_it_reads_it(tmp_path: Path, version: int, degree: int) -> None:
    scene = plain_scene(COUNT, degree)
    save(scene, tmp_path / "x.ply")
    path = transform(tmp_path / "x.ply", tmp_path / "x.spz", "--spz-version", str(version))
    header, _ = read_spz_header(path)
    assert (header.version, header.count, header.sh_degree) == (version, COUNT, degree)
    ours = read_scene(path).arrays()
    assert_same(as_read(path), ours)

    # And what it wrote, up to the bits of the format; it rounds SH to 5 and 4 bits.
    order, written = nearest_in(ours, scene.arrays()), scene.arrays()
    assert np.abs(ours.means - written.means[order]).max() <= 0.5 / (1 << header.fraction_bits) + 2e-6
    assert np.abs(ours.scales - written.scales[order]).max() <= 1 / 32 + 2e-6
    assert np.abs(sigmoid(ours.opacities) - sigmoid(written.opacities[order])).max() <= 0.5 / 255 + 2e-6
    assert np.abs(ours.sh0 - written.sh0[order]).max() <= 0.5 / 255 / 0.15 + 2e-6
    assert np.degrees(angles(ours.quats, written.quats[order])).max() <= 0.28
    assert degree == 0 or np.abs(ours.shN - written.shN[order]).max() <= 8.5 / 128 + 2e-6
