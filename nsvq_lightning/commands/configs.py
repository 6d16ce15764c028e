"""Configs: which arguments name one, where the shipped ones are, and whether a file is one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import chain
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from nsvq_lightning.top_level import folder_of

if TYPE_CHECKING:
    from yaml.nodes import Node

__all__ = [
    "check_config",
    "configs_among",
    "find_config",
    "limit_aliases",
    "read_config",
    "resolve_configs",
    "shipped_configs",
    "written_by_run",
]

CONFIG_OPTIONS = ("--config", "-c")
_MOST_BYTES, _MOST_VALUES = 1 << 17, 100_000
"""Of a config, and of its values with every alias written out; that of a run has 6 kB and 500 values."""


def resolve_configs(arguments: Sequence[str]) -> list[str]:
    """The arguments, with every ``--config NAME`` that is not a file replaced by the shipped config of that name."""
    resolved = list(arguments)
    for place, name in _configs(arguments):
        resolved[place] = resolved[place].removesuffix(name) + find_config(name)
    return resolved


def configs_among(arguments: Sequence[str]) -> list[str]:
    """The values of ``--config`` among the arguments."""
    return [name for _, name in _configs(arguments)]


def _configs(arguments: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Position of each argument that ends with the name of a config, and that name."""
    expects_config = False
    for place, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        if expects_config:
            yield place, argument
        elif option in CONFIG_OPTIONS and equals:
            yield place, value
        expects_config = not expects_config and argument in CONFIG_OPTIONS


def check_config(path: str) -> dict[str, Any]:
    """Settings of a config, none where the name is not that of a file, which the parser reports.

    Raises:
        ValueError: It is not text, not YAML, or not a table of settings.
    """
    if not Path(path).is_file():
        return {}
    settings = read_config(Path(path))
    if not isinstance(settings, dict):
        found = "nothing" if settings is None else type(settings).__name__
        raise ValueError(f"config {path} holds {found}: give settings by name, like 'trainer: {{max_steps: 1000}}'")
    return settings


def read_config(path: Path) -> object:
    """Content of a YAML file of settings.

    Raises:
        ValueError: It is not text or not YAML, or too large; what aliases repeat counts as often as they are named.
    """
    import yaml

    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"config {path} has {path.stat().st_size} bytes, more than {_MOST_BYTES}: give another file")
    try:
        loader = yaml.SafeLoader(path.read_text(encoding="utf-8"))
        node = loader.get_single_node()
        values = _values(node, {})
        settings = None if node is None or values > _MOST_VALUES else loader.construct_document(node)
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"config {path} is not YAML ({' '.join(str(error).split())}): correct the file") from error
    if values > _MOST_VALUES:
        raise ValueError(f"config {path} has more than {_MOST_VALUES} values by its aliases (*name): correct the file")
    return settings


@cache  # otherwise, each call would wrap the loader once more
def limit_aliases() -> None:
    """Let the parser refuse what :func:`read_config` does, in files that a config names and in its texts, too."""
    import yaml
    from jsonargparse._loaders_dumpers import get_yaml_default_loader  # all of its ways to read YAML use this class

    loader = get_yaml_default_loader()  # type: ignore[no-untyped-call]
    compose = loader.get_single_node

    def checked(self: object) -> Node | None:
        node: Node | None = compose(self)
        if _values(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f"more than {_MOST_VALUES} values by aliases (*name): correct it")
        return node

    loader.get_single_node = checked


def _values(node: Node | None, known: dict[int, float]) -> float:
    """Number of values in a node of YAML with all its aliases written out; infinite for one that holds itself."""
    if node is None:
        return 0
    if id(node) not in known:
        known[id(node)] = math.inf
        pairs = node.id == "mapping"
        parts = chain.from_iterable(node.value) if pairs else node.value if node.id == "sequence" else ()
        known[id(node)] = 1 + sum(_values(part, known) for part in parts)
    return known[id(node)]


def written_by_run(path: str) -> bool:
    """Whether a file is the ``config.yaml`` that a run leaves; Lightning writes its version on the first line."""
    return Path(path).is_file() and Path(path).read_text(encoding="utf-8").startswith("# lightning")


def find_config(name: str) -> str:
    """Path of a config: a given file, otherwise one shipped with the package (``nsvq_4k``, ``configs/nsvq_4k.yaml``).

    A name that is neither is returned unchanged, for the parser to report.
    """
    if Path(name).exists():
        return name
    plain = _without_folder(Path(name))
    for shipped in (folder_of("configs") / plain, folder_of("configs") / f"{plain}.yaml"):
        if shipped.is_file():
            return str(shipped)
    return name


def shipped_configs() -> list[str]:
    """Names of the configs that come with the package, without their suffix."""
    return sorted(path.stem for path in folder_of("configs").glob("*.yaml"))


def _without_folder(path: PurePath) -> str:
    return path.as_posix().removeprefix("configs/")
