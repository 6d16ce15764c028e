"""Settings of ``nsvq fit`` as they are typed: configs by name, short options, and what is refused without Lightning."""

import json
import re
from argparse import ArgumentError
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from nsvq_lightning.commands import nearest
from nsvq_lightning.data import NO_FOLDER
from nsvq_lightning.top_level import folder_of

# What ``nsvq fit --help`` prints without Lightning, whose import takes seconds; a test compares it with its parser.
FIT_HELP = Path(__file__).with_name("fit_help.txt")
CONFIG = "--config="
BUDGET = "--callbacks.budget"

# Short options of ``fit``. The first three are numbers of :class:`nsvq_lightning.callbacks.SplatBudget`, of which one
# holds.
SHORTHANDS = {
    "quality": "Splats, as a multiple of the default for the photos; more look better and take more bytes and time",
    "splats": "Splats of the scene, instead of --quality",
    "bytes": "Size of the file at level compact, instead of --quality",
    "minutes": "Time to train on this machine, without evaluations: as many iterations as measured steps allow",
}


def joined(arguments: Sequence[str]) -> list[str]:
    """The arguments, each option together with its value (``--a=1`` for ``--a 1``), ``-c`` and ``-h`` in full."""
    found: list[str] = []
    for argument in arguments:
        option = re.sub(r"^-h$", "--help", re.sub(r"^-c(?==|$)", "--config", argument))
        waits = found and found[-1].startswith("--") and "=" not in found[-1] and found[-1] != "--help"
        if waits and not option.startswith("--"):
            found[-1] += f"={option}"
        else:
            found.append(option)
    return found


def expand(arguments: Sequence[str]) -> list[str]:
    """The joined arguments, configs that are no files as paths of shipped ones, shorthands as what they stand for.

    That is their own number, and none of the others. Configs come before options, which hold whatever they say.

    Raises:
        ValueError: Two shorthands are given, of which only one can hold, or one without its number.
    """
    expanded = []
    size = None  # the shorthand that says how large the scene is to be
    for argument in joined(arguments):
        option, _, value = argument.partition("=")
        name = option.removeprefix("--")
        if argument.startswith(CONFIG):
            expanded.append(f"{CONFIG}{find_config(value)}")
        elif not option.startswith("--") or name not in SHORTHANDS or arguments[0] == "export":
            expanded.append(argument)
        elif name != "minutes" and size not in (None, name):
            raise ValueError(f"--{size} and --{name} both say how large the scene is to be: give one of them")
        elif not value:
            raise ValueError(f"{option} needs a number")
        elif name == "minutes":
            expanded.append(f"--callbacks.phases.minutes={value}")
        else:
            size = name
            expanded.append(f"{BUDGET}.{name}={value}")
            expanded += [f"{BUDGET}.{other}=null" for other in ("splats", "bytes") if other != name]
    # An option holds whatever a config says, also one that stands after it.
    return sorted(expanded, key=lambda each: (each.startswith("--"), not each.startswith(CONFIG)))


# Whose options are in that help; another version may have others, which its parser knows.
FIT_HELP_OF = {"lightning": "2.6.6", "jsonargparse": "4.53.0"}


def check_early(arguments: Sequence[str]) -> None:
    """Refuse what takes no import of Lightning to refuse: configs and scenes that do not exist, and options of ``fit``.

    Args:
        arguments: Expanded ones, after the command.

    Raises:
        ArgumentError: There is no such config, or no such option.
        FileNotFoundError: There is no such scene folder.
        ValueError: A config cannot be read, or the folder says nothing of cameras.
    """
    command, *options = arguments
    configs = configs_among(arguments)
    for config in configs:
        if not Path(config).is_file():
            shipped = sorted(path.stem for path in folder_of("configs").glob("*.yaml"))
            meant = f"{nearest(Path(config).stem, shipped)}\nShipped ones: {', '.join(shipped)}"
            raise ArgumentError(None, f"there is no config {config}{meant}")
    own = values_by_name(options)
    given = values_by_name(settings_of(configs)) | own
    asks = any(name == "print_config" or name.endswith("help") for name in given)
    root = given.get("data.root")
    folder = Path(root or "").expanduser()
    if not folder.exists() and not asks:
        raise FileNotFoundError(NO_FOLDER.format(root))
    if command != "fit":
        return
    other_data = not {"data", "data.class_path"}.isdisjoint(given)
    _check_options(options, own, other_data)
    if asks or other_data:
        return
    if root is None:
        raise ArgumentError(None, "which scene? Name its folder: --data.root=path/to/scene")
    from nsvq_lightning.data import colmap

    if "data.model" not in given and not any(folder.glob("transforms*.json")):
        colmap.model_files(folder)


def _check_options(options: Sequence[str], own: Mapping[str, str], other_data: bool) -> None:
    """Refuse options that ``fit`` does not have."""
    if stray := [option for option in options if not option.startswith("--")]:
        place = next((option for option in stray if Path(option).exists()), "path/to/scene")
        raise ArgumentError(None, f"{stray[0]} is no option; the scene folder is --data.root={place}")
    if any(version(name) != known for name, known in FIT_HELP_OF.items()):
        return  # options of another version are known to its parser only
    listed = re.findall(r"--([\w.]+)", FIT_HELP.read_text(encoding="utf-8"))
    known = {name for name in listed if not name.endswith(".help")}
    # So are those of a class that an option names.
    classes = known.difference(name.rpartition(".")[0] for name in known)
    if other_data:
        classes.add("data")
    nested = tuple(f"{name}." for name in classes)
    for name, value in own.items():
        is_short = any(each.startswith(name) for each in known)
        if is_short or name.startswith(nested) or name.endswith((".help", ".class_path")):
            continue
        meant = nearest(f"--{name}", (f"--{each}" for each in known))
        if value and Path(value).is_dir():
            meant = f"; the scene folder is --data.root={value}"
        raise ArgumentError(None, f"there is no option --{name}{meant}")


def find_config(name: str) -> str:
    """Path of a config: a given file, otherwise one shipped with the package (``paper``, ``configs/paper.yaml``).

    A name that is neither is returned unchanged, for the parser to report.
    """
    shipped = folder_of("configs") / Path(name).as_posix().removeprefix("configs/")
    for path in (Path(name), shipped, shipped.with_name(f"{shipped.name}.yaml")):
        if path.is_file():
            return str(path)
    return name


def configs_among(arguments: Iterable[str]) -> list[str]:
    """The values of ``--config`` among joined arguments."""
    return [argument.removeprefix(CONFIG) for argument in arguments if argument.startswith(CONFIG)]


def settings_of(configs: Iterable[str]) -> Iterator[str]:
    """What configs set, each value as the option ``--a.b=value``.

    Raises:
        ValueError: One cannot be read, see :func:`check_config`.
    """
    for config in configs:
        yield from _as_options(check_config(config), "--")


def _as_options(settings: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _as_options(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}={value}"


def values_by_name(options: Iterable[str]) -> dict[str, str]:
    """The value of each option by its name, without dashes and what only a config spells out."""
    values = {}
    for option in options:
        name, _, value = option.partition("=")
        values[name.removeprefix("--").removesuffix("+").replace(".init_args", "")] = value
    return values


# Of a config; that of a run has 6 kB.
MAX_BYTES = 1 << 17


def check_config(path: str) -> dict[str, Any]:
    """Settings of a config, none where the name is not that of a file, which the parser reports.

    Raises:
        ValueError: It is not text, not YAML, too large, not a table of settings, or a section has none.
    """
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Refuses names that stand twice, of which YAML's own takes the last one without a word."""

        def compose_mapping_node(self, anchor: Any) -> Any:
            node = super().compose_mapping_node(anchor)
            names = Counter(key.value for key, _ in node.value if key.tag.endswith(":str"))
            if twice := next((name for name, uses in names.items() if uses > 1), ""):
                raise ValueError(f"line {node.start_mark.line + 1} begins a part that has {twice} twice")
            return node

    file = Path(path)
    if not file.is_file():
        return {}
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"config {path} has {size} bytes, more than {MAX_BYTES}: give another file")
    try:
        # Not the parser's loader: what is nested too deep would overflow its stack.
        settings = Loader(file.read_text(encoding="utf-8")).get_single_data()
        json.dumps(settings, default=str)  # refuses what holds itself
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"config {path} is not YAML ({' '.join(str(error).split())}): correct the file") from error
    if not isinstance(settings, dict):
        found = "nothing" if settings is None else type(settings).__name__
        raise ValueError(f"config {path} holds {found}: give settings by name, like 'trainer: {{max_steps: 1000}}'")
    # The parser would take the run's callbacks away, or fail.
    if empty := [name for name in ("callbacks", "data", "model", "trainer") if settings.get(name, "") is None]:
        raise ValueError(f"config {path} has nothing below {empty[0]}: remove that line")
    return settings
