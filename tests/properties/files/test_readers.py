"""The readers of the format's page (Python) and of web pages (JavaScript, run by node) find what the package finds."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import nsvq_reader
import numpy as np
import pytest
from compressed_scenes import ON_NO_BASIS, SIZES, arrays_of, forge, framed, on_basis, scene, text_and_body

from nsvq_lightning.io import CompressedScene, FormatError, read_nsvq, write_nsvq
from nsvq_lightning.io.nsvq.entropy import encode_integers
from nsvq_lightning.io.nsvq.header import read_header, unframe
from nsvq_lightning.io.nsvq.precision import LEVELS, Precision, Storage
from nsvq_lightning.splats.attributes import ATTRIBUTES

ROOT = Path(__file__).resolve().parents[3]
READER = ROOT / "nsvq_lightning/report/web/nsvq.js"
DUMP = ROOT / "tests/support/nsvq_dump.js"

needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")


def dumped(*paths: Path) -> bytes:
    command = ["node", str(DUMP), str(READER), *map(str, paths)]
    return subprocess.run(command, check=True, capture_output=True, timeout=120).stdout


def refusal(path: Path) -> str:
    done = subprocess.run(["node", str(DUMP), str(READER), str(path)], capture_output=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stdout == b""
    return done.stderr.decode()


def compare(*paths: Path) -> None:
    """All readers find the same bits: the package, the Python of the page and the JavaScript."""
    ours = [vars(arrays_of(read_nsvq(path))) for path in paths]
    for path, arrays in zip(paths, ours, strict=True):
        for name, values in nsvq_reader.read_nsvq(path).items():
            assert (values.dtype, values.shape) == (arrays[name].dtype, arrays[name].shape), name
            assert values.tobytes() == arrays.pop(name).tobytes(), name
        assert arrays == {}
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    scenes = [read_nsvq(path) for path in paths]
    assert dumped(*paths) == b"".join(made.values(name).tobytes() for made in scenes for name in ATTRIBUTES)


def test_the_python_reader_is_that_of_the_page() -> None:
    page = (ROOT / "docs/nsvq_format.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    code = Path(nsvq_reader.__file__).read_text(encoding="utf-8")
    assert code.partition("import numpy as np\n")[2] == "".join(f"\n\n{block}" for block in blocks)
    assert "nsvq_lightning" not in code


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
        write_nsvq(paths[-1], scene(120, kept, degree), Storage(level))
    if degree:
        paths.append(tmp_path / "basis.nsvq")
        write_nsvq(paths[-1], on_basis(scene(120, {"sh0": 8}, degree)), Storage(level))
    compare(*paths)


def test_components_at_their_limits(tmp_path: Path) -> None:
    """Sums above 2^50, at the finest and the coarsest step."""
    generator, most, paths = np.random.default_rng(3), 2**23 - 1, [tmp_path / "fine.nsvq", tmp_path / "coarse.nsvq"]
    for path, step in zip(paths, (2.0**-149, 1.0), strict=True):
        made = on_basis(scene(40, {}))
        write_nsvq(path, made)
        for name, rows in (("shN.basis", made.bases["shN"]), ("shN", made.raw["shN"])):
            numbers = most - generator.integers(0, 3, rows.shape)
            numbers[1:, 1:] *= generator.choice([-1, 0, 1], numbers[1:, 1:].shape)
            _with_stream(path, name, lambda _, numbers=numbers: encode_integers(numbers))
        forge(path, lambda header, step=step: header["attributes"][5].__setitem__(4, step))
    assert np.abs(read_nsvq(paths[1]).values("shN")).max() > 2.0**50
    compare(*paths)


@pytest.mark.parametrize(("version", "made"), [(2, scene(60)), (3, on_basis(scene(60, {})))])
def test_files_of_earlier_versions_hold_what_they_held(tmp_path: Path, version: int, made: CompressedScene) -> None:
    old, new = ROOT / f"tests/io/nsvq/version_{version}.nsvq", tmp_path / "new.nsvq"
    write_nsvq(new, made)
    held, expected = (vars(arrays_of(read_nsvq(path))) for path in (old, new))
    assert (old.read_bytes()[24], new.read_bytes()[24]) == (version, 4)
    assert held.keys() == expected.keys()
    for name, values in held.items():
        np.testing.assert_array_equal(values, expected[name], strict=True)
    compare(old)


@pytest.mark.parametrize("level", LEVELS)
def test_few_splats(tmp_path: Path, level: str) -> None:
    paths = [tmp_path / f"{count}.nsvq" for count in (0, 1, 2, 17)]
    for made in (scene, lambda count: on_basis(scene(17, {})).take(np.arange(count))):
        for path in paths:
            write_nsvq(path, made(int(path.stem)), Storage(level))
        compare(*paths)


def test_far_splats_at_any_precision(tmp_path: Path) -> None:
    coarse = Precision(position=3.0, opacity=0.25, codebook=1.0)
    fine = Precision(position=1e-4, opacity=1e-4, codebook=1e-3, scales=1e-4)
    paths = [tmp_path / f"{index}.nsvq" for index in range(3)]
    for path, precision in zip(paths, (Precision(), coarse, fine), strict=True):
        write_nsvq(path, with_far_splats(), Storage(precision=precision))
    compare(*paths)


@pytest.mark.slow
def test_large_codebooks(tmp_path: Path) -> None:
    """Paths of more than 16 decisions, and codebooks that are no power of two."""
    generator = np.random.default_rng(5)
    made = scene(70_000, {"scales": 3, "quats": 69_000}, 0)
    made.means[:] = generator.normal(size=made.means.shape).astype(np.float32)
    made.codes["quats"][:] = generator.permutation(70_000) % 69_000
    made.codebooks["quats"][:] = generator.normal(size=(69_000, 4)).astype(np.float32)
    write_nsvq(tmp_path / "a.nsvq", made, Storage(precision=Precision(codebook=1e-3)))
    compare(tmp_path / "a.nsvq")


def test_not_a_number_keeps_its_bits(tmp_path: Path) -> None:
    made = scene(20)
    made.means.view(np.uint32)[0] = 0x7FC12345, 0xFF800000, 0x80000000
    write_nsvq(tmp_path / "a.nsvq", made, Storage("paper"))
    compare(tmp_path / "a.nsvq")


@needs_node
def test_flipped_bits_and_short_files_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    whole = path.read_bytes()
    damaged = {whole[:0]: "begin", whole[:5]: "begin", whole[:20]: "first 32 bytes", whole[:-1]: "checksum"}
    for at, words in ((3, "does not begin like one"), (10, "checksum"), (25, "checksum"), (60, "checksum")):
        damaged[whole[:at] + bytes([whole[at] ^ 16]) + whole[at + 1 :]] = words
    for data, words in damaged.items():
        path.write_bytes(data)
        with pytest.raises(AssertionError):
            nsvq_reader.read_nsvq(path)
        assert words in refusal(path)


@needs_node
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
        (lambda header: header.update(splats=19), "does not end with its last number"),
        (lambda header: header.update(cameras=None), "cameras are not positions and focal lengths"),
        (lambda header: header.update(cameras=[[0, 0, 0]]), "cameras are not positions"),
        (lambda header: header.update(cameras=[[0, 0, 0, -1]]), "cameras are not positions"),
        (lambda header: header.update(cameras=[[0, 0, True, 1]]), "cameras are not positions"),
        (lambda header: header.update(cameras=65 * [[0, 0, 0, 1]]), "cameras are not positions"),
    ],
)
def test_a_header_that_cannot_be_is_refused(tmp_path: Path, change: Any, words: str) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    forge(path, change)
    assert words in refusal(path)


@needs_node
@pytest.mark.parametrize("version", [1, 5])
def test_another_version_is_told(tmp_path: Path, version: int) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    forge(path, lambda _: None, version=version)
    assert f"version {version} is not 2 to 4" in refusal(path)


def _with_stream(path: Path, name: str, change: Any) -> None:
    """Replace a stream of a file."""
    streams = {key: bytes(data) for key, data in unframe(path.read_bytes())[1].items()}
    streams[name] = change(streams[name])

    def fit(header: dict[str, Any]) -> None:
        for row in header["streams"]:
            row[1] = len(streams[row[0]])

    forge(path, fit, body=b"".join(streams.values()))


def _with_text(path: Path, change: Any) -> None:
    """Replace the JSON of a file."""
    text, body = text_and_body(path)
    framed(path, change(text), body)


def _grid(number: float) -> Any:
    return lambda data: data[:24] + struct.pack("<d", number)


CHANGES: dict[str, tuple[Any, str]] = {
    "a word too many": (lambda p: _with_stream(p, "means", lambda s: s + bytes(4)), "of which"),
    "a word too many after codes": (lambda p: _with_stream(p, "sh0", lambda s: s + bytes(4)), "of which"),
    "keys beyond the grid": (lambda p: _with_stream(p, "means", lambda s: bytes(len(s))), "outside its grid"),
    "integers too large": (lambda p: _with_stream(p, "quats.codebook", lambda s: s[:4] + bytes(400)), r"2\^52"),
    "grid not a number": (lambda p: _with_stream(p, "means.grid", _grid(np.nan)), "nan doublings"),
    "grid infinite": (lambda p: _with_stream(p, "means.grid", _grid(-np.inf)), "-inf doublings"),
    "infinity": (lambda p: forge(p, lambda h: h["metrics"].update(psnr=np.inf)), "Infinity"),
    "not a number": (lambda p: forge(p, lambda h: h["config"].update(a=np.nan)), "NaN"),
    "byte-order mark": (lambda p: _with_text(p, lambda t: b"\xef\xbb\xbf" + t), "not JSON"),
    "UTF-16": (lambda p: _with_text(p, lambda t: t.decode().encode("utf-16-le")), "not JSON"),
    "no config": (lambda p: forge(p, lambda h: h.pop("config")), "config"),
    "metrics of words": (lambda p: forge(p, lambda h: h["metrics"].update(psnr="high")), "metrics"),
    "a camera of 3 numbers": (lambda p: forge(p, lambda h: h.update(cameras=[[0, 0, 0]])), "cameras"),
    "a camera without a lens": (lambda p: forge(p, lambda h: h.update(cameras=[[0, 0, 0, 0]])), "cameras"),
    "no list of cameras": (lambda p: forge(p, lambda h: h.update(cameras=None)), "cameras"),
    "many cameras": (lambda p: forge(p, lambda h: h.update(cameras=65 * [[0, 0, 0, 1]])), "cameras"),
    "many splats": (lambda p: forge(p, lambda h: h.update(splats=2**18 + 1)), "262145 splats cannot be in"),
    "many rows": (
        lambda p: forge(p, lambda h: h["attributes"][3].__setitem__(3, 2**16 + 1)),
        "65537 rows of quats.codebook cannot be in",
    ),
}


def _too_large(path: Path, name: str) -> None:
    rows = read_header(path).attributes[5].codes
    numbers = np.full((rows, 45) if name == "shN.basis" else (60, rows), -(1 << 23))
    _with_stream(path, name, lambda _: encode_integers(numbers))


ON_BASIS: dict[str, tuple[Any, str]] = {
    **{name: (lambda p, change=change: forge(p, change), "damaged") for name, change in ON_NO_BASIS.items()},
    "coefficients too large": (lambda p: _too_large(p, "shN"), r"2\^23"),
    "basis too large": (lambda p: _too_large(p, "shN.basis"), r"2\^23"),
}


@needs_node
def test_all_readers_refuse_the_same_files(tmp_path: Path) -> None:
    """The package, the Python of the page and the JavaScript: what the page refuses, and noise in the streams."""
    based = on_basis(scene(60, {}))
    cases = [*((scene(60), *case) for case in CHANGES.values()), *((based, *case) for case in ON_BASIS.values())]
    paths = [tmp_path / f"{index:02}.nsvq" for index in range(len(cases) + 30)]
    for path, (made, change, words) in zip(paths, cases, strict=False):
        write_nsvq(path, made)
        change(path)
        with pytest.raises(FormatError, match=words):
            read_nsvq(path)
    for seed, path in enumerate(paths[len(cases) :]):
        made = (scene(60, {}), scene(60), based)[seed % 3]
        write_nsvq(path, made, Storage(LEVELS[seed % 2]))
        generator = np.random.default_rng(seed)
        name = str(generator.choice([name for name, stream in unframe(path.read_bytes())[1].items() if len(stream)]))

        def noise(stream: bytes, generator: np.random.Generator = generator) -> bytes:
            at = int(generator.integers(len(stream)))
            return stream[:at] + generator.bytes(1) + stream[at + 1 :]

        _with_stream(path, name, noise)
    command = ["node", str(DUMP), str(READER), *map(str, paths)]
    lines = subprocess.run(command, capture_output=True, timeout=60, check=False).stderr.decode().splitlines()
    refused = []
    for path in paths:
        try:
            read_nsvq(path)
        except FormatError:
            refused.append(path)
        try:
            nsvq_reader.read_nsvq(path)
        except Exception:
            assert path in refused, f"the page refuses {path}"
        else:
            assert path not in refused, f"the page reads {path}"
    assert len(lines) == len(refused) > len(cases)
