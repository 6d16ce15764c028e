"""What any room may need: the logger, commands that are said, and folders that stand beside the package.

An installed package contains these folders, and in a checkout, symbolic links lead to them. Where git cannot create
links, as on Windows, it writes small text files instead; this module then finds the folders at the top level.
"""

import logging
import os
import shlex
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from subprocess import list2cmdline
from types import ModuleType
from typing import Any

log = logging.getLogger("nsvq_lightning")
_PACKAGE = Path(__file__).parent


def join(words: Sequence[str]) -> str:
    """A command for the shell of this system; that of Windows knows no single quotes."""
    return list2cmdline(words) if os.name == "nt" else shlex.join(words)


def folder_of(name: str) -> Path:
    """Where ``callbacks`` or ``configs`` is: in the package, or otherwise next to it."""
    return _PACKAGE / name if (_PACKAGE / name).is_dir() else _PACKAGE.parent / name


def find_callbacks() -> None:
    """Make ``nsvq_lightning.callbacks`` importable from where it is; does nothing if that is the package."""
    if folder_of("callbacks").parent != _PACKAGE:
        sys.meta_path.append(_Finder())


class _Finder(MetaPathFinder):
    """Finds the callbacks at the top level; their modules are found as usual."""

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        is_ours = fullname == f"{_PACKAGE.name}.callbacks"
        return PathFinder.find_spec(fullname, [str(_PACKAGE.parent)]) if is_ours else None
