"""Where compiled kernels are kept: one folder of the user, for all environments with the same versions.

Numba keeps them beside their source, so that each new environment compiles all of them again, and until that file
changes: too late, since a kernel contains the code of its helpers and the constants of other modules, and too early,
since a comment changes nothing. Here the names of a kernel's files hold a digest of everything that it is compiled
from: its code and whatever that code refers to, across any number of modules.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import inspect
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodDescriptorType, ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.dispatcher import Dispatcher
from numba.extending import lower_builtin
from numba.misc.appdirs import AppDirs

__all__ = ["KernelStore", "closure_digest", "digest", "kernel_folder", "template_digest"]


LIBRARIES = frozenset({"llvmlite", "numba", "numpy", "torch", *sys.stdlib_module_names})
"""Not looked into: a kernel depends on these only through Numba's version, which names the folder of kernels."""


def digest(thing: Any) -> str:
    """SHA-256 of all that makes up a kernel, a helper or a value that they refer to: code, constants and options.

    It leaves out what is not in the compiled code: argument names, line numbers, comments, docstrings and annotations.

    Raises:
        TypeError: The object, or one that it refers to, is of a kind that no kernel can use.
    """
    found = hashlib.sha256()
    _Walk(found).add(thing)
    return found.hexdigest()


def template_digest(function: FunctionType, options: dict[str, Any]) -> str:
    """Digest of a kernel and the options that it is compiled with, without the values that it closes over."""
    found = hashlib.sha256()
    walk = _Walk(found)
    walk.add(options)
    walk.function(function)
    return found.hexdigest()


def closure_digest(function: FunctionType) -> str:
    """Digest of the values that a kernel closes over."""
    return digest(_cells(function))


class _Walk:
    """Feeds a digest with everything reachable from an object, each once."""

    def __init__(self, found: Any) -> None:
        self._found = found
        self._seen: dict[int, int] = {}
        self._kept: list[Any] = []  # keeps the objects alive, so that no id in `_seen` is reused

    def add(self, thing: Any) -> None:
        if isinstance(thing, type(None) | type(...) | bool | int | float | complex | str | bytes):
            self._say(type(thing).__name__, repr(thing))
            return
        if isinstance(thing, tuple | list):
            self._say(type(thing).__name__, len(thing))
            self._each(thing)
            return
        if id(thing) in self._seen:
            self._say("again", self._seen[id(thing)])
            return
        self._seen[id(thing)] = len(self._seen)
        self._kept.append(thing)
        self._open(thing)

    def _open(self, thing: Any) -> None:
        if isinstance(thing, set | frozenset):
            self._say("set", *sorted(map(digest, thing)))
        elif isinstance(thing, dict):
            self._say("dict", len(thing))
            self._each(thing.items())
        elif isinstance(thing, np.ndarray | np.generic):
            self._say("array", thing.dtype, thing.shape)
            self._found.update(thing.tobytes())
        elif isinstance(thing, Dispatcher):
            self._say("kernel")
            self._each((thing.targetoptions, thing.py_func))
        elif isinstance(thing, types.Type | ir.Type | ir.Value | np.dtype):
            self._say(type(thing).__name__, thing)
        elif isinstance(thing, ModuleType) or _is_foreign(thing):
            # What a kernel uses of our own modules is added with the code that refers to it.
            self._say(getattr(thing, "__module__", ""), getattr(thing, "__qualname__", getattr(thing, "__name__", "")))
        elif isinstance(thing, FunctionType):
            self.function(thing)
            self._each(_cells(thing))
        elif isinstance(thing, CodeType):
            self._code(thing, None)
        elif isinstance(thing, type):
            self._say("class", thing.__qualname__)
            self._each(thing.__bases__)
            self._each(item for item in vars(thing).items() if not item[0].startswith("__"))
        elif hasattr(thing, "_defn"):  # an intrinsic
            self.add(thing._defn)
        elif isinstance(thing, property | staticmethod | classmethod | functools.partial):
            self._each(getattr(thing, part, None) for part in ("fget", "__func__", "func", "args", "keywords"))
        else:
            raise TypeError(f"a kernel refers to {thing!r}; changes to a {type(thing).__name__} cannot be detected")

    def function(self, function: FunctionType) -> None:
        """Add what a function refers to, except for what it closes over."""
        self._say("function", function.__qualname__)
        self._each((function.__defaults__, function.__kwdefaults__))
        self._code(function.__code__, function.__doc__)
        names = _names(function.__code__)
        for name in sorted(names & function.__globals__.keys()):
            value = function.__globals__[name]
            self.add(name)
            self.add(value)
            if isinstance(value, ModuleType) and not _is_library(value.__name__):
                self._each(vars(value)[part] for part in sorted(names & vars(value).keys()))
        if any(value is lower_builtin for value in function.__globals__.values()):
            # It defines the operators, and no code that uses them refers to it by name.
            self._say("operators", _source(function.__module__))

    def _code(self, code: CodeType, doc: str | None) -> None:
        constants = code.co_consts
        if doc is not None and constants and constants[0] == doc:
            constants = constants[1:]
        self._say("code", code.co_code.hex(), code.co_names, code.co_argcount, code.co_flags & 0xFF)
        self._each(constants)

    def _each(self, things: Iterable[Any]) -> None:
        for thing in things:
            self.add(thing)

    def _say(self, *words: Any) -> None:
        self._found.update("\0".join(map(str, words)).encode() + b"\n")


def _cells(function: FunctionType) -> tuple[Any, ...]:
    return tuple(cell.cell_contents for cell in function.__closure__ or ())


def _names(code: CodeType) -> set[str]:
    """All names in a function's code and in the code objects nested in it."""
    held = (_names(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*held)


def _is_library(module: str) -> bool:
    return module.partition(".")[0] in LIBRARIES


def _is_foreign(thing: Any) -> bool:
    """Whether an object comes from a library or from Python itself."""
    module = getattr(thing, "__module__", None)
    if isinstance(thing, BuiltinFunctionType | MethodDescriptorType | np.ufunc):
        return True
    return isinstance(module, str) and isinstance(thing, type | FunctionType) and _is_library(module)


@functools.cache
def _source(module: str) -> str:
    """Digest of a module's statements, without comments and docstrings."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            del node.body[0]
    return digest(ast.dump(tree))


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
        try:
            return super()._load_overload(sig, target_context)
        except (ImportError, AttributeError):
            return None  # compiled when something that it refers to had another name

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
