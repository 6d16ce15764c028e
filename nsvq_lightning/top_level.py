"""Folders of the package that stand at the top level of the repository.

An installed package contains them, and in a checkout, symbolic links lead to them. Where git cannot create links, as on
Windows, it writes small text files instead; this module then finds the folders at the top level.
"""

import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

_PACKAGE = Path(__file__).parent


def folder_of(name: str) -> Path:
    """Where ``callbacks`` or ``configs`` is: in the package, or otherwise next to it."""
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def find_callbacks() -> None:
    """Make ``nsvq_lightning.callbacks`` importable from where it is; does nothing if that is the package."""
    folder = folder_of("callbacks")
    if folder.parent != _PACKAGE:
        sys.meta_path.append(_Finder(f"{_PACKAGE.name}.callbacks", folder))


class _Finder(MetaPathFinder):
    """Finds one package in a folder; its modules are found as usual."""

    def __init__(self, name: str, folder: Path) -> None:
        self._name, self._folder = name, folder

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != self._name:
            return None
        start = self._folder / "__init__.py"
        return spec_from_file_location(fullname, start, submodule_search_locations=[str(self._folder)])
