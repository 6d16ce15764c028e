"""How kernels are compiled, cached and run in parallel."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import torch

__all__ = ["inline", "kernel", "thread_count"]

_OPTIONS: dict[str, Any] = {
    # Products and sums may fuse; NaN and infinity keep their meaning because the guards of this package rely on them.
    "fastmath": {"contract", "nsz"},
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}


def _stamp() -> str:
    """Digest of all sources that kernels are made of: the files that import something of this folder, and its own.

    What those import counts too, as the constants of a module are part of the kernels that name them.
    """
    package = Path(__file__).parents[2]
    files: set[Path] = set()
    for path in [*Path(__file__).parent.glob("*.py"), *package.glob("*/*.py")]:
        source = path.read_text(encoding="utf-8")
        if path.parent == Path(__file__).parent or re.search(r"rendering\.cpu\.(jit|lanes) import", source):
            files |= {path, *_imported(package, source)}
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _imported(package: Path, source: str) -> list[Path]:
    """The files of the package that a source imports."""
    files = []
    for module, names in re.findall(rf"^from {package.name}((?:\.\w+)*) import ([\w, ]*)", source, re.MULTILINE):
        base = package.joinpath(*module.split("."))
        files += [base.with_suffix(".py"), *(base / f"{name.strip()}.py" for name in names.split(","))]
    return [path for path in files if path.is_file()]


_STAMP = _stamp()


def inline(function: Callable[..., Any]) -> Any:
    """Compile a helper that only other kernels call."""
    return numba.njit(forceinline=True, **_OPTIONS)(function)


def kernel(function: Callable[..., Any], parallel: bool = True, allocates: bool = True) -> Any:
    """Compile a kernel once a machine and keep it on disk. To wake the threads costs more than some need in all.

    One that makes no arrays of its own may say so: arrays that it passes to inlined helpers are then not counted up and
    down, by atomic operations, at every call. A loop of few instructions becomes seven times as fast.

    Numba looks only at a kernel's own file to tell whether a stored one is stale; here every file with a kernel or a
    helper of one counts, because kernels contain the code of their helpers.
    """
    dispatcher = numba.njit(parallel=parallel, cache=True, _nrt=allocates, **_OPTIONS)(function)
    files = getattr(dispatcher._cache, "_cache_file", None)
    if files is not None and hasattr(files, "_source_stamp"):
        files._source_stamp = (files._source_stamp, _STAMP)
    return dispatcher


def thread_count() -> int:
    """Threads that kernels use: torch's setting, so that one knob rules both."""
    count = max(1, min(torch.get_num_threads(), int(numba.config.NUMBA_NUM_THREADS)))
    numba.set_num_threads(count)
    return count
