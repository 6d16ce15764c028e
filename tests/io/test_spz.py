"""Version 4 of ``.spz``: a file of splat-transform, and what damage leads to."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from compressed_scenes import arrays_of
from viewer_scenes import assert_same, coded_scene, needs_zstd, plain_scene, sigmoid

from nsvq_lightning.io import FormatError, read_scene, save
from nsvq_lightning.io.spz import zstd_compress, zstd_decompress

HEAD = struct.Struct("<4sIIBBBBI12x")
ENTRY = struct.Struct("<QQ")
THEIRS = Path(__file__).with_name("splat_transform_v4.spz")


@needs_zstd
def test_extensions_that_say_nothing_of_the_axes_are_passed_over(tmp_path: Path) -> None:
    def extended(kind: int, content: bytes) -> Path:
        magic, version, count, degree, bits, flags, streams, _ = HEAD.unpack_from(data)
        record = struct.pack("<II", kind, len(content)) + content
        head = HEAD.pack(magic, version, count, degree, bits, flags | 2, streams, HEAD.size + len(record))
        (tmp_path / "x.spz").write_bytes(head + record + data[HEAD.size :])
        return tmp_path / "x.spz"

    data = THEIRS.read_bytes()
    for kind, content in ((0xADBE0002, bytes(12)), (0xADBE0003, bytes(4)), (0xADBE0003, bytes(3)), (7, b"")):
        assert_same(arrays_of(read_scene(extended(kind, content))), arrays_of(read_scene(THEIRS)))
    with pytest.raises(FormatError, match=r"x\.spz: .*newer than this release: coordinate system 17, not 0 to 16"):
        read_scene(extended(0xADBE0003, struct.pack("<I", 17)))


@pytest.mark.parametrize(
    ("offset", "number", "message"),
    [
        (4, struct.pack("<I", 5), "version 5 of the format"),
        (4, struct.pack("<I", 3), "version 3 .* without gzip"),
        (8, struct.pack("<I", 1 << 31), "2147483648 splats cannot be in"),
        (12, bytes([5]), "SH degree 5"),
        (13, bytes([31]), "31 fractional bits"),
        (15, bytes([5]), "5 streams where there must be 6"),
        (16, struct.pack("<I", 16), "a table of 6 streams at 16"),
        (16, struct.pack("<I", 1 << 31), "a table of 6 streams at 2147483648"),
        (32, ENTRY.pack(1 << 62, 108), "truncated or damaged: streams of"),
        (32, ENTRY.pack(10, 1 << 62), "means of 12 splats cannot be 4611686018427387904 bytes"),
    ],
)
def test_a_wrong_header_or_table(tmp_path: Path, offset: int, number: bytes, message: str) -> None:
    path, data = tmp_path / "x.spz", THEIRS.read_bytes()
    path.write_bytes(data[:offset] + number + data[offset + len(number) :])
    with pytest.raises(FormatError, match=rf"x\.spz: .*{message}"):
        read_scene(path)


@needs_zstd
@pytest.mark.parametrize(("count", "degree", "streams"), [(5, 0, 5), (5, 1, 6)])
def test_there_is_a_stream_for_each_array_that_is_not_empty(
    tmp_path: Path, count: int, degree: int, streams: int
) -> None:
    path = tmp_path / "x.spz"
    save(plain_scene(count, degree), path, version=4)
    assert HEAD.unpack_from(path.read_bytes()) == (b"NGSP", 4, count, degree, 12, 2, streams, 32 + 12)
    assert len(read_scene(path)) == count


@needs_zstd
def test_both_versions_hold_the_same_splats_and_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    files = []
    for version in (3, 4, 4):
        save(coded_scene(80), tmp_path / "x.spz", version=version)
        files.append((vars(arrays_of(read_scene(tmp_path / "x.spz"))), (tmp_path / "x.spz").read_bytes()))
    for name, values in files[0][0].items():
        np.testing.assert_array_equal(files[1][0][name], values, err_msg=name)
    assert files[1][1] == files[2][1]


def test_only_known_versions_are_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"version of \.spz must be 3 or 4, got 2"):
        save(plain_scene(3), tmp_path / "x.spz", version=2)


DATA = b"many equal bytes " * 100


@needs_zstd
def test_zstandard_refuses_damage_wherever_it_is_and_another_size() -> None:
    frame = zstd_compress(DATA)
    assert len(frame) < len(DATA) / 10
    assert zstd_decompress(frame, len(DATA)) == DATA
    assert zstd_decompress(zstd_compress(b""), 0) == b""
    for size in (0, len(DATA) - 1, len(DATA) + 1):
        with pytest.raises(FormatError, match=f"does not hold the {size} bytes"):
            zstd_decompress(frame, size)
    altered = [frame[:i] + bytes([frame[i] ^ 1]) + frame[i + 1 :] for i in range(len(frame))]
    for damaged in (*(frame[:i] for i in range(len(frame))), *altered, frame + b"more"):
        with pytest.raises(FormatError, match="damaged"):
            zstd_decompress(damaged, len(DATA))


def test_without_zstandard_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> ModuleType:
        raise ImportError(name)

    monkeypatch.setattr("nsvq_lightning.io.spz.import_module", missing)
    with pytest.raises(FormatError, match=r"needs Zstandard.* pip install 'nsvq-lightning\[spz\]'"):
        zstd_compress(DATA)


@pytest.mark.parametrize("degree", [3, 4])
def test_of_degree_4_the_first_three_are_read(tmp_path: Path, degree: int, caplog: pytest.LogCaptureFixture) -> None:
    """Oracle: 128 + 128 x, coefficient by coefficient."""
    coefficients = (degree + 1) ** 2 - 1
    levels = np.random.default_rng(1).integers(0, 256, (5, coefficients, 3), np.uint8)
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 5, degree, 12, 0, 0)
    (tmp_path / "x.spz").write_bytes(gzip.compress(head + bytes(5 * 20) + levels.tobytes()))
    read = read_scene(tmp_path / "x.spz")
    np.testing.assert_allclose(read.values("shN"), (levels[:, :15] - 128.0) / 128)
    assert ("of SH degree 4, degrees up to 3 are read" in caplog.text) == (degree == 4)


def test_a_scene_too_far_away_for_its_steps_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = plain_scene(50)
    save(scene, tmp_path / "a.spz")
    assert not caplog.records
    scene = replace(scene, raw={**scene.raw, "scales": scene.rows("scales") - 2})
    save(replace(scene, means=scene.means + np.float32(1e5)), tmp_path / "a.spz")
    assert "positions are rounded by half a splat" in caplog.text


def test_flags_that_are_not_known_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 5, 0, 12, 0x40, 0)
    (tmp_path / "x.spz").write_bytes(gzip.compress(head + bytes(5 * 20)))
    assert len(read_scene(tmp_path / "x.spz")) == 5
    assert "unknown flags 0x40" in caplog.text


def test_of_levels_of_detail_the_finest_is_read(tmp_path: Path) -> None:
    """Spark's flag 0x80: numbers of children and first children behind the arrays, opacities in halves of 255ths."""
    save(plain_scene(9, 1), tmp_path / "a.spz", axes="rub")
    plain = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    opacities = slice(16 + 9 * 9, 16 + 9 * 10)
    plain[opacities.stop - 1] = 255  # which becomes 128: 1 lies between 127 and 128
    (tmp_path / "a.spz").write_bytes(gzip.compress(plain))
    start = 16 + 9 * (20 + 9)  # of the extension
    tree = np.array([2, 2, 5] + [0] * 6, "<u2").tobytes() + np.array([1, 3, 4] + [0] * 6, "<u4").tobytes()
    changed = bytearray(plain[:start] + tree + plain[start:])
    changed[14] |= 0x80
    changed[opacities] = [(level + 1) // 2 for level in changed[opacities]]
    (tmp_path / "b.spz").write_bytes(gzip.compress(changed))
    whole, finest = read_scene(tmp_path / "a.spz"), read_scene(tmp_path / "b.spz")
    np.testing.assert_array_equal(finest.means, whole.means[3:])
    np.testing.assert_array_equal(finest.values("shN"), whole.values("shN")[3:])
    np.testing.assert_allclose(sigmoid(finest.opacities), sigmoid(whole.opacities[3:]), atol=1.01 / 255)
    assert finest.opacities[-1] == whole.opacities[-1]

    (tmp_path / "b.spz").write_bytes(gzip.compress(changed[: start + 50]))
    with pytest.raises(FormatError, match="truncated: tree of 9 splats has 50 of 54 bytes"):
        read_scene(tmp_path / "b.spz")
