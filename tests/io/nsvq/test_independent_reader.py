"""The page of the format is enough to read files: its Python decodes them to the numbers of the package."""

from __future__ import annotations

import re
from pathlib import Path

import nsvq_reader
import numpy as np
import pytest
from compressed_scenes import SIZES, arrays_of, scene

from nsvq_lightning.io import CompressedScene, read_nsvq, write_nsvq
from nsvq_lightning.io.nsvq.precision import LEVELS, Precision

ROOT = Path(__file__).resolve().parents[3]


def compare(path: Path) -> None:
    """Both readers find the same bits."""
    arrays, found = arrays_of(read_nsvq(path)), nsvq_reader.read_nsvq(path)
    assert len(found) == 6
    for name, values in found.items():
        expected = getattr(arrays, name)
        assert (values.dtype, values.shape) == (expected.dtype, expected.shape), name
        assert values.tobytes() == expected.tobytes(), name


def with_far_splats() -> CompressedScene:
    made = scene(300)
    made.means[[0, 7, 30]] *= np.float32(1e5)
    return made


def test_the_reader_is_that_of_the_page() -> None:
    page = (ROOT / "docs/nsvq_format.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    code = Path(nsvq_reader.__file__).read_text(encoding="utf-8")
    assert code.partition("import numpy as np\n")[2] == "".join(f"\n\n{block}" for block in blocks)
    assert "nsvq_lightning" not in code


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("sizes", [SIZES, {}, {"shN": 8, "scales": 1}], ids=["codebooks", "none", "some"])
@pytest.mark.parametrize("level", LEVELS)
def test_both_readers_find_the_same_numbers(tmp_path: Path, level: str, sizes: dict[str, int], degree: int) -> None:
    if degree == 0:
        sizes = {name: count for name, count in sizes.items() if name != "shN"}
    write_nsvq(tmp_path / "a.nsvq", scene(120, sizes, degree), level)
    compare(tmp_path / "a.nsvq")


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("count", [0, 1, 2, 17])
def test_few_splats(tmp_path: Path, level: str, count: int) -> None:
    write_nsvq(tmp_path / "a.nsvq", scene(count), level)
    compare(tmp_path / "a.nsvq")


@pytest.mark.parametrize(
    "precision",
    [
        Precision(),
        Precision(position=3.0, opacity=0.25, codebook=1.0),
        Precision(position=1e-4, opacity=1e-4, codebook=1e-3, scales=1e-4),
    ],
    ids=["usual", "coarse", "fine"],
)
def test_far_splats_at_any_precision(tmp_path: Path, precision: Precision) -> None:
    write_nsvq(tmp_path / "a.nsvq", with_far_splats(), "compact", precision)
    assert read_nsvq(tmp_path / "a.nsvq").means.max() > 1e4
    compare(tmp_path / "a.nsvq")


@pytest.mark.parametrize("level", LEVELS)
def test_files_of_version_1(level: str) -> None:
    compare(Path(__file__).parent / "version_1" / f"{level}.nsvq")


@pytest.mark.parametrize("at", [3, 10, 25, 60, -1], ids=["magic", "checksum", "version", "header", "stream"])
def test_a_flipped_bit_is_noticed(tmp_path: Path, at: int) -> None:
    path = tmp_path / "a.nsvq"
    write_nsvq(path, scene(20))
    data = bytearray(path.read_bytes())
    data[at] ^= 16
    path.write_bytes(data)
    with pytest.raises(AssertionError):
        nsvq_reader.read_nsvq(path)
    path.write_bytes(data[:20])
    with pytest.raises(AssertionError):
        nsvq_reader.read_nsvq(path)
