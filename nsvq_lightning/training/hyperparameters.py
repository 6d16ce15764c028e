"""Hyper-parameters as checkpoints may hold them: plain data, readable with ``weights_only=True``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from typing import Any

__all__ = ["plain"]


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """The entries that are plain data; dataclasses become dictionaries, everything else is left out.

    An object in a checkpoint would make it unreadable without executing code. LightningCLI records classes as
    ``class_path`` and ``init_args``, which are plain; a class given from Python must be given again at loading.
    """
    converted = {name: asdict(v) if is_dataclass(v) and not isinstance(v, type) else v for name, v in values.items()}
    return {name: value for name, value in converted.items() if _is_plain(value)}


def _is_plain(value: Any) -> bool:
    if type(value) is dict:
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if type(value) in (list, tuple):
        return all(_is_plain(item) for item in value)
    # Exact types: an enumeration or a numpy number is an int or float too, but not to the unpickler.
    return value is None or type(value) in (bool, int, float, str)
