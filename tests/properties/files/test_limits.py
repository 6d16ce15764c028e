"""Small files of equal numbers: refused before memory is taken for what their heads announce."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import pytest
from PIL import Image
from viewer_scenes import needs_zstd

from nsvq_lightning.io import FormatError, read_scene
from nsvq_lightning.io.errors import FEW_SPLATS, check_room
from nsvq_lightning.io.formats import describe
from nsvq_lightning.io.spz import zstd_compress


def spz3(path: Path, count: int, extensions: int = 0) -> None:
    content = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0) + bytes(20 * count + extensions)
    path.write_bytes(gzip.compress(content, 1))


def spz4(path: Path, count: int) -> None:
    sizes = [size * count for size in (9, 1, 3, 3, 4)]
    streams = [zstd_compress(bytes(size)) for size in sizes]
    table = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True))
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32)
    path.write_bytes(head + table + b"".join(streams))


def sog(path: Path, count: int, side: int, method: int = zipfile.ZIP_STORED) -> None:
    """One picture of ``side`` x ``side`` equal texels for all attributes."""
    picture, files = io.BytesIO(), {"files": ["a", "a"]}
    Image.new("RGBA", (side, side), (0, 0, 0, 255)).save(picture, "WEBP", lossless=True, method=0)
    levels = {"codebook": [0.5], **files}
    meta = {"version": 2, "count": count, "quats": files, "scales": levels, "sh0": levels}
    meta["means"] = {"mins": [0, 0, 0], "maxs": [1, 1, 1], **files}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        archive.writestr("a", picture.getvalue(), method)
        archive.writestr("more", bytes(8192))


@pytest.mark.parametrize("reads", [read_scene, describe])
@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("a.spz", lambda path: spz3(path, 2 * FEW_SPLATS)),
        pytest.param("b.spz", lambda path: spz4(path, 2 * FEW_SPLATS), marks=needs_zstd),
        ("a.sog", lambda path: sog(path, 2 * FEW_SPLATS, 1500)),
    ],
    ids=["spz 3", "spz 4", "sog"],
)
def test_a_small_file_of_many_equal_splats_is_refused(tmp_path: Path, name: str, make: object, reads: object) -> None:
    make(tmp_path / name)  # type: ignore[operator]
    assert (tmp_path / name).stat().st_size < FEW_SPLATS
    with pytest.raises(FormatError, match=rf"{name}: .*524288 .* cannot be in \d+ bytes"):
        reads(tmp_path / name)  # type: ignore[operator]


def test_pictures_larger_than_their_splats_need_are_refused(tmp_path: Path) -> None:
    sog(tmp_path / "a.sog", 5, 1500)
    with pytest.raises(FormatError, match=r"2250000 .* cannot be in \d+ bytes"):
        read_scene(tmp_path / "a.sog")


@pytest.mark.parametrize(("method", "number"), [(zipfile.ZIP_BZIP2, 12), (zipfile.ZIP_LZMA, 14)])
def test_sog_entries_that_unpack_without_a_bound_are_refused(tmp_path: Path, method: int, number: int) -> None:
    path = tmp_path / "a.sog"
    sog(path, 5, 4, method)
    data = path.read_bytes()
    for damage in (b"", b"\xff" * 9):  # which Python's LZMA reports as an error of its own kind
        at = data.index(b"PK\x03\x04", 4) + 31 + 9
        path.write_bytes(data[:at] + damage + data[at + len(damage) :])
        with pytest.raises(FormatError, match=rf"a\.sog: a is compressed by method {number} of zip"):
            read_scene(path)


def test_extensions_without_end_are_refused(tmp_path: Path) -> None:
    spz3(tmp_path / "a.spz", 3, extensions=1 << 19)
    assert len(read_scene(tmp_path / "a.spz")) == 3
    spz3(tmp_path / "a.spz", 3, extensions=1 << 21)
    with pytest.raises(FormatError, match="more than 1048576 bytes of extensions"):
        read_scene(tmp_path / "a.spz")


def test_few_equal_splats_and_two_bytes_a_splat_are_allowed(tmp_path: Path) -> None:
    spz3(tmp_path / "a.spz", FEW_SPLATS)
    assert len(read_scene(tmp_path / "a.spz")) == FEW_SPLATS
    check_room("splats", 10**9, 2 * 10**9)
