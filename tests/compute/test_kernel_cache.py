"""Which changes compile a stored kernel again, and where kernels are kept."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.caching import FunctionCache

from nsvq_lightning.compute import kernel_cache
from nsvq_lightning.compute.kernel_cache import kernel_folder, source_digest

SOURCES = {
    "__init__": "",
    "constants": "SCALE = 2.0\n",
    "helpers": """
from nsvq_lightning.compute.jit import inline
from . import constants

@inline
def scaled(x, shift=1.0):
    return constants.SCALE * x + shift
""",
    "kernels": """
from nsvq_lightning.compute.jit import kernel
from stamped.helpers import (
    scaled,
)

def total(table):
    found = 0.0
    for i in range(table.shape[0]):
        found += scaled(table[i])
    return found

total = kernel(total)

def made(power):
    def powers(x):
        return scaled(x) ** power

    return kernel(powers)
""",
    "unrelated": "VALUE = 1\n",
}


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Write a package, with one change, and import its kernels anew."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "caches"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # it would not see a change within a second

    def write(old: str = "", new: str = "", place: str = "here") -> Any:
        folder = tmp_path / place / "stamped"
        folder.mkdir(parents=True, exist_ok=True)
        assert any(old in source for source in SOURCES.values())
        for name, source in SOURCES.items():
            (folder / f"{name}.py").write_text(source.replace(old, new) if old else source)
        forget()
        monkeypatch.syspath_prepend(str(folder.parent))
        return importlib.import_module("stamped.kernels")

    yield write
    forget()


def forget() -> None:
    for name in [name for name in sys.modules if name.startswith("stamped")]:
        del sys.modules[name]
    source_digest.cache_clear()
    kernel_cache._read.cache_clear()
    importlib.invalidate_caches()


def is_kept(kernel: Any) -> bool:
    """Whether the kernel, called once, came from the disk."""
    hits, misses = (sum(counts.values()) for counts in (kernel.stats.cache_hits, kernel.stats.cache_misses))
    assert hits + misses == 1
    return bool(hits)


@pytest.mark.parametrize(
    ("old", "new", "result"),
    [
        ("SCALE = 2.0", "SCALE = 3.0", 14.0),
        ("* x +", "* x -", 6.0),
        ("found = 0.0", "found = 1.0", 11.0),
        ("kernel(total)", "kernel(total, allocates=False)", 10.0),
    ],
    ids=["constant two modules away", "code of a helper", "own constant", "options"],
)
def test_a_change_of_what_a_kernel_is_made_of_compiles_it_again(write: Any, old: str, new: str, result: float) -> None:
    table = np.array([1.0, 3.0])
    assert write().total(table) == 10.0
    for kept in (False, True):
        changed = write(old, new).total
        assert changed(table) == result
        assert is_kept(changed) == kept
    again = write().total  # both versions are kept, for two checkouts between which one changes
    assert again(table) == 10.0
    assert is_kept(again)


@pytest.mark.parametrize("change", [{"old": "VALUE = 1", "new": "VALUE = 2"}, {"place": "there"}])
def test_other_modules_and_other_environments_do_not_matter(write: Any, change: dict[str, str]) -> None:
    assert write().total(np.ones(4)) == 12.0
    other = write(**change).total
    assert other(np.ones(4)) == 12.0
    assert is_kept(other)


def test_our_own_modules_count_for_kernels_of_other_packages(write: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    write()
    before, read = source_digest("stamped.kernels"), kernel_cache._read.__wrapped__
    forget()
    write()
    source_digest.cache_clear()
    monkeypatch.setattr(
        kernel_cache, "_read", lambda path: (b"another", []) if path.name == "jit.py" else read(path), raising=True
    )
    assert source_digest("stamped.kernels") != before
    monkeypatch.undo()


def test_kernels_that_a_function_makes_are_kept_side_by_side(write: Any) -> None:
    first = write()
    assert [first.made(power)(1.0) for power in (1, 2)] == [3.0, 9.0]
    kernels = [write().made(power) for power in (1, 2, 3)]
    assert [kernel(1.0) for kernel in kernels] == [3.0, 9.0, 27.0]
    assert [is_kept(kernel) for kernel in kernels] == [True, True, False]


def test_the_latest_folders_are_kept(write: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "MAX_FOLDERS", 2)
    for value in range(3):
        write("found = 0.0", f"found = {value}.0").total(np.zeros(1))
    folder = kernel_folder()
    assert folder is not None
    assert len(list(folder.iterdir())) == 2
    kernel = write("found = 0.0", "found = 1.0").total
    assert kernel(np.zeros(1)) == 2.0
    assert is_kept(kernel)


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


def test_without_a_home_there_is_no_folder_of_that_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As in a container whose user is not in /etc/passwd."""
    pwd = pytest.importorskip("pwd", reason="Windows has another place for homes")

    def nobody(_: int) -> None:
        raise KeyError("uid not found")

    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)
    monkeypatch.chdir(tmp_path)
    assert kernel_cache._writable.__wrapped__("") is None
    assert not list(tmp_path.iterdir())


def test_a_kernel_works_where_its_folder_does_not(write: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A full home, a folder that another process has removed, or one without locks costs the cache, not the result."""

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    for owner, name in ((FunctionCache, "_save_overload"), (FunctionCache, "_load_overload"), (Path, "iterdir")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, full)
            assert write("found = 0.0", f"found = {len(name)}.0").total(np.ones(4)) == 12.0 + len(name)
    kernel = write().total
    assert kernel(np.ones(4)) == 12.0
    assert kernel._cache._lock is None


def test_a_compilation_that_fails_keeps_nobody_waiting(write: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "waits", False)  # a busy kernel is an error
    before = numba.config.OPT
    for _ in range(2):
        kernel = write("found = 0.0", "found = None").total
        with pytest.raises(numba.core.errors.TypingError):
            kernel(np.ones(4))
        assert kernel._cache._lock is None
    assert before == numba.config.OPT
