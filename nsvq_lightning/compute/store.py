"""Where compiled kernels are kept: one folder of the user, for all environments with the same versions.

Numba keeps them beside their source, so that each new environment compiles all of them again. Here the names of a
kernel's files hold the digest of all that it is compiled from (:mod:`nsvq_lightning.compute.stamp`), wherever that
lies.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.misc.appdirs import AppDirs

from nsvq_lightning.compute.stamp import closure_digest, template_digest

__all__ = ["KernelStore", "kernel_folder"]

VERSIONS = 4
"""So many versions of a kernel are kept: those of a few checkouts, between which one may change."""


def kernel_folder() -> Path | None:
    """The folder of compiled kernels: in ``NUMBA_CACHE_DIR`` if that is set, else in the user's folder of caches.

    None if it cannot be written to; kernels are then compiled in each process.
    """
    return _writable(str(numba.config.CACHE_DIR))


@functools.cache
def _writable(chosen: str) -> Path | None:
    own = Path(chosen, "nsvq_lightning") if chosen else Path(AppDirs("nsvq_lightning", appauthor=False).user_cache_dir)
    folder = own / f"kernels-numba-{numba.__version__}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return None
    return folder


class _Locator(_CacheLocator):
    """The folder, for Numba; what else it asks for is in the names of the files."""

    def get_cache_path(self) -> str:
        return str(kernel_folder() or "")

    def get_source_stamp(self) -> str:
        return ""

    def get_disambiguator(self) -> str:
        return ""


class _Layout(CompileResultCacheImpl):
    """Names files after the kernel and the version of Python; Numba's own names contain the line of the source."""

    def __init__(self, function: FunctionType) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._locator = _Locator()
        name = f"{function.__module__}.{function.__qualname__}".replace("<", "").replace(">", "")
        self._filename_base = f"{name}.py{sys.version_info[0]}{sys.version_info[1]}{getattr(sys, 'abiflags', '')}"


class KernelStore(FunctionCache):
    """Numba's disk cache of one kernel, in :func:`kernel_folder` and under a name that says what it is compiled from.

    Args:
        function: The kernel in Python.
        options: What it is compiled with.
    """

    _impl_class = _Layout

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function)
        self._options = options
        if kernel_folder() is None:
            self.disable()

    @functools.cached_property
    def _files(self) -> IndexDataCacheFile:
        # Not before the first call: a kernel may refer to helpers that its module defines after it.
        stamp = template_digest(self._py_func, self._options)
        return IndexDataCacheFile(self._cache_path, f"{self._impl.filename_base}-{stamp[:16]}", stamp)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        if self._enabled:
            self._cache_file = self._files
        return super()._load_overload(sig, target_context)

    def _save_overload(self, sig: Any, data: Any) -> None:
        super()._save_overload(sig, data)
        if self._enabled:
            self._forget(Path(self._cache_path).glob(f"{self._impl.filename_base}-*.nbi"))

    def _forget(self, indexes: Iterable[Path]) -> None:
        """Remove all but the latest versions of the kernel."""
        with contextlib.suppress(OSError):  # another process may be removing them, too
            for index in sorted(indexes, key=lambda path: path.stat().st_mtime)[:-VERSIONS]:
                for file in index.parent.glob(f"{index.stem}.*"):
                    file.unlink(missing_ok=True)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        # Kernels made by one function differ only in what they close over, and share a file. The settings change the
        # code of a kernel, and may differ between two environments or two runs in one.
        settings = numba.config.USING_SVML, numba.config.BOUNDSCHECK
        return sig, codegen.magic_tuple(), closure_digest(self._py_func), settings
