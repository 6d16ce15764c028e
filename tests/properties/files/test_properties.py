"""What must hold for any scene: written and read, it is the same one, within what the format promises."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from compressed_scenes import arrays_of
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from viewer_scenes import WRITTEN

from nsvq_lightning.io import CompressedScene, read_nsvq, write_nsvq
from nsvq_lightning.io.formats import read_scene, save
from nsvq_lightning.io.nsvq.precision import Precision, Storage
from nsvq_lightning.splats.attributes import QUANTIZABLE, attribute_dims

CASES = int(os.environ.get("NSVQ_FUZZ_CASES", "40"))
"""Scenes for each property; more in a run by hand."""


def any_scene(seed: int) -> CompressedScene:
    """A scene of any size, degree, unit of length and set of codebooks, with splats that coincide and flat clouds."""
    rng = np.random.default_rng([seed, 5])
    n, degree = int(rng.choice([1, 1, 2, 3, 17, 64, 65, 300])), int(rng.integers(4))
    unit = 10.0 ** rng.uniform(-4, 4)
    dims = {name: attribute_dims(degree)[name] for name in QUANTIZABLE}
    coded = {name: int(rng.integers(1, 70)) for name in dims if dims[name] and rng.random() < 0.5}

    def rows(name: str, count: int) -> NDArray[np.float32]:
        values = rng.normal(0, 0.1 if name == "shN" else 1, (count, dims[name]))
        if name == "scales":
            values += np.log(unit) - 4
        if name == "quats":
            values[:, 0] += np.where(np.abs(values).max(1) < 0.05, 1, 0)
        return values.astype(np.float32)

    means = unit * rng.normal(size=(n, 3)) * rng.choice([0, 1], 3, p=[0.2, 0.8])
    means[rng.random(n) < 0.1] = means[0]
    return CompressedScene(
        means=means.astype(np.float32),
        opacities=rng.normal(0, 4, n).astype(np.float32),
        codes={name: rng.integers(0, k, n) for name, k in coded.items()},
        codebooks={name: rows(name, k) for name, k in coded.items()},
        raw={name: rows(name, n) for name in dims if name not in coded},
        sh_degree=degree,
    )


@pytest.mark.parametrize("suffix", [".ply", ".nsvq"])
def test_what_loses_nothing_gives_every_number_back(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"scene{suffix}"
    for seed in range(CASES):
        scene = any_scene(seed)
        save(scene, path, Storage("paper"))
        back, expected = arrays_of(read_scene(path)), arrays_of(scene)
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(back, name), getattr(expected, name), err_msg=f"{name}, seed {seed}")


def test_compact_keeps_every_splat_where_it_promises(tmp_path: Path) -> None:
    path, precision = tmp_path / "scene.nsvq", Precision()
    for seed in range(CASES):
        scene = any_scene(seed)
        write_nsvq(path, scene, Storage(precision=precision))
        back = read_nsvq(path)
        assert len(back) == len(scene), f"seed {seed}"
        arrays, stored = arrays_of(scene), arrays_of(back)
        extent = np.ptp(arrays.means, axis=0).max()
        distance, nearest = cKDTree(stored.means).query(arrays.means, p=np.inf)
        # Steps follow the sizes as stored, which have an error of their own.
        size = np.exp(np.maximum(arrays.scales.mean(1, dtype=np.float64), stored.scales[nearest].mean(1)))
        opacity = 1 / (1 + np.exp(-arrays.opacities.astype(np.float64)))
        size /= np.sqrt(np.maximum(opacity - precision.opacity, precision.opacity))
        rounding = 4 * np.finfo(np.float32).eps * np.abs(arrays.means).max()
        bound = np.maximum(precision.position * size, extent * 2.0**-20)
        # The grid is as fine as all but the smallest thousandth of the splats ask for.
        assert (distance > 1.07 * bound + rounding).sum() <= np.ceil(len(scene) / 1000), f"seed {seed}"


@pytest.mark.parametrize("suffix", sorted(WRITTEN))
def test_the_same_scene_gives_the_same_bytes_and_all_its_splats(suffix: str, tmp_path: Path) -> None:
    first, second = (tmp_path / folder / f"x{suffix}" for folder in "ab")
    for seed in range(CASES):
        scene = any_scene(seed)
        for path in (first, second):
            path.parent.mkdir(exist_ok=True)
            save(scene, path)
        assert first.read_bytes() == second.read_bytes(), f"seed {seed}"
        back = read_scene(first)
        assert len(back) == len(scene), f"seed {seed}"
        assert all(np.isfinite(back.values(name)).all() for name in ("means", "quats", "scales", "opacities", "sh0"))
