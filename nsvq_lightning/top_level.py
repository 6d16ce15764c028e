"""Folders of the package that stand at the top level of the repository.

An installed package holds them itself, and in a checkout links lead to them. Where git cannot make links, as on
Windows, it writes small text files in their place; the folders are then found at the top level, by what is here.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

__all__ = ["find_callbacks", "folder_of"]

_PACKAGE = Path(__file__).parent


def folder_of(name: str) -> Path:
    """Where ``callbacks`` or ``configs`` is: in the package, or else beside it."""
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def find_callbacks() -> None:
    """Let ``nsvq_lightning.callbacks`` be imported from where it is; nothing to do where that is the package."""
    folder = folder_of("callbacks")
    if folder.parent != _PACKAGE:
        sys.meta_path.append(_Finder(f"{_PACKAGE.name}.callbacks", folder))


class _Finder(MetaPathFinder):
    """Finds one package in a folder; the modules in it are found as usual."""

    def __init__(self, name: str, folder: Path) -> None:
        self._name, self._folder = name, folder

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self._name:
            return None
        start = self._folder / "__init__.py"
        return spec_from_file_location(fullname, start, submodule_search_locations=[str(self._folder)])
