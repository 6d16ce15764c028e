"""``.splat``, ``.spz`` and ``.sog``: what comes back, how exactly, and what damage leads to."""

from __future__ import annotations

import gzip
import json
import logging
import math
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from compressed_scenes import arrays_of
from ring import cameras_around
from scipy.spatial.transform import Rotation
from viewer_scenes import (
    angles,
    assert_same,
    coded_scene,
    nearest_in,
    needs_zstd,
    plain_scene,
    read_spz_header,
    sigmoid,
)

from nsvq_lightning.compression.viewpoints import Measure, decibels
from nsvq_lightning.io import CompressedScene, FormatError, load, read_scene, save
from nsvq_lightning.io.formats import describe
from nsvq_lightning.io.sog import write_sog
from nsvq_lightning.rendering.sh import sh_basis

SUFFIXES = (".splat", ".spz", ".sog")
SH_C0 = 0.28209479177387814
SH_FILES = ["shN_centroids.webp", "shN_labels.webp"]


def round_trip(scene: CompressedScene, path: Path, **options: int | str) -> tuple[SimpleNamespace, SimpleNamespace]:
    """What was read, and what was written in the order of the file."""
    assert save(scene, path, **options) == path.stat().st_size
    read, written = arrays_of(read_scene(path)), arrays_of(scene)
    order = nearest_in(read, written)
    return read, SimpleNamespace(**{name: values[order] for name, values in vars(written).items()})


def rotation_bound(component: float) -> float:
    """Largest angle where each of the smallest three is off by so much: the largest follows with √3 times theirs."""
    return 2 * 2 * math.sqrt(3) * component * 1.02


@pytest.mark.parametrize("make", [plain_scene, coded_scene])
def test_splat_is_as_exact_as_its_bytes(tmp_path: Path, make: type) -> None:
    scene = make(150)
    read, written = round_trip(scene, tmp_path / "x.splat")
    assert (tmp_path / "x.splat").stat().st_size == 32 * 150
    np.testing.assert_array_equal(read.means, scene.means)
    np.testing.assert_allclose(read.scales, written.scales, rtol=0, atol=2e-6)
    assert np.abs(sigmoid(read.opacities) - sigmoid(written.opacities)).max() <= 0.5 / 255 + 1e-7
    assert np.abs(read.sh0 - written.sh0).max() <= 0.5 / 255 / SH_C0 + 1e-6
    assert angles(read.quats, written.quats).max() <= 2 * math.asin(math.sqrt(4) * 0.5 / 128)
    assert read.shN.shape == (150, 0, 3)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("make", [plain_scene, coded_scene])
@pytest.mark.parametrize("version", [3, pytest.param(4, marks=needs_zstd)])
def test_spz_is_as_exact_as_its_bits(tmp_path: Path, version: int, make: type, degree: int) -> None:
    path = tmp_path / "x.spz"
    scene = make(150, degree)
    read, written = round_trip(scene, path, version=version)
    header = read_spz_header(path)
    assert (header.version, header.count, header.sh_degree) == (version, 150, degree)
    assert np.abs(read.means - written.means).max() <= 0.5 / (1 << header.fraction_bits) + 1e-6
    assert np.abs(read.scales - written.scales).max() <= 0.5 / 16 + 1e-6
    assert np.abs(sigmoid(read.opacities) - sigmoid(written.opacities)).max() <= 0.5 / 255 + 1e-7
    assert np.abs(read.sh0 - written.sh0).max() <= 0.5 / 255 / 0.15 + 1e-6
    assert angles(read.quats, written.quats).max() <= rotation_bound(0.5 / 511 / math.sqrt(2))
    assert degree == 0 or np.abs(read.shN - written.shN).max() <= 0.5 / 128 + 1e-6


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("make", [plain_scene, coded_scene])
def test_sog_is_as_exact_as_its_bits(tmp_path: Path, make: type, degree: int) -> None:
    path = tmp_path / "x.sog"
    scene = make(150, degree)
    read, written = round_trip(scene, path)
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
    extent = np.subtract(meta["means"]["maxs"], meta["means"]["mins"])
    bound = 0.5 * extent / 65535 * (1 + np.abs(written.means)) * 1.001 + 1e-6
    assert (np.abs(read.means - written.means) <= bound).all()
    assert np.abs(sigmoid(read.opacities) - sigmoid(written.opacities)).max() <= 0.5 / 255 + 1e-7
    assert angles(read.quats, written.quats).max() <= rotation_bound(0.5 / 127.5 / math.sqrt(2))
    for name in ("scales", "sh0", "shN")[: 3 if degree else 2]:
        levels = np.array(meta[name]["codebook"])
        assert len(levels) == 256
        values = getattr(written, name).astype(np.float64)
        nearest = np.abs(values[..., None] - levels).min(-1)
        np.testing.assert_allclose(np.abs(getattr(read, name) - values), nearest, rtol=0, atol=1e-6)
    if make is coded_scene:  # 20 rows of 3 numbers fit into 256 levels
        np.testing.assert_array_equal(read.scales, written.scales)
        np.testing.assert_array_equal(read.sh0, written.sh0)
    assert ("shN" in meta) == (degree > 0)


def test_sog_takes_the_codebook_as_its_palette_and_the_codes_as_labels(tmp_path: Path) -> None:
    scene = coded_scene(200, 3, rows=80)
    save(scene, tmp_path / "x.sog")
    back = read_scene(tmp_path / "x.sog")
    assert back.stored_bytes == (tmp_path / "x.sog").stat().st_size
    order = nearest_in(arrays_of(back), arrays_of(scene))
    codes, first = np.unique(scene.codes["shN"][order], return_index=True)
    used = codes[np.argsort(first)]  # in the order of the splats of the file
    np.testing.assert_array_equal(used[back.codes["shN"]], scene.codes["shN"][order])
    assert back.codebooks["shN"].shape == (len(used), 45)
    assert np.abs(back.codebooks["shN"] - scene.codebooks["shN"][used]).max() < 0.01  # 256 levels for ±0.9
    # And back: a second file has the same palette and labels.
    save(back, tmp_path / "y.sog")
    again = read_scene(tmp_path / "y.sog")
    np.testing.assert_array_equal(again.codebooks["shN"], back.codebooks["shN"])


def test_sog_finds_a_palette_of_the_stated_size_where_there_is_none(tmp_path: Path) -> None:
    scene = plain_scene(300)
    assert len(read_scene_of(scene, tmp_path / "x.sog").codebooks["shN"]) == 300  # all distinct rows
    small = read_scene_of(scene, tmp_path / "y.sog", palette=16)
    assert len(small.codebooks["shN"]) == 16
    assert (np.diff(np.unique(small.codes["shN"], return_index=True)[1]) > 0).all()  # in the order of first use
    for palette in (0, 65537):
        with pytest.raises(ValueError, match=r"palette must be in 1\.\.65536"):
            write_sog(tmp_path / "z.sog", scene, palette=palette)


def test_sog_clusters_a_codebook_with_more_rows_than_labels(tmp_path: Path) -> None:
    n = 65600
    rng = np.random.default_rng(0)
    plain = plain_scene(n, 1)
    codes = {"shN": np.repeat(np.arange(n), 1)}
    codebook = np.repeat(rng.normal(size=(8, 9)), n // 8, axis=0).astype(np.float32)
    raw = {name: values for name, values in plain.raw.items() if name != "shN"}
    scene = replace(plain, raw=raw, codes=codes, codebooks={"shN": codebook})
    back = read_scene_of(scene, tmp_path / "x.sog", palette=8)
    assert len(back.codebooks["shN"]) == 8
    assert np.unique(back.codes["shN"], return_counts=True)[1].tolist() == [n // 8] * 8


def read_scene_of(scene: CompressedScene, path: Path, **options: int | str) -> CompressedScene:
    save(scene, path, **options)
    return read_scene(path)


SYSTEMS = ["RDF", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"]


@pytest.mark.parametrize(("number", "axes"), [*enumerate(SYSTEMS), (12, "RFU")])
def test_spz_has_the_axes_that_it_states(tmp_path: Path, number: int, axes: str) -> None:
    """Oracle: axes are mapped by their letters; shapes and colours turn with what they are seen along."""
    path = tmp_path / "x.spz"
    save(plain_scene(5), path, axes="rub")
    content = gzip.decompress(path.read_bytes())
    assert content[-12:] == struct.pack("<III", 0xADBE0003, 4, 4)

    def stating(system: int) -> SimpleNamespace:
        path.write_bytes(gzip.compress(content[:-4] + struct.pack("<I", system)))
        return arrays_of(read_scene(path))

    stored, read = stating(6), stating(number)
    opposite = dict(zip("RLDUFB", "LRUDBF", strict=True))
    to_ours = np.array([[(a == own) - (a == opposite[own]) for a in axes] for own in "RDF"])
    np.testing.assert_allclose(read.means, stored.means @ to_ours.T, atol=1e-6)
    theirs, ours = (
        turn * np.exp(a.scales)[:, None] @ turn.transpose(0, 2, 1)
        for a in (stored, read)
        for turn in [Rotation.from_quat(np.roll(a.quats, -1, axis=1)).as_matrix()]
    )
    np.testing.assert_allclose(ours, to_ours @ theirs @ to_ours.T, atol=1e-5)
    directions = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen, meant = (
        np.einsum("dk,kc->dc", sh_basis(torch.tensor(d), 3)[:, 1:].numpy(), a.shN[0])
        for d, a in ((directions, read), (directions @ to_ours, stored))
    )
    np.testing.assert_allclose(seen, meant, atol=1e-5)


@pytest.mark.parametrize("version", [3, pytest.param(4, marks=needs_zstd)])
def test_spz_has_the_axes_of_ply_unless_told_otherwise(
    tmp_path: Path, version: int, caplog: pytest.LogCaptureFixture
) -> None:
    path, scene = tmp_path / "x.spz", plain_scene(1)
    caplog.set_level(logging.INFO)
    turned = arrays_of(read_scene_of(scene, path, version=version, axes="rub"))
    assert (read_spz_header(path).system, caplog.text) == (4, "")
    silent = version == 3  # which all viewers show upright
    plain = arrays_of(read_scene_of(scene, path, version=version))
    assert read_spz_header(path).system == (0 if silent else 6)
    assert ("x.spz: the file does not say where its axes point; taken as right, down, front" in caplog.text) == silent
    assert_same(turned, plain)
    if version == 3:
        x = int.from_bytes(gzip.decompress(path.read_bytes())[19:22], "little", signed=True)
        assert x / (1 << read_spz_header(path).fraction_bits) == plain.means[0, 1]
    with pytest.raises(ValueError, match=r"axes of \.spz must be rdf or rub, got 'luf'"):
        save(scene, path, axes="luf")


@pytest.mark.parametrize("version", [1, 2])
def test_spz_of_older_versions(tmp_path: Path, version: int) -> None:
    """Two splats written by hand."""
    means = np.array([[1.5, 2, -3], [0, -0.25, 100]])
    positions = (
        means.astype("<f2").tobytes()
        if version == 1
        else b"".join(round(v * 256).to_bytes(3, "little", signed=True) for v in means.ravel())
    )
    body = (
        positions + bytes([0, 255]) + bytes([0, 128, 255] * 2) + bytes([160] * 6) + bytes([255, 128, 128, 128] * 2)[:6]
    )
    header = struct.pack("<4sIIBBBB", b"NGSP", version, 2, 0, 8, 0, 0)
    path = tmp_path / "x.spz"
    path.write_bytes(gzip.compress(header + body + b"extensions"))
    read = load(path)
    np.testing.assert_allclose(read.means.detach().numpy(), means)
    assert read.opacities.tolist() == [-20, 20]
    np.testing.assert_allclose(read.scales.detach().numpy(), 0)
    np.testing.assert_allclose(read.sh0[0, 0].tolist(), [-0.5 / 0.15, 0.5 / 255 / 0.15, 0.5 / 0.15], atol=1e-6)
    half = 1 / 255
    np.testing.assert_allclose(read.quats[0].tolist(), [0, 1, half, half], atol=1e-6)


@pytest.mark.parametrize(("extent", "log_scale", "bits"), [(10.0, -5.0, 12), (0.01, -11.0, 20), (3e4, -3.0, 8)])
def test_spz_positions_suit_the_size_of_the_scene(tmp_path: Path, extent: float, log_scale: float, bits: int) -> None:
    scene = plain_scene(100, 0)
    means = (scene.means / np.abs(scene.means).max() * extent).astype(np.float32)
    scales = np.full((100, 3), log_scale, np.float32)
    scene = replace(scene, means=means, raw={**scene.raw, "scales": scales})
    save(scene, tmp_path / "x.spz")
    assert read_spz_header(tmp_path / "x.spz").fraction_bits == bits


def test_a_far_splat_does_not_make_spz_coarse(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = plain_scene(2000, 0)
    scene.means[7] = [1e5, 0, 0]
    with caplog.at_level(logging.WARNING):
        back = arrays_of(read_scene_of(scene, tmp_path / "x.spz"))
    assert "means 1 (of 2000" in caplog.text
    assert read_spz_header(tmp_path / "x.spz").fraction_bits == 12
    assert back.means.max() == pytest.approx(2048, abs=0.01)


def test_a_sky_of_half_a_percent_keeps_its_place_in_spz(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = plain_scene(2000, 0)
    scene.means[:10] = [3000, 0, 0]
    back = arrays_of(read_scene_of(scene, tmp_path / "x.spz"))
    assert "clamped" not in caplog.text
    np.testing.assert_allclose(np.sort(back.means, 0), np.sort(scene.means, 0), atol=2**-12)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_values_out_of_range_are_clamped_and_counted(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    scene = plain_scene(50, 1)
    raw = {name: values.copy() for name, values in scene.raw.items()}
    raw["sh0"][:3, 0] = 9
    raw["scales"][4, 1] = -30
    raw["shN"][7:9, 2] = -5
    scene = replace(scene, raw=raw)
    with caplog.at_level(logging.WARNING):
        read, written = round_trip(scene, tmp_path / f"x{suffix}")
    expected = {".splat": "sh0 3 (of 50", ".spz": "sh0 3, scales 1, shN 2 (of 50", ".sog": ""}[suffix]
    assert expected in caplog.text
    assert ("clamped to it" in caplog.text) == bool(expected)
    if suffix == ".spz":
        assert read.scales.min() == -10
        assert read.shN.min() == -1
    if suffix == ".sog":
        np.testing.assert_allclose(read.sh0, written.sh0, atol=0.05)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_zero_quaternion_is_the_identity(tmp_path: Path, suffix: str) -> None:
    zero = replace(plain_scene(1), raw={**plain_scene(1).raw, "quats": np.zeros((1, 4), np.float32)})
    back = arrays_of(read_scene_of(zero, tmp_path / f"x{suffix}"))
    assert angles(back.quats, np.array([[1, 0, 0, 0]], np.float32)).max() < 0.01


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_description(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    save(coded_scene(60, 2), path)
    facts = describe(path)
    assert (facts["format"], facts["splats"]) == (suffix[1:], 60)
    assert (facts["sh_degree"], facts["bytes"]) == (0 if suffix == ".splat" else 2, path.stat().st_size)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [(".splat", {}), (".spz", {}), pytest.param(".spz", {"version": 4}, marks=needs_zstd), (".sog", {})],
)
def test_truncated_and_altered_files_are_refused_or_read_as_they_were(
    tmp_path: Path, suffix: str, options: dict[str, int]
) -> None:
    path = tmp_path / f"bad{suffix}"
    save(coded_scene(12, 1), path, **options)
    data, expected = path.read_bytes(), vars(arrays_of(read_scene(path)))
    for length in range(0, len(data), 13 if suffix == ".sog" else 3):
        path.write_bytes(data[:length])
        if suffix == ".splat" and length % 32 == 0:
            continue
        with pytest.raises(FormatError, match=rf"bad{suffix}: "):
            read_scene(path)
    if suffix == ".splat":
        return  # it has no sum that could expose changes
    start = 32 + 6 * 16 if options else 0  # the header and the table of version 4 have no sum, either
    rng, refused = np.random.default_rng(5), 0
    for position in rng.integers(start, len(data), 100):
        path.write_bytes(data[:position] + bytes([data[position] ^ (1 << rng.integers(8))]) + data[position + 1 :])
        try:
            read = vars(arrays_of(read_scene(path)))
        except FormatError:
            refused += 1
        else:
            for name, values in expected.items():
                np.testing.assert_array_equal(read[name], values)
    assert refused > 75


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 3}, "version 3 of the format"),
        ({"count": -1}, "'count'"),
        ({"count": 300}, "12 x 8|8 x 8|16 x|texels"),
        ({"count": 10**9}, "cannot be in"),
        ({"means": {"mins": [0, 0, 0], "maxs": [1e9, 0, 0], "files": ["means_l.webp", "means_u.webp"]}}, "'maxs'"),
        ({"means": {"mins": [0, 0, 0], "maxs": [1, 0, 0], "files": ["means_l.webp"]}}, "pictures of 'means'"),
        ({"quats": {"files": ["sh0.webp"]}}, "mark"),
        ({"quats": {"files": ["../quats.webp"]}}, "no ../quats.webp"),
        ({"scales": {"codebook": [0.5], "files": ["scales.webp"]}}, "level .* of scales, there are 1"),
        ({"scales": {"codebook": [1e300] * 256, "files": ["scales.webp"]}}, "'codebook'"),
        ({"shN": {"count": 2, "bands": 1, "codebook": [0] * 256, "files": SH_FILES}}, "label"),
        ({"shN": {"count": 2, "bands": 4}}, "'bands'"),
    ],
)
def test_a_wrong_description_of_sog(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = tmp_path / "x.sog"
    save(coded_scene(60, 1), path)
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | changes).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    with pytest.raises(FormatError, match=rf"x\.sog: .*({message})"):
        read_scene(path)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ((b"NGSP", 4, 2, 0, 12, 0, 0), "version 4 in a gzip stream"),
        ((b"NGSP", 5, 2, 0, 12, 0, 0), "version 5"),
        ((b"PLYY", 3, 2, 0, 12, 0, 0), "does not start"),
        ((b"NGSP", 3, 2, 5, 12, 0, 0), "SH degree 5"),
        ((b"NGSP", 3, 2, 0, 99, 0, 0), "99 fractional bits"),
        ((b"NGSP", 3, 1 << 31, 0, 12, 0, 0), "cannot be in"),
        ((b"NGSP", 3, 3, 0, 12, 0, 0), "truncated: .* of 3 splats"),
    ],
)
def test_a_wrong_header_of_spz(
    tmp_path: Path, header: tuple[bytes, int, int, int, int, int, int], message: str
) -> None:
    path = tmp_path / "x.spz"
    path.write_bytes(gzip.compress(struct.pack("<4sIIBBBB", *header) + bytes(40)))
    with pytest.raises(FormatError, match=rf"x\.spz: .*{message}"):
        read_scene(path)


@pytest.mark.parametrize(("suffix", "least"), [(".ply", math.inf), (".spz", 38.0), (".sog", 40.0), (".splat", 20.0)])
def test_pictures_of_the_file_are_those_of_the_scene(tmp_path: Path, suffix: str, least: float) -> None:
    scene = plain_scene(400)
    rng = np.random.default_rng(1)
    raw = {**scene.raw, "scales": (scene.raw["scales"] * 0.2 - 1).astype(np.float32)}
    raw["shN"] = rng.normal(0, 0.1, raw["shN"].shape).astype(np.float32)
    scene = replace(scene, raw=raw)
    cameras = cameras_around(scene.means, 2, 96, 64)
    save(scene, tmp_path / f"x{suffix}")
    found = decibels(Measure(scene.decode(), cameras).error(load(tmp_path / f"x{suffix}")))
    assert least <= found
