"""Scenes for the tests of the formats of viewers, and the errors that the bits of a format allow."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from compressed_scenes import scene_of
from numpy.typing import NDArray

from nsvq_lightning.io import FORMATS, CompressedScene, spz

WRITTEN = [suffix for suffix, entry in FORMATS.items() if entry.write is not None]
"""Formats that are written; all are read."""
HAS_ZSTD = any(find_spec(parent) and find_spec(f"{parent}.zstd") for parent in ("compression", "backports"))
needs_zstd = pytest.mark.skipif(not HAS_ZSTD, reason="no Zstandard: pip install 'nsvq-lightning[spz]'")


def plain_scene(n: int, degree: int = 3, seed: int = 0) -> CompressedScene:
    """Splats within the range of every format, all numbers different."""
    rng = np.random.default_rng([n, degree, seed])
    return scene_of(
        means=rng.normal(0, 5, (n, 3)).astype(np.float32),
        quats=rng.normal(0, 3, (n, 4)).astype(np.float32),
        scales=rng.uniform(-7, 1, (n, 3)).astype(np.float32),
        opacities=rng.normal(0, 2, n).astype(np.float32),
        sh0=rng.uniform(-1.7, 1.7, (n, 1, 3)).astype(np.float32),
        shN=rng.uniform(-0.9, 0.9, (n, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
    )


def coded_scene(n: int, degree: int = 3, rows: int = 20) -> CompressedScene:
    """The same with codebooks, of which the last row is not used; rotations are plain."""
    plain = plain_scene(n, degree)
    rng = np.random.default_rng([n, degree, rows])
    names = ("scales", "sh0", "shN") if degree else ("scales", "sh0")
    source = plain_scene(rows, degree, seed=1)
    return CompressedScene(
        plain.means,
        plain.opacities,
        codes={name: rng.integers(0, rows - 1, n) for name in names},
        codebooks={name: source.raw[name] for name in names},
        raw={name: values for name, values in plain.raw.items() if name not in names},
        sh_degree=degree,
    )


def nearest_in(read: SimpleNamespace, written: SimpleNamespace) -> NDArray[np.intp]:
    """For each splat that was read the one that was written, by position: formats may reorder."""
    distance = np.abs(read.means[:, None].astype(np.float64) - written.means[None]).max(2)
    order = distance.argmin(1)
    assert len(set(order.tolist())) == len(written.means)
    return order


def angles(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Angles between rotations ``[N, 4]`` of any norm, radians."""
    a64, b64 = (q.astype(np.float64) / np.linalg.norm(q.astype(np.float64), axis=1, keepdims=True) for q in (a, b))
    # The length of the difference, not the scalar product: that loses small angles.
    return 4 * np.arcsin(np.minimum(np.linalg.norm(a64 - b64, axis=1), np.linalg.norm(a64 + b64, axis=1)) / 2)


def sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float64]:
    return 1 / (1 + np.exp(-logits.astype(np.float64)))


def read_spz_header(path: Path) -> spz.SpzHeader:
    """Header of any version."""
    data = path.read_bytes()
    return spz._unpack(data)[0] if data.startswith(b"NGSP") else spz._unzip(data)[0]


def read_table(path: Path) -> SimpleNamespace:
    """The scene of a .csv file of splat-transform, by the names of its columns."""
    names = path.read_text().partition("\n")[0].split(",")
    values = np.genfromtxt(path, np.float64, delimiter=",", skip_header=1, ndmin=2)
    columns = dict(zip(names, values.T, strict=True))

    def stacked(*wanted: str) -> NDArray[np.float32]:
        return np.stack([columns.pop(name) for name in wanted], axis=1).astype(np.float32)

    rest = sum(name.startswith("f_rest_") for name in names)
    sh = stacked(*(f"f_rest_{i}" for i in range(rest))) if rest else np.zeros((len(values), 0), np.float32)
    arrays = SimpleNamespace(
        means=stacked("x", "y", "z"),
        quats=stacked("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=stacked("scale_0", "scale_1", "scale_2"),
        opacities=stacked("opacity")[:, 0],
        sh0=stacked("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
        shN=np.ascontiguousarray(sh.reshape(len(values), 3, rest // 3).transpose(0, 2, 1)),
    )
    assert set(columns) <= {"nx", "ny", "nz"}, "a column of no known meaning"
    return arrays


def assert_same(theirs: SimpleNamespace, ours: SimpleNamespace, rotation: float = 2e-6, opacity: float = 2e-6) -> None:
    """Two readers found the same numbers, row for row, up to their floating-point arithmetic."""
    np.testing.assert_allclose(theirs.means, ours.means, rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(theirs.scales, ours.scales, rtol=0, atol=2e-6)
    np.testing.assert_allclose(theirs.sh0, ours.sh0, rtol=0, atol=2e-6)
    np.testing.assert_allclose(sigmoid(theirs.opacities), sigmoid(ours.opacities), rtol=0, atol=opacity)
    np.testing.assert_allclose(theirs.shN, ours.shN, rtol=0, atol=1e-6)
    assert angles(theirs.quats, ours.quats).max() <= rotation
