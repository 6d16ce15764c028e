"""Our files as splat-transform reads them, column by column; docs/formats.md says how to install it."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from nsvq_lightning.io import SplatArrays, read_scene, save
from nsvq_lightning.io.spz import read_spz_header

sys.path.insert(0, str(Path(__file__).parent))
from viewer_scenes import angles, coded_scene, nearest_in, plain_scene, sigmoid

pytestmark = pytest.mark.viewers

TOOL = os.environ.get("NSVQ_SPLAT_TRANSFORM") or shutil.which("splat-transform")
COUNT = 120


def as_read(path: Path) -> SplatArrays:
    """The scene that splat-transform finds in a file, by the names of its columns."""
    if TOOL is None or shutil.which("node") is None:
        pytest.skip("node or splat-transform is not here; name the latter in NSVQ_SPLAT_TRANSFORM")
    table = path.with_suffix(".csv")
    done = subprocess.run([TOOL, "-w", "-g", "cpu", str(path), str(table)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    names = table.read_text().partition("\n")[0].split(",")
    values = np.genfromtxt(table, np.float64, delimiter=",", skip_header=1, ndmin=2)
    columns = dict(zip(names, values.T, strict=True))

    def stacked(*wanted: str) -> NDArray[np.float32]:
        return np.stack([columns.pop(name) for name in wanted], axis=1).astype(np.float32)

    rest = sum(name.startswith("f_rest_") for name in names)
    sh = stacked(*(f"f_rest_{i}" for i in range(rest))) if rest else np.zeros((len(values), 0), np.float32)
    arrays = SplatArrays(
        means=stacked("x", "y", "z"),
        quats=stacked("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=stacked("scale_0", "scale_1", "scale_2"),
        opacities=stacked("opacity")[:, 0],
        sh0=stacked("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
        shN=np.ascontiguousarray(sh.reshape(len(values), 3, rest // 3).transpose(0, 2, 1)),
    )
    assert set(columns) <= {"nx", "ny", "nz"}, "a column of no known meaning"
    return arrays


@pytest.mark.parametrize("make", [plain_scene, coded_scene])
@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz", ".sog"])
def test_splat_transform_reads_what_was_meant(tmp_path: Path, suffix: str, make: type) -> None:
    path, scene = tmp_path / f"x{suffix}", make(COUNT)
    save(scene, path)
    theirs, ours, written = as_read(path), read_scene(path).arrays(), scene.arrays()
    assert len(theirs) == COUNT

    # Exactly what our own reader finds, row for row: the files mean the same to both.
    np.testing.assert_allclose(theirs.means, ours.means, rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(theirs.scales, ours.scales, rtol=0, atol=2e-6)
    np.testing.assert_allclose(theirs.sh0, ours.sh0, rtol=0, atol=2e-6)
    np.testing.assert_allclose(sigmoid(theirs.opacities), sigmoid(ours.opacities), rtol=0, atol=2e-6)
    np.testing.assert_allclose(theirs.shN, ours.shN, rtol=0, atol=1e-6)
    # It takes the bytes of .splat for 255ths of [-1, 1], of which none is 0; the format's authors for 128ths.
    bias = math.asin(2 * 1 / 255) if suffix == ".splat" else 1e-6
    assert angles(theirs.quats, ours.quats).max() <= 2 * bias

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


def test_splat_transform_reads_the_ply_of_a_compressed_scene(tmp_path: Path) -> None:
    save(coded_scene(COUNT), tmp_path / "x.nsvq")
    scene = read_scene(tmp_path / "x.nsvq")
    save(scene, tmp_path / "x.ply")
    theirs, ours = as_read(tmp_path / "x.ply"), scene.arrays()
    for name, values in vars(ours).items():
        np.testing.assert_array_equal(getattr(theirs, name), values, err_msg=name)
