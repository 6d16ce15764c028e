"""Level ``compact``: errors within its precision, small, repeatable, and safe to read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from compressed_scenes import ON_NO_BASIS, SIZES, arrays_of, forge, on_basis, scene
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nsvq_lightning.io import CompressedScene, FormatError, read_header, read_nsvq, write_nsvq
from nsvq_lightning.io.formats import save
from nsvq_lightning.io.nsvq.file import encode
from nsvq_lightning.io.nsvq.precision import OPACITY_ERRORS, Precision, Storage
from nsvq_lightning.io.placing import rotated


def matched(original: SimpleNamespace, back: SimpleNamespace) -> NDArray[np.intp]:
    """Which original splat each decoded one is: the nearest position."""
    from scipy.spatial import cKDTree

    _, rows = cKDTree(original.means).query(back.means)
    assert len(np.unique(rows)) == len(original.means)
    return np.asarray(rows)


def unit(quats: NDArray[np.float32]) -> NDArray[np.float64]:
    rows: NDArray[np.float64] = quats.astype(np.float64)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.mark.parametrize("sizes", [SIZES, {}, {"shN": 8}, {"scales": 1, "quats": 300}])
def test_errors_stay_within_the_precision(tmp_path: Path, sizes: dict[str, int]) -> None:
    original, path = (
        scene(600, sizes, config={"seed": 1}, metrics={"psnr": 30.0}, origin=(1.0, 2.0, 1e6)),
        tmp_path / "x.nsvq",
    )
    precision = Precision(position=0.1, opacity=1 / 64, scales=0.05, quats=0.01, sh0=0.02, shN=0.005)
    assert write_nsvq(path, original, Storage(precision=precision)) == path.stat().st_size
    read = read_nsvq(path)
    told = {name: value for name, value in vars(precision).items() if name != "codebook"}  # that is the default
    assert read.config == original.config | {"precision": told}
    assert (read.metrics, read.origin) == (original.metrics, original.origin)
    assert read.stored_bytes == path.stat().st_size
    before, after = arrays_of(original), arrays_of(read)
    rows = matched(before, after)
    opacity = [1 / (1 + np.exp(-logits.astype(np.float64))) for logits in (before.opacities[rows], after.opacities)]
    widest = 0.1 * np.exp(after.scales.astype(np.float64).mean(1)) / np.sqrt(opacity[1])
    # The logarithm of the opacity is interpolated.
    assert (np.abs(after.means - before.means[rows]).max(1) <= 1.05 * widest + 1e-5).mean() > 0.998
    assert np.abs(opacity[1] - opacity[0]).max() <= 1 / 64 + 1e-6
    largest = {"scales": 0.05, "quats": 0.01, "sh0": 0.02, "shN": 0.005}
    for name, error in largest.items():
        was, now = getattr(before, name)[rows], getattr(after, name)
        if name == "quats":
            was, now = unit(was), now.astype(np.float64)
        if name in sizes:
            # A codebook's error follows the distance between its rows, here about as large as they are.
            error = 0.5 * float(was.std())
        assert np.abs(now - was).max() <= error + 1e-6


@pytest.mark.parametrize("sizes", [SIZES, {}, {"quats": 1, "scales": 300}])
@pytest.mark.parametrize("precision", [Precision(), Precision(position=0.002, opacity=0.0005), Precision(scales=0.1)])
def test_a_file_that_is_read_and_written_again_loses_nothing_more(
    tmp_path: Path, sizes: dict[str, int], precision: Precision
) -> None:
    once, twice = tmp_path / "once.nsvq", tmp_path / "twice.nsvq"
    write_nsvq(once, scene(3000, sizes), Storage(precision=precision))
    write_nsvq(twice, read_nsvq(once))
    first, second = arrays_of(read_nsvq(once)), arrays_of(read_nsvq(twice))
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name), err_msg=name)
    # A coarser precision rounds again, and is told in place of the old one.
    for coarse in (Precision(position=0.4, opacity=1 / 16, scales=0.2), Precision(position=0.4, scales=0.2)):
        write_nsvq(twice, read_nsvq(twice), Storage(precision=coarse))
        assert twice.stat().st_size < once.stat().st_size
        assert Storage.told(read_nsvq(twice).config).precision == coarse


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_coefficients_and_basis_are_exact(tmp_path: Path, degree: int) -> None:
    original, once, twice = on_basis(scene(600, {"scales": 9}, degree)), tmp_path / "once.nsvq", tmp_path / "twice.nsvq"
    write_nsvq(once, original)
    back = read_nsvq(once)
    rows = matched(arrays_of(original), arrays_of(back))
    np.testing.assert_array_equal(back.bases["shN"], original.bases["shN"], strict=True)
    np.testing.assert_array_equal(back.raw["shN"], original.raw["shN"][rows], strict=True)
    expected = original.values("shN")[rows]
    np.testing.assert_array_equal(back.values("shN"), expected, strict=True)
    part = back.take(np.arange(0, 600, 7))
    np.testing.assert_array_equal(part.values("shN"), expected[::7])
    write_nsvq(twice, back)
    assert twice.read_bytes() == once.read_bytes()
    write_nsvq(twice, back, Storage("paper"))
    plain = read_nsvq(twice)
    assert (once.read_bytes()[24], twice.read_bytes()[24], plain.bases) == (4, 4, {})
    np.testing.assert_array_equal(plain.values("shN"), expected)
    # Zeros of a quarter turn are not quite 0; the step does not follow them.
    write_nsvq(twice, rotated(back, Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()))
    assert twice.stat().st_size < 1.3 * once.stat().st_size


def test_finer_precision_is_nearer_and_larger(tmp_path: Path) -> None:
    original, path = scene(2000), tmp_path / "x.nsvq"
    sizes, errors = [], []
    for position in (0.4, 0.1, 0.025):
        sizes.append(write_nsvq(path, original, Storage(precision=Precision(position=position))))
        back = arrays_of(read_nsvq(path))
        rows = matched(arrays_of(original), back)
        errors.append(np.abs(back.means - original.means[rows]).mean())
    assert sizes == sorted(sizes)
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    # A quarter of the error is two bits more for each of three coordinates.
    assert 8 * (sizes[2] - sizes[1]) / 2000 == pytest.approx(6, abs=0.5)


def test_rows_that_no_splat_uses_are_left_out_and_equal_ones_become_one(tmp_path: Path) -> None:
    plain = scene(50, {"sh0": 40})
    codebook = plain.codebooks["sh0"].copy()
    codebook[3] = codebook[5]
    codes = np.array([1, 3, 5, 7, 9])[np.arange(50) % 5]
    original = CompressedScene(plain.means, plain.opacities, {"sh0": codes}, {"sh0": codebook}, plain.raw)
    write_nsvq(tmp_path / "x.nsvq", original)
    assert len(read_nsvq(tmp_path / "x.nsvq").codebooks["sh0"]) == 4


def test_far_splats_keep_their_float(tmp_path: Path) -> None:
    original = scene(3000)
    original.means[10] = 1e9, -3.3e8, 1.5
    write_nsvq(tmp_path / "x.nsvq", original)
    back = arrays_of(read_nsvq(tmp_path / "x.nsvq"))
    np.testing.assert_array_equal(back.means[-1], original.means[10])
    rows = matched(arrays_of(original), back)
    assert np.abs(back.means - original.means[rows]).max() < 0.05


@pytest.mark.parametrize("share", [1000, 20])
def test_splats_as_large_as_the_scene_keep_their_depth(tmp_path: Path, share: int) -> None:
    original = scene(3000, {})
    spread = np.ptp(original.means, axis=0).max()
    original.raw["scales"][:] = np.log(spread / share)
    original.raw["scales"][:5] = np.log(3 * spread)
    original.opacities[:5] = -2.5
    write_nsvq(tmp_path / "x.nsvq", original)
    back = read_nsvq(tmp_path / "x.nsvq")
    exact = {tuple(place) for place in back.means.tolist()} & {tuple(place) for place in original.means.tolist()}
    assert {tuple(place) for place in original.means[:5].tolist()} <= exact
    assert len(exact) < 20
    save(back, tmp_path / "again.nsvq")
    np.testing.assert_array_equal(read_nsvq(tmp_path / "again.nsvq").means, back.means)


def test_same_scene_same_bytes_for_any_number_of_threads(tmp_path: Path) -> None:
    files = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            write_nsvq(tmp_path / f"{count}.nsvq", scene(5000))
            files.append((tmp_path / f"{count}.nsvq").read_bytes())
    finally:
        torch.set_num_threads(threads)
    assert files[0] == files[1] == files[2]


def test_extreme_numbers_are_stored_or_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "x.nsvq"
    original = scene(20, {})
    original.raw["scales"][0] = 200.0
    original.raw["scales"][1] = -1e4
    original.raw["quats"][2] = 0.0
    original.opacities[3:5] = 1e30, -1e30
    write_nsvq(path, original)
    back = arrays_of(read_nsvq(path))
    assert all(np.isfinite(values).all() for values in vars(back).values())
    assert [1.0, 0.0, 0.0, 0.0] in back.quats.tolist()
    original.raw["shN"][5, 7] = 1e20
    with pytest.raises(ValueError, match="shN: 1e\\+20 is too large"):
        write_nsvq(path, original)
    original.raw["shN"][5, 7] = np.nan
    with pytest.raises(ValueError, match=r"not finite \(shN in 1 rows\)"):
        write_nsvq(path, original)
    assert len(read_nsvq(path)) == 20


def test_a_code_that_no_splat_has_may_be_broken(tmp_path: Path) -> None:
    original, path = scene(100, {"scales": 8, "quats": 16}), tmp_path / "x.nsvq"
    codes = original.codes["scales"]
    codes[codes == 3] = 0
    whole = encode(original, Storage())[1]
    original.codebooks["scales"][3] = np.nan
    assert encode(original, Storage())[1] == whole
    original.codes["scales"][7] = 3
    with pytest.raises(ValueError, match=r"not finite \(scales in 1 rows\)"):
        write_nsvq(path, original)
    assert save(original, path) == path.stat().st_size
    assert len(read_nsvq(path)) == 99


STORAGE, CODES, STEP = 2, 3, 4
"""Columns of the attribute table."""


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.update(splats=10**12),
        lambda t: t.update(splats=300),
        lambda t: t.update(splats=3),
        lambda t: t.update(sh_degree=2),
        lambda t: t["attributes"].pop(),
        lambda t: t["attributes"][1].__setitem__(CODES, 10**9),
        lambda t: t["attributes"][1].__setitem__(CODES, 99),
        lambda t: t["attributes"][1].__setitem__(STEP, 0.0),
        lambda t: t["attributes"][1].__setitem__(STEP, "wide"),
        lambda t: t["attributes"][1].__setitem__(STORAGE, "raw"),
        lambda t: t["attributes"][1].pop(),
        lambda t: t["attributes"][2].__setitem__(STORAGE, "grid"),
        lambda t: t["attributes"][2].__setitem__(slice(STORAGE, None), ["codes", 2, 0.1]),
        lambda t: t["attributes"][0].__setitem__(CODES, 1 << 30),
        lambda t: t["streams"][0].__setitem__(0, "other"),
    ],
)
def test_tables_that_do_not_fit_are_refused(tmp_path: Path, change: Any) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, scene(30))
    forge(path, change)
    with pytest.raises(FormatError, match="damaged"):
        read_nsvq(path)


@pytest.mark.parametrize("change", ON_NO_BASIS.values(), ids=ON_NO_BASIS)
def test_tables_that_do_not_fit_a_basis_are_refused(tmp_path: Path, change: Any) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, on_basis(scene(30, {})))
    forge(path, change)
    with pytest.raises(FormatError, match=r"damaged: (impossible|the (attribute|stream) table)"):
        read_nsvq(path)


def test_components_that_are_too_large_are_refused_by_name(tmp_path: Path) -> None:
    original = on_basis(scene(30, {}))
    original.raw["shN"][3, 0] = 2.0**23
    with pytest.raises(ValueError, match=r"shN: 8\.39e\+06 is too large for steps of 1"):
        write_nsvq(tmp_path / "x.nsvq", original)
    write_nsvq(tmp_path / "x.nsvq", replace(on_basis(scene(30, {})), bases={"shN": 0 * original.bases["shN"]}))
    assert not read_nsvq(tmp_path / "x.nsvq").values("shN").any()


@pytest.mark.parametrize(
    "bad",
    [
        {"position": 0.0},
        {"opacity": 0.5},
        {"opacity": 1e-7},
        {"opacity": 1e-320},
        {"shN": float("nan")},
        {"quats": -1.0},
    ],
)
def test_precision_must_be_positive_and_readable(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"precision: {next(iter(bad))} must be"):
        Precision(**bad)


def test_the_finest_opacities_are_read_back(tmp_path: Path) -> None:
    original, path = scene(30), tmp_path / "x.nsvq"
    write_nsvq(path, original, Storage(precision=Precision(opacity=OPACITY_ERRORS[0])))
    assert len(read_nsvq(path)) == 30


def test_it_is_much_smaller_than_the_level_paper(tmp_path: Path) -> None:
    original = scene(20_000, {"quats": 512, "scales": 512, "sh0": 128, "shN": 128})
    paper = write_nsvq(tmp_path / "p.nsvq", original, Storage("paper"))
    compact = write_nsvq(tmp_path / "c.nsvq", original)
    # Random codes have no structure to use: what is saved is in positions, opacities and codebooks.
    assert compact < 0.55 * paper
    streams = {stream.name: stream.length for stream in read_header(tmp_path / "c.nsvq").streams}
    assert 8 * streams["means"] / 20_000 < 28
    assert 8 * streams["opacities"] / 20_000 < 7.1
