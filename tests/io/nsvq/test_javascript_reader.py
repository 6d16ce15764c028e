"""The reader for web pages decodes files to the numbers of the package; run by node."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compressed_scenes import SIZES, scene

from nsvq_lightning.io import CompressedScene, read_nsvq, write_nsvq
from nsvq_lightning.io.nsvq.precision import LEVELS, Precision
from nsvq_lightning.splats.arrays import SplatArrays

ROOT = Path(__file__).resolve().parents[3]
READER = ROOT / "nsvq_lightning/report/web/nsvq.js"
DUMP = ROOT / "tests/support/nsvq_dump.js"
ORDER = ("means", "quats", "scales", "opacities", "sh0", "shN")

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")


def dumped(*paths: Path) -> bytes:
    command = ["node", str(DUMP), str(READER), *map(str, paths)]
    return subprocess.run(command, check=True, capture_output=True, timeout=120).stdout


def refusal(path: Path) -> str:
    done = subprocess.run(["node", str(DUMP), str(READER), str(path)], capture_output=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stdout == b""
    return done.stderr.decode()


def content(arrays: SplatArrays) -> bytes:
    return b"".join(getattr(arrays, name).tobytes() for name in ORDER)


def compare(*paths: Path) -> None:
    assert dumped(*paths) == b"".join(content(read_nsvq(path).arrays()) for path in paths)


def with_far_splats() -> CompressedScene:
    made = scene(300)
    made.means[[0, 7, 30]] *= np.float32(1e5)
    return made


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("level", LEVELS)
def test_numbers_are_those_of_the_package(tmp_path: Path, level: str, degree: int) -> None:
    paths = []
    for sizes in (SIZES, {}, {"shN": 8, "scales": 1}):
        kept = {name: count for name, count in sizes.items() if degree or name != "shN"}
        paths.append(tmp_path / f"{len(paths)}.nsvq")
        write_nsvq(paths[-1], scene(120, kept, degree), level)
    compare(*paths)


@pytest.mark.parametrize("level", LEVELS)
def test_few_splats(tmp_path: Path, level: str) -> None:
    paths = [tmp_path / f"{count}.nsvq" for count in (0, 1, 2, 17)]
    for path in paths:
        write_nsvq(path, scene(int(path.stem)), level)
    compare(*paths)


def test_far_splats_at_any_precision(tmp_path: Path) -> None:
    coarse = Precision(position=3.0, opacity=0.25, codebook=1.0)
    fine = Precision(position=1e-4, opacity=1e-4, codebook=1e-3, scales=1e-4)
    paths = [tmp_path / f"{index}.nsvq" for index in range(3)]
    for path, precision in zip(paths, (Precision(), coarse, fine), strict=True):
        write_nsvq(path, with_far_splats(), "compact", precision)
    compare(*paths)


def test_large_codebooks(tmp_path: Path) -> None:
    """Paths of more than 16 decisions, and codebooks that are no power of two."""
    generator = np.random.default_rng(5)
    made = scene(70_000, {"scales": 3, "quats": 69_000}, 0)
    made.means[:] = generator.normal(size=made.means.shape).astype(np.float32)
    made.codes["quats"][:] = generator.permutation(70_000) % 69_000
    made.codebooks["quats"][:] = generator.normal(size=(69_000, 4)).astype(np.float32)
    write_nsvq(tmp_path / "a.nsvq", made, "compact", Precision(codebook=1e-3))
    compare(tmp_path / "a.nsvq")


@pytest.mark.parametrize("level", LEVELS)
def test_files_of_version_1(level: str) -> None:
    compare(Path(__file__).parent / "version_1" / f"{level}.nsvq")


def test_not_a_number_keeps_its_bits(tmp_path: Path) -> None:
    made = scene(20)
    made.means.view(np.uint32)[0] = 0x7FC12345, 0xFF800000, 0x80000000
    write_nsvq(tmp_path / "a.nsvq", made, "paper")
    compare(tmp_path / "a.nsvq")


@pytest.mark.parametrize(
    ("at", "words"),
    [(3, "does not begin like one"), (10, "checksum"), (25, "checksum"), (60, "checksum"), (-1, "checksum")],
)
def test_a_flipped_bit_is_noticed(tmp_path: Path, at: int, words: str) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    data = bytearray(path.read_bytes())
    data[at] ^= 16
    path.write_bytes(data)
    assert words in refusal(path)


def test_a_short_file_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    whole = path.read_bytes()
    for length, words in ((0, "begin"), (5, "begin"), (20, "first 32 bytes"), (len(whole) - 1, "checksum")):
        path.write_bytes(whole[:length])
        assert words in refusal(path)


def _changed(path: Path, change: Any, version: int = 2, body: bytes | None = None) -> None:
    """Write a file with another header and a checksum that fits it."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 28)
    header = json.loads(data[32 : 32 + length])
    change(header)
    text = json.dumps(header).encode()
    rest = struct.pack("<II", version, len(text)) + text + (data[32 + length :] if body is None else body)
    path.write_bytes(data[:8] + hashlib.blake2b(rest, digest_size=16).digest() + rest)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda header: header.update(level="other"), "level other is unknown"),
        (lambda header: header.update(splats=-1), "number of splats"),
        (lambda header: header.update(splats=10**12), "too many splats"),
        (lambda header: header.update(sh_degree=4), "SH degree"),
        (lambda header: header.update(origin=[0, 0]), "origin"),
        (lambda header: header["attributes"].pop(), "attributes are not those"),
        (lambda header: header["attributes"][0].pop(), "wrong length"),
        (lambda header: header["attributes"][3].__setitem__(1, 5), "entry of quats"),
        (lambda header: header["attributes"][3].__setitem__(3, 10**8), "codebook of quats is too large"),
        (lambda header: header["attributes"][3].__setitem__(4, 0), "step of quats"),
        (lambda header: header["streams"].reverse(), "streams are not those"),
        (lambda header: header["streams"][0].__setitem__(1, 10**9), "longer than the file"),
        (lambda header: header["streams"][-1].__setitem__(1, 0), "bytes follow"),
        (lambda header: header.update(splats=21), "does not end with its last number"),
    ],
)
def test_a_header_that_cannot_be_is_refused(tmp_path: Path, change: Any, words: str) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    _changed(path, change)
    assert words in refusal(path)


def test_a_newer_version_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    _changed(path, lambda _: None, version=3)
    assert "version 3 is newer than this reader" in refusal(path)


def test_noise_in_the_streams_ends_with_an_error_or_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.nsvq"
    for seed in range(12):
        write_nsvq(path, scene(60), LEVELS[seed % 2])
        data = path.read_bytes()
        (length,) = struct.unpack_from("<I", data, 28)
        body = np.frombuffer(data[32 + length :], np.uint8).copy()
        generator = np.random.default_rng(seed)
        body[generator.integers(len(body), size=20)] = generator.integers(256, size=20)
        _changed(path, lambda _: None, body=body.tobytes())
        done = subprocess.run(["node", str(DUMP), str(READER), str(path)], capture_output=True, timeout=60, check=False)
        assert done.returncode == 0 or b"not a valid .nsvq file" in done.stderr
