from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compressed_scenes import forge, framed, scene, text_and_body
from numpy.typing import NDArray

from nsvq_lightning import io
from nsvq_lightning.io import CompressedScene, FormatError, read_header, read_nsvq
from nsvq_lightning.io.nsvq.file import pack_fields, unpack_fields
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.splats.attributes import QUANTIZABLE, attribute_dims

write_nsvq = partial(io.write_nsvq, storage=Storage("paper"))

SIZES_16K = {"quats": 16384, "scales": 16384, "sh0": 4096, "shN": 4096}


def assert_same(a: CompressedScene, b: CompressedScene) -> None:
    for name in ("means", "opacities"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)
    for table in ("codes", "codebooks", "raw"):
        assert getattr(a, table).keys() == getattr(b, table).keys()
        for name, values in getattr(a, table).items():
            np.testing.assert_array_equal(values, getattr(b, table)[name])
    assert (a.sh_degree, a.origin, a.config, a.metrics) == (b.sh_degree, b.origin, b.config, b.metrics)


@pytest.mark.parametrize("sizes", [SIZES_16K, {"quats": 512, "scales": 512, "sh0": 128, "shN": 128}, {"shN": 1000}])
def test_file_bytes_are_the_formula_of_the_paper(tmp_path: Path, sizes: dict[str, int]) -> None:
    """Attributes without a codebook add their floats."""
    n, path, dims = 1234, tmp_path / "x.nsvq", attribute_dims(3)
    written = write_nsvq(path, scene(n, sizes))
    bits = sum(int(np.ceil(np.log2(k))) for k in sizes.values())
    codebooks = sum(4 * k * dims[name] for name, k in sizes.items())
    floats = sum(4 * n * dims[name] for name in QUANTIZABLE if name not in sizes)
    header = 32 + len(text_and_body(path)[0])
    assert written == path.stat().st_size == 16 * n + -(-n * bits // 8) + codebooks + floats + header
    assert read_header(path).size == header < 2000


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("sizes", [{}, {"quats": 1}, {"quats": 1, "sh0": 2}, {"scales": 70_000, "sh0": 3}])
def test_round_trip_is_exact(tmp_path: Path, sizes: dict[str, int], degree: int) -> None:
    path = tmp_path / "x.nsvq"
    for n in (0, 1, 257):
        original = scene(
            n,
            sizes,
            degree,
            config={"seed": 3, "name": "Zürich", "nested": {"a": [1, 2.5, None, True]}},
            metrics={"psnr": 27.25},
            origin=(0.1, -4_834_001.123456789, 2.0**-60),
        )
        assert write_nsvq(path, original) == path.stat().st_size
        back = read_nsvq(path)
        assert_same(back, original)
        assert back.stored_bytes == path.stat().st_size


def test_same_scene_same_bytes(tmp_path: Path) -> None:
    first = scene(30, {"quats": 8, "sh0": 6}, config={"b": 1, "a": {"d": 2, "c": 3}})
    other = CompressedScene(
        first.means.copy(),
        np.asfortranarray(first.opacities),
        {name: first.codes[name].astype(np.uint16) for name in reversed([*first.codes])},
        {name: first.codebooks[name] for name in reversed([*first.codebooks])},
        {name: np.asfortranarray(first.raw[name]) for name in reversed([*first.raw])},
        config={"a": {"c": 3, "d": 2}, "b": 1},
    )
    write_nsvq(tmp_path / "a.nsvq", first)
    write_nsvq(tmp_path / "b.nsvq", other)
    assert (tmp_path / "a.nsvq").read_bytes() == (tmp_path / "b.nsvq").read_bytes()


def test_every_truncation_and_every_changed_byte_is_one_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "hurt.nsvq"
    write_nsvq(path, scene(3, {"quats": 3, "scales": 2, "sh0": 2}, degree=0))
    data = path.read_bytes()
    for position in range(len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x10
        for content in (data[:position], bytes(damaged)):
            path.write_bytes(content)
            with pytest.raises(FormatError, match=r"hurt\.nsvq: (not a \.nsvq|truncated)"):
                read_nsvq(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(FormatError, match="altered"):
        read_nsvq(path)


def test_forged_headers_are_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, scene(3, {"quats": 3, "sh0": 2}, config={"a": 1}, metrics={"psnr": 1.0}))
    good = path.read_bytes()
    header = json.loads(text_and_body(path)[0])
    wrong: list[Any] = [None, -1, 10**15, 10**400, 1.5, "x", True, [], {}, [[]], 0]
    places = [*([key] for key in header if key not in ("config", "metrics"))]
    places += [["attributes", i, key] for i in range(6) for key in range(5)]
    places += [["streams", i, key] for i in range(7) for key in range(3)]
    for place in places:
        for value in wrong:

            def change(table: Any, place: list[Any] = place, value: Any = value) -> None:
                for key in place[:-1]:
                    table = table[key]
                if table[place[-1]] == value and not isinstance(value, bool):
                    value = 77
                table[place[-1]] = value

            path.write_bytes(good)
            forge(path, change)
            with pytest.raises(FormatError, match=r"x\.nsvq: "):
                read_nsvq(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(level="compact+"), "level 'compact\\+'"),
        (lambda h: h["streams"].append(copy.deepcopy(h["streams"][-1])), "same name"),
        (lambda h: h["streams"].reverse(), "stream table"),
        (lambda h: h["attributes"].reverse(), "attribute table"),
        (lambda h: h["attributes"][2].__setitem__(4, 0.5), "impossible attribute"),
        (lambda h: h["attributes"][0].__setitem__(slice(2, 4), ["codes", 3]), "impossible attribute"),
        (lambda h: h["attributes"][0].append(1), "does not hold name, dim, storage, codes, step"),
        (lambda h: h.update(config=[]), "config"),
        (lambda h: h.update(metrics={"psnr": "good"}), "numbers only"),
        (lambda h: h.update(origin=[0, 0]), "origin"),
        (lambda h: h.update(origin=[0, 0, 10**400]), "origin"),
        (lambda h: h.update(splats=4), "stream table"),
        (lambda h: h.update(cameras={}), "'cameras' must be of type list"),
        (lambda h: h.update(cameras=[[0, 0, 0]]), "at most 64 positions and focal lengths"),
        (lambda h: h.update(cameras=[[0, 0, 0, 0]]), "at most 64 positions"),
        (lambda h: h.update(cameras=[[0, 0, 10**400, 1]]), "at most 64 positions"),
        (lambda h: h.update(cameras=[[0, 0, True, 1]]), "at most 64 positions"),
        (lambda h: h.update(cameras=65 * [[0, 0, 0, 1]]), "at most 64 positions"),
    ],
)
def test_forged_tables(tmp_path: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, scene(3, {"quats": 3, "sh0": 2}))
    forge(path, change)
    with pytest.raises(FormatError, match=message):
        read_nsvq(path)


def test_bytes_outside_the_stream_table_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, scene(3, {"quats": 3}))
    forge(path, lambda header: None, body=text_and_body(path)[1] + b"hidden")
    with pytest.raises(FormatError, match="the file holds"):
        read_nsvq(path)


def test_a_code_beyond_its_codebook_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, scene(4, {"quats": 3}))
    header = read_header(path)
    names = [stream.name for stream in header.streams]
    data = bytearray(path.read_bytes())
    data[header.size + sum(stream.length for stream in header.streams[: names.index("codes")])] = 0xFF
    framed(path, data[32 : header.size], data[header.size :])
    with pytest.raises(FormatError, match=r"codes\['quats'\] must be in 0\.\.2, got \d\.\.3"):
        read_nsvq(path)


def test_a_pointer_of_git_lfs_says_so(tmp_path: Path) -> None:
    (tmp_path / "x.nsvq").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(FormatError, match=r"not the \.nsvq file itself; get it by 'git lfs pull'"):
        read_nsvq(tmp_path / "x.nsvq")


def test_a_newer_version_says_so(tmp_path: Path) -> None:
    path = tmp_path / "x.nsvq"
    write_nsvq(path, scene(4, {}))
    forge(path, lambda header: None, version=5)
    with pytest.raises(FormatError, match="version 5 of the format, which this release cannot read; update"):
        read_nsvq(path)


def test_wrong_scenes_are_refused_at_construction() -> None:
    good = vars(scene(5, {"quats": 4, "sh0": 2}))

    def broken(**change: Any) -> CompressedScene:
        return CompressedScene(**{**good, **change})

    codes, codebooks, raw = good["codes"], good["codebooks"], good["raw"]
    with pytest.raises(ValueError, match=r"means must have shape \[5, 3\]|opacities must have shape \[4\]"):
        broken(means=good["means"][:4])
    with pytest.raises(TypeError, match="float64"):
        broken(means=good["means"].astype(np.float64))
    with pytest.raises(ValueError, match=r"must be in 0\.\.3"):
        broken(codes={**codes, "quats": codes["quats"] + 4})
    with pytest.raises(TypeError, match="integers"):
        broken(codes={**codes, "quats": codes["quats"].astype(np.float32)})
    with pytest.raises(ValueError, match="but codebooks of"):
        broken(codebooks={"quats": codebooks["quats"]})
    with pytest.raises(ValueError, match="either in codes"):
        broken(raw={**raw, "quats": np.zeros((5, 4), np.float32)})
    with pytest.raises(ValueError, match="either in codes"):
        broken(raw={"scales": raw["scales"]})
    with pytest.raises(ValueError, match="origin"):
        broken(origin=(0.0, np.nan, 0.0))
    for count in (0, 46):
        wide, basis = np.zeros((5, count), np.float32), np.zeros((count, 45), np.float32)
        with pytest.raises(ValueError, match=r"bases\['shN'\] must have shape \[(1|45), 45\]"):
            broken(raw={**raw, "shN": wide}, bases={"shN": basis})
    with pytest.raises(ValueError, match="only shN may have a basis"):
        broken(bases={"scales": np.eye(3, dtype=np.float32)})
    with pytest.raises(ValueError, match="SH degree must be"):
        broken(sh_degree=4)
    with pytest.raises(ValueError, match="no coefficients at SH degree 0"):
        scene(5, {"shN": 2}, degree=0)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("unit", [1e-3, 1.0, 5e4])
def test_cameras_are_kept_with_the_digits_that_count(tmp_path: Path, unit: float, level: str) -> None:
    path = tmp_path / "x.nsvq"
    cameras = np.random.default_rng(0).normal(size=(64, 4)) * [unit, unit, unit, 0] + [0, unit, 0, 1234.5678]
    bare = io.write_nsvq(path, scene(30), Storage(level))
    assert "cameras" not in json.loads(read_header(path).to_json())
    assert len(read_nsvq(path).cameras) == 0
    added = io.write_nsvq(path, replace(scene(30), cameras=cameras), Storage(level)) - bare
    back = read_nsvq(path)
    np.testing.assert_allclose(back.cameras[:, :3], cameras[:, :3], rtol=0, atol=0.01 * unit)
    assert set(back.cameras[:, 3]) == {1235.0}
    assert added < 64 * 35
    io.write_nsvq(path, replace(scene(30), cameras=1e-4 * cameras[:1] / unit), Storage(level))
    np.testing.assert_allclose(read_nsvq(path).cameras[:, :3], 1e-4 * cameras[:1, :3] / unit, rtol=0, atol=1e-8)
    io.write_nsvq(tmp_path / "y.nsvq", back, Storage(level))
    np.testing.assert_array_equal(read_nsvq(tmp_path / "y.nsvq").cameras, back.cameras)


def test_settings_must_be_json_and_metrics_may_be_infinite(tmp_path: Path) -> None:
    path = tmp_path / "x.nsvq"
    with pytest.raises(ValueError, match="plain JSON values"):
        write_nsvq(path, scene(2, {}, config={"callback": object()}))
    with pytest.raises(ValueError, match="plain JSON values"):
        write_nsvq(path, scene(2, {}, config={"clip": float("nan")}))
    assert not path.exists()
    write_nsvq(path, scene(2, {}, metrics={"psnr": float("inf"), "ssim": 1.0}))
    assert read_nsvq(path).metrics == {"psnr": None, "ssim": 1.0}
    with pytest.raises(ValueError, match="unknown compression level 'tiny'; there are compact, paper"):
        Storage("tiny")


def _big_integer(fields: Sequence[NDArray[np.int64]], widths: Sequence[int]) -> bytes:
    """Oracle: the whole stream as one integer of Python."""
    stream = position = 0
    for row in zip(*fields, strict=True):
        for value, width in zip(row, widths, strict=True):
            stream |= int(value) << position
            position += width
    return stream.to_bytes(-(-position // 8), "little")


def _random_fields(rows: int, widths: Sequence[int]) -> list[NDArray[np.int64]]:
    rng = np.random.default_rng([rows, *widths])
    return [rng.integers(0, 1 << width, rows) for width in widths]


@pytest.mark.parametrize(
    ("rows", "widths"),
    [
        (0, [14, 12]),
        (1, [1]),
        (5, [0, 3, 0]),
        (7, [14, 14, 12, 12]),
        (13, [1, 32, 5]),
        (9, [16, 17, 31, 32, 24]),
        (3, [0]),
        ((1 << 14) + 3, [9]),
    ],
)
def test_stream_is_the_big_integer_and_comes_back(rows: int, widths: list[int]) -> None:
    fields = _random_fields(rows, widths)
    packed = pack_fields(fields, widths)
    assert packed == _big_integer(fields, widths)
    assert len(packed) == -(-rows * sum(widths) // 8)
    for field, back in zip(fields, unpack_fields(packed, rows, widths), strict=True):
        np.testing.assert_array_equal(back, field)


def test_known_bytes() -> None:
    # 3 bits and 5 bits a row: 5 | 17 << 3 = 0x8D, 2 | 30 << 3 = 0xF2.
    assert pack_fields([np.array([5, 2]), np.array([17, 30])], [3, 5]) == bytes([0x8D, 0xF2])
