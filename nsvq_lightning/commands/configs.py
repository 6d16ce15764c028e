"""Configs: which arguments name one, where the shipped ones are, and whether a file is one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath

from nsvq_lightning.top_level import folder_of

__all__ = ["check_config", "configs_among", "find_config", "resolve_configs", "shipped_configs", "written_by_run"]

CONFIG_OPTIONS = ("--config", "-c")


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


def check_config(path: str) -> None:
    """Refuse a file that cannot be a config; the parser reports a name that is not a file.

    Raises:
        ValueError: It is not text, not YAML, or not a table of settings.
    """
    import yaml

    if not Path(path).is_file():
        return
    try:
        settings = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"config {path} is not YAML ({' '.join(str(error).split())}): correct the file") from error
    if not isinstance(settings, dict):
        found = "nothing" if settings is None else type(settings).__name__
        raise ValueError(f"config {path} holds {found}: give settings by name, like 'trainer: {{max_steps: 1000}}'")


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
