"""Where compiled kernels are kept: in one folder of the user, for all environments with the same versions.

Numba keeps them beside their source, so that each new environment compiles all of them again, and until that file
changes: too late, since a kernel contains the code of its helpers and constants of other modules. Here the files,
still Numba's own, lie in a folder named after a digest of the sources of a kernel's module and of all that it imports.
"""

import re
import sys
from functools import cache
from hashlib import sha256
from importlib.util import resolve_name
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryFile
from time import perf_counter
from typing import Any

import numba
from filelock import FileLock, Timeout
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.misc.appdirs import AppDirs

from nsvq_lightning.top_level import log


@cache
def source_digest(module: str) -> str:
    """SHA-256 of the source of a module and of all that it imports from its own top-level package, directly or not.

    Of other packages a kernel depends only on this one, which it imports to be compiled, and on Numba, whose version
    names the folder.

    Raises:
        OSError: A source cannot be read.
    """
    digests = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in digests and (path := _file_of(name, module)):
            digests[name], imports = _read(path)
            package = name if path.stem == "__init__" else name.rpartition(".")[0]
            for base, names, modules in imports:
                waiting += re.findall(r"[\w.]+", modules)
                if base:
                    base = resolve_name(base, package)
                    waiting += [base, *(f"{base}.{part}" for part in re.findall(r"\w+", names))]
    settings = sys.version, numba.config.USING_SVML, numba.config.BOUNDSCHECK  # which change the code of a kernel
    return sha256(repr((settings, sorted(digests.items()))).encode()).hexdigest()


@cache
def _read(path: Path) -> tuple[bytes, list[Any]]:
    """The digest of a source, and its imports."""
    source = path.read_bytes()
    # Those that are not in a function: a module and names, or modules.
    imports = re.findall(r"^(?:from +([\w.]+) +import +(\([^)]*\)|.*)|import +(.*))", source.decode(), re.MULTILINE)
    return sha256(source).digest(), imports


def _file_of(name: str, module: str) -> Path | None:
    """The source of ``name`` if it is a module of the package that ``module`` is in, or of this one."""
    top, *parts = name.split(".")
    if top not in (module.partition(".")[0], __name__.partition(".")[0]):
        return None
    first = Path(str(sys.modules[top].__file__))
    if not parts:
        return first
    path = first.parent.joinpath(*parts)
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.exists()), None)


def kernel_folder() -> Path | None:
    """The folder of compiled kernels: in ``NUMBA_CACHE_DIR`` if that is set, else in the user's folder of caches.

    None if it cannot be written to; kernels are then compiled in each process.
    """
    return _writable(str(numba.config.CACHE_DIR))


@cache
def _writable(chosen: str) -> Path | None:
    own = Path(chosen, "nsvq_lightning") if chosen else Path(AppDirs("nsvq_lightning", appauthor=False).user_cache_dir)
    try:
        folder = own.expanduser() / f"kernels-numba-{numba.__version__}"
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):  # there is no home
        return None
    return folder


class _Locator(_CacheLocator):
    """The folder of one kernel, for Numba; what else it asks for is in the name of the folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Locator | None":
        folder = kernel_folder()
        try:
            return None if folder is None else cls(folder / source_digest(py_func.__module__)[:16])
        except OSError:
            return None

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return ""

    get_disambiguator = get_source_stamp


class _Layout(CompileResultCacheImpl):
    _locator_classes = (_Locator,)


def constants(function: Any) -> tuple[Any, ...]:
    """What a function knows from the functions around it; of a compiled one among that, what that knows."""
    known = [cell.cell_contents for cell in function.__closure__ or ()]
    return tuple(constants(each.py_func) if hasattr(each, "py_func") else each for each in known)


class BusyError(Exception):
    """Another process compiles the kernel."""


# Whether to wait for a kernel that another process compiles, and how many seconds at most.
waits = True
PATIENCE = 30
seconds_waited = 0.0
# So many folders are kept; those of a few checkouts, between which one may change.
MAX_FOLDERS = 64


class KernelCache(FunctionCache):
    """Numba's disk cache of one kernel, in a folder of :func:`kernel_folder` named after its :func:`source_digest`.

    A process that finds no kernel there holds its lock until it has compiled it.

    Attributes:
        _lock: Held while this process compiles the kernel.

    Raises:
        RuntimeError: There is no such folder.
    """

    _impl_class = _Layout
    _lock: FileLock | None = None

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return sig, codegen.magic_tuple(), constants(self._py_func)

    def is_there(self) -> bool:
        """Whether the kernel was compiled, for whatever arguments."""
        return Path(self._cache_file._index_path).exists()

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super()._load_overload(sig, target_context) or self._locked(sig, target_context)
        except OSError as error:  # a folder that cannot be read, or knows no locks
            log.debug(f"{self._name} is not looked for on the disk: {error}")
            return None

    def _locked(self, sig: Any, target_context: Any) -> Any:
        """The kernel if another process has compiled it by the time that this one may; None holds the lock."""
        global seconds_waited
        begin, lock = perf_counter(), FileLock(f"{self._cache_file._index_path}.lock")
        try:
            Path(self._cache_path).mkdir(exist_ok=True)
            lock.acquire(timeout=PATIENCE if waits else 0)
            self._lock = lock
        except Timeout:
            if not waits:
                raise BusyError from None
        seconds_waited += perf_counter() - begin
        found = super()._load_overload(sig, target_context)
        if found is not None:
            self.let_go()
        return found

    def _save_overload(self, sig: Any, data: Any) -> None:
        try:
            super()._save_overload(sig, data)
            folders = (path for path in Path(self._cache_path).parent.iterdir() if path.is_dir())
            for outdated in sorted(folders, key=lambda path: path.stat().st_mtime)[:-MAX_FOLDERS]:
                rmtree(outdated, ignore_errors=True)
        except OSError as error:  # a full disk, or another process removes folders, too
            log.debug(f"{self._name} is not kept: {error}")
        finally:
            self.let_go()

    def let_go(self) -> None:
        """Let other processes compile the kernel; also where this one could not."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
