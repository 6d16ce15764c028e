"""What the digest of a kernel covers, which changes compile a stored kernel again, and where kernels are kept."""

from __future__ import annotations

import importlib
import shutil
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from nsvq_lightning.compute import simd
from nsvq_lightning.compute.kernel_cache import VERSIONS, digest, kernel_folder


def test_meaning_of_operators_counts_for_all_that_names_their_module(monkeypatch: pytest.MonkeyPatch) -> None:
    def kernel(a: Any, b: Any) -> Any:
        return simd.load(a, 0) * simd.load(b, 0)

    before = digest(kernel)
    assert digest(kernel) == before
    monkeypatch.setattr("nsvq_lightning.compute.kernel_cache._source", lambda module: f"another {module}")
    assert digest(kernel) != before


def test_what_cannot_be_followed_is_refused() -> None:
    with pytest.raises(TypeError, match="cannot be detected"):
        digest(object())


CONSTANTS = "SCALE = 2.0  # of the sum\n"
HELPERS = '''
import stamped_constants
from nsvq_lightning.compute.jit import inline


@inline
def scaled(x, shift=1.0):
    """Scaled."""
    return stamped_constants.SCALE * x + shift
'''
KERNELS = '''
from stamped_helpers import scaled
from nsvq_lightning.compute.jit import kernel


def total(table):
    """The sum of a table."""
    found = 0.0
    for i in range(table.shape[0]):
        found += scaled(table[i])
    return found


total = kernel(total, parallel=False)


def made(power):
    def powers(x):
        return scaled(x) ** power

    return kernel(powers, parallel=False)
'''


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Write the three modules, with one change, and import the kernels anew."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "caches"))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # it would not see a change within a second

    def write(old: str = "", new: str = "") -> Any:
        for name, source in {"constants": CONSTANTS, "helpers": HELPERS, "kernels": KERNELS}.items():
            (tmp_path / f"stamped_{name}.py").write_text(source.replace(old, new) if old else source)
            sys.modules.pop(f"stamped_{name}", None)
        assert not old or old in CONSTANTS + HELPERS + KERNELS
        importlib.invalidate_caches()
        return importlib.import_module("stamped_kernels")

    yield write
    for name in [name for name in sys.modules if name.startswith("stamped_")]:
        del sys.modules[name]


def is_kept(kernel: Any) -> bool:
    """Whether the kernel, called once, came from the disk."""
    hits, misses = (sum(counts.values()) for counts in (kernel.stats.cache_hits, kernel.stats.cache_misses))
    assert hits + misses == 1
    return bool(hits)


@pytest.mark.parametrize(
    ("old", "new", "result"),
    [
        ("SCALE = 2.0", "SCALE = 3.0", 14.0),
        ("shift=1.0", "shift=2.0", 12.0),
        ("* x +", "* x -", 6.0),
        ("found = 0.0", "found = 1.0", 11.0),
    ],
    ids=["constant two modules away", "default of a helper", "code of a helper", "own constant"],
)
def test_a_change_of_what_a_kernel_is_made_of_compiles_it_again(write: Any, old: str, new: str, result: float) -> None:
    table = np.array([1.0, 3.0])
    assert write().total(table) == 10.0
    changed = write(old, new).total
    assert changed(table) == result
    assert not is_kept(changed)
    again = write(old, new).total
    assert again(table) == result
    assert is_kept(again)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# of the sum", "# of the sum of all"),
        ("SCALE = 2.0", "# Moves what follows.\n\nSCALE = 2.0\nOTHER = 1"),
        ('"""Scaled."""', '"""Scaled and shifted."""'),
        ("\nfrom stamped_helpers", "# One more line.\n\nfrom stamped_helpers"),
        ("The sum of a table.", "The sum of what a table holds."),
    ],
    ids=["comment", "other lines", "docstring of a helper", "place of the kernel", "docstring of the kernel"],
)
def test_a_change_of_words_keeps_it(write: Any, old: str, new: str) -> None:
    table = np.ones(4)
    assert write().total(table) == 12.0
    changed = write(old, new).total
    assert changed(table) == 12.0
    assert is_kept(changed)


def test_kernels_that_a_function_makes_are_kept_side_by_side(write: Any) -> None:
    first = write()
    assert [first.made(power)(1.0) for power in (1, 2)] == [3.0, 9.0]
    second = write("# of the sum", "# of it")
    kernels = [second.made(power) for power in (1, 2, 3)]
    assert [kernel(1.0) for kernel in kernels] == [3.0, 9.0, 27.0]
    assert [is_kept(kernel) for kernel in kernels] == [True, True, False]


def test_another_environment_finds_them(write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert write().total(np.ones(3)) == 9.0
    other = tmp_path / "other"
    other.mkdir()
    for module in tmp_path.glob("stamped_*.py"):
        shutil.move(module, other)
        del sys.modules[module.stem]
    monkeypatch.syspath_prepend(str(other))
    moved = importlib.import_module("stamped_kernels")
    assert Path(moved.__file__).parent == other
    assert moved.total(np.ones(3)) == 9.0
    assert is_kept(moved.total)


def test_a_helper_whose_module_got_another_name_is_no_obstacle(
    write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its code is the same, so the file is found, but names a module that is gone."""
    assert write().total(np.ones(3)) == 9.0
    renamed = (tmp_path / "stamped_helpers.py").rename(tmp_path / "stamped_renamed.py")
    kernels = tmp_path / "stamped_kernels.py"
    kernels.write_text(kernels.read_text().replace("stamped_helpers", renamed.stem))
    for name in ("stamped_helpers", "stamped_kernels"):
        del sys.modules[name]
    assert importlib.import_module("stamped_kernels").total(np.ones(3)) == 9.0


def test_a_change_of_its_options_compiles_it_again(write: Any) -> None:
    assert write().total(np.ones(4)) == 12.0
    changed = write("parallel=False", "parallel=False, allocates=False").total
    assert changed(np.ones(4)) == 12.0
    assert not is_kept(changed)


def test_the_latest_versions_are_kept(write: Any) -> None:
    """Also the older one of two between which somebody changes."""
    written = [write("found = 0.0", f"found = {value}.0").total(np.zeros(1)) for value in range(1, VERSIONS + 3)]
    assert written == [value + 1.0 for value in range(1, VERSIONS + 3)]
    folder = kernel_folder()
    assert folder is not None
    assert len(list(folder.glob("stamped_kernels.total.*.nbi"))) == VERSIONS
    assert len(list(folder.glob("stamped_kernels.total.*.nbc"))) == VERSIONS
    for value, expected in ((3, True), (2, False)):
        kernel = write("found = 0.0", f"found = {value}.0").total
        assert kernel(np.zeros(1)) == value + 1.0
        assert is_kept(kernel) is expected


def test_without_a_folder_they_are_compiled_in_each_process(
    write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "file"))
    assert kernel_folder() is None
    for _ in range(2):
        kernel = write().total
        assert kernel(np.ones(4)) == 12.0
        assert not kernel.stats.cache_hits
