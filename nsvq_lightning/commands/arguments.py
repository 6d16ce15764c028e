"""What commands take: lists, numbers, short options, configs, scenes; and what is said of wrong ones."""

import argparse
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from nsvq_lightning.data import NO_FOLDER
from nsvq_lightning.top_level import folder_of

if TYPE_CHECKING:
    from yaml.nodes import Node

    from nsvq_lightning.data.scene import Scene
    from nsvq_lightning.rendering.camera import Camera
    from nsvq_lightning.splats.splats import SplatTensors


def names(text: str) -> tuple[str, ...]:
    """The entries of ``A,B``, each once."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def some_of(known: Iterable[str]) -> Callable[[str], tuple[str, ...]]:
    """A function that reads ``A,B``, of known names, or ``all`` of them.

    Raises:
        argparse.ArgumentTypeError: By the function: an entry is none of them.
    """

    def parse(text: str) -> tuple[str, ...]:
        chosen = tuple(known) if text == "all" else names(text)
        if not chosen or not set(chosen) <= set(known):
            raise argparse.ArgumentTypeError(f"choose some of {', '.join(known)}, or all, got {text!r}")
        return chosen

    return parse


def integers(text: str) -> tuple[int, ...]:
    """The numbers of ``1,2``, each once.

    Raises:
        argparse.ArgumentTypeError: An entry is not a whole number.
    """
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected whole numbers with commas between them, got {text!r}") from None


def positive(kind: type[int] | type[float]) -> Callable[[str], int | float]:
    """A function that reads a number of this kind.

    Raises:
        argparse.ArgumentTypeError: By the function: it is not above 0, or not finite.
    """

    def parse(text: str) -> int | float:
        value = kind(text)
        if not 0 < value < math.inf:
            raise argparse.ArgumentTypeError(f"must be above 0, got {text}")
        return value

    parse.__name__ = kind.__name__  # argparse says "invalid float value"
    return parse


BUDGET = "--callbacks.budget"

# Short options of ``fit``. The first three are numbers of :class:`nsvq_lightning.callbacks.SplatBudget`, of which one
# holds.
SHORTHANDS: dict[str, str] = {
    "quality": "Splats, as a multiple of the default for the photos; more look better and take more bytes and time",
    "splats": "Splats of the scene, instead of --quality",
    "bytes": "Size of the file, instead of --quality",
    "minutes": "Time to train on this machine, without evaluations: as many iterations as measured steps allow",
}


def joined(arguments: Sequence[str]) -> list[str]:
    """The arguments, each option together with its value (``--a=1`` for ``--a 1``), ``-c`` as ``--config``."""
    found: list[str] = []
    for argument in arguments:
        option = re.sub(r"^-c(?==|$)", "--config", argument)
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
    expanded: list[str] = []
    given: str | None = None
    for argument in joined(arguments):
        option, _, value = argument.partition("=")
        name = option.removeprefix("--")
        if argument.startswith(CONFIG):
            expanded.append(CONFIG + find_config(value))
        elif not option.startswith("--") or name not in SHORTHANDS:
            expanded.append(argument)
        elif name != "minutes" and given not in (None, name):
            raise ValueError(f"--{given} and --{name} both say how large the scene is to be: give one of them")
        elif not value:
            raise ValueError(f"{option} needs a number")
        elif name == "minutes":
            expanded.append(f"--callbacks.phases.minutes={value}")
        else:
            given = name
            expanded.append(f"{BUDGET}.{name}={value}")
            expanded += [f"{BUDGET}.{other}=null" for other in ("splats", "bytes") if other != name]
    # An option holds whatever a config says, also one that stands after it.
    return sorted(expanded, key=lambda each: (each.startswith("--"), not each.startswith(CONFIG)))


# Types as users call them; others by their name.
WORDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "text", "NoneType": "null"}


def nearest(word: str, known: Iterable[str]) -> str:
    """``; did you mean …?`` with the one that is most like a word; empty if none is."""
    found = get_close_matches(word, known, n=1)
    return f"; did you mean {found[0]}?" if found else ""


def unknown_option(message: str, options: Iterable[str]) -> str:
    """The nearest option to the one that a parser's message says is unknown; empty if the message is another one."""
    found = re.search(r"unrecognized arguments: --([\w.-]+)|[Oo]ption '([\w.]+)'", message)
    if found is None:
        return ""
    known = [option for option in options if option.startswith("--") and not option.endswith((".help", "+"))]
    return nearest("--" + (found[1] or found[2]), known)


# What ``nsvq fit --help`` prints without Lightning, whose import takes seconds; a test compares it with its parser.
FIT_HELP = Path(__file__).with_name("fit_help.txt")
# Whose options are in it; another version may have others, which its parser knows.
FIT_HELP_OF = {"lightning": "2.6.6", "jsonargparse": "4.53.0"}


def check_early(arguments: Sequence[str]) -> None:
    """Refuse what takes no import of Lightning to refuse: configs and scenes that do not exist, and options of ``fit``.

    Args:
        arguments: Expanded ones, after the command.

    Raises:
        argparse.ArgumentError: There is no such config, or no such option.
        FileNotFoundError: There is no such scene folder.
        ValueError: A config cannot be read, or the folder says nothing of cameras.
    """
    configs = configs_among(arguments)
    for config in configs:
        if not Path(config).is_file():
            shipped = shipped_configs()
            meant = f"{nearest(Path(config).stem, shipped)}\nShipped ones: {', '.join(shipped)}"
            raise argparse.ArgumentError(None, f"there is no config {config}{meant}")
    own = _values_by_name(arguments[1:])
    given = _values_by_name(settings_of(configs)) | own
    asks = any(name == "print_config" or name.endswith("help") for name in given)
    root = given.get("data.root")
    if root and not Path(root).expanduser().exists() and not asks:
        raise FileNotFoundError(NO_FOLDER.format(root))
    if arguments[0] != "fit":
        return
    other_data = not {"data", "data.class_path"}.isdisjoint(given)
    _check_options(arguments[1:], own, other_data)
    if asks or other_data:
        return
    if root is None:
        raise argparse.ArgumentError(None, "which scene? Name its folder: --data.root=path/to/scene")
    from nsvq_lightning.data import colmap

    folder = Path(root).expanduser()
    if "data.model" not in given and not any(folder.glob("transforms*.json")):
        colmap.model_files(folder)


def _check_options(arguments: Sequence[str], own: Mapping[str, str], other_data: bool) -> None:
    """Refuse options that ``fit`` does not have."""
    if stray := [argument for argument in arguments if not argument.startswith("--")]:
        place = next((argument for argument in stray if Path(argument).exists()), "path/to/scene")
        raise argparse.ArgumentError(None, f"{stray[0]} is no option; the scene folder is --data.root={place}")
    if any(version(name) != known for name, known in FIT_HELP_OF.items()):
        return  # options of another version are known to its parser only
    known = {name for name in re.findall(r"--([\w.]+)", FIT_HELP.read_text(encoding="utf-8")) if name[-5:] != ".help"}
    parents = {name.rpartition(".")[0] for name in known}
    for name, value in own.items():
        # So are those of a class that an option names.
        nested = any(name.startswith(f"{leaf}.") for leaf in (*(known - parents), *["data"] * other_data))
        if not (nested or name.endswith((".help", ".class_path")) or any(each.startswith(name) for each in known)):
            meant = nearest(f"--{name}", (f"--{each}" for each in known))
            if value and Path(value).is_dir():
                meant = f"; the scene folder is --data.root={value}"
            raise argparse.ArgumentError(None, f"there is no option --{name}{meant}")


def _values_by_name(options: Iterable[str]) -> dict[str, str]:
    return {
        name.removeprefix("--").removesuffix("+").replace(".init_args", ""): value
        for name, _, value in (option.partition("=") for option in options)
    }


def in_plain_words(message: str, classes: Iterable[str], arguments: Iterable[str]) -> str:
    """A message of jsonargparse about a value, in one line that says what is allowed; any other message as it is.

    Args:
        message: The message, which shows Python's types and each attempt to read the value as one of them. The parser
            of a nested class knows only the last part of the option.
        classes: Names of classes that may have been meant.
        arguments: Options with their values, to find the whole option among.
    """
    key = re.match(r'Parser key "([^"]+)":', message)
    value = re.search(r"(?:Given|Got) value: (.*)\Z", message, re.S) or re.search(r"path string: (.*)", message)
    if key is None or value is None:
        return message
    options = (argument.partition("=") for argument in arguments if not argument.startswith(BUDGET))
    whole = (option[2:] for option, _, given in options if option.endswith(f".{key[1]}") and given == value[1])
    name = next(whole, key[1])
    meant = nearest(value[1].rpartition(".")[2], classes)
    causes = r"(?:Problem with given class_path|Invalid content in sub-config file).*?(?=\n +- |\Z)"
    problem = re.search(causes, message, re.S)
    if problem is not None:
        return f"{name}: {' '.join(problem[0].split())}{meant}"
    types = re.search(r"Subtypes: .*", message) or re.search(r"Expected a .*", message)
    allowed: list[str] = []
    kinds = r"Literal\[(.*?)\]|(?:<class '(?:[\w.]*\.)?|Annotated\[)(\w+)"
    for literal, kind in re.findall(kinds, types[0] if types else ""):
        allowed += [each.strip("'") for each in literal.split(", ")] if literal else [WORDS.get(kind, kind)]
    *others, last = dict.fromkeys(allowed or ["the name of a class"])
    return f"{name}: expected {', '.join(others)}{' or ' * bool(others)}{last}, got {value[1]!r}{meant}"


class Parser(argparse.ArgumentParser):
    """:class:`argparse.ArgumentParser` that names the option that a misspelt one resembles."""

    def error(self, message: str) -> NoReturn:
        """Write usage and message to stderr and exit with status 2."""
        super().error(message + unknown_option(message, self._option_string_actions))


CONFIG = "--config="
# Of a config, and of its values with every alias written out; that of a run has 6 kB and 500 values.
_MOST_BYTES, _MOST_VALUES = 1 << 17, 100_000


def configs_among(arguments: Iterable[str]) -> list[str]:
    """The values of ``--config`` among joined arguments."""
    return [argument.removeprefix(CONFIG) for argument in arguments if argument.startswith(CONFIG)]


def settings_of(configs: Iterable[str]) -> Iterator[str]:
    """What configs set, each value as the option ``--a.b=value``.

    Raises:
        ValueError: One cannot be read, see :func:`check_config`.
    """

    def options(settings: dict[str, Any], prefix: str) -> Iterator[str]:
        for name, value in settings.items():
            if isinstance(value, dict):
                yield from options(value, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}={value}"

    for config in configs:
        yield from options(check_config(config), "--")


def check_config(path: str) -> dict[str, Any]:
    """Settings of a config, none where the name is not that of a file, which the parser reports.

    Raises:
        ValueError: It is not text, not YAML, too large, or not a table of settings.
    """
    import yaml

    if not Path(path).is_file():
        return {}
    if (size := Path(path).stat().st_size) > _MOST_BYTES:
        raise ValueError(f"config {path} has {size} bytes, more than {_MOST_BYTES}: give another file")
    try:
        # Not the parser's loader: what is nested too deep would overflow its stack.
        settings = yaml.load(Path(path).read_text(encoding="utf-8"), _limited(type("Loader", (yaml.SafeLoader,), {})))
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"config {path} is not YAML ({' '.join(str(error).split())}): correct the file") from error
    if not isinstance(settings, dict):
        found = "nothing" if settings is None else type(settings).__name__
        raise ValueError(f"config {path} holds {found}: give settings by name, like 'trainer: {{max_steps: 1000}}'")
    return settings


@cache  # otherwise, each call would wrap the loader once more
def limit_aliases() -> None:
    """Let the parser refuse what aliases make too large, in files that a config names and in its texts, too."""
    from jsonargparse._loaders_dumpers import get_yaml_default_loader  # all of its ways to read YAML use this class

    _limited(get_yaml_default_loader())  # type: ignore[no-untyped-call]


def _limited(loader: Any) -> Any:
    """A loader of YAML, which from now on refuses more values than a config has."""
    import yaml

    compose = loader.get_single_node

    def checked(self: object) -> "Node | None":
        node: Node | None = compose(self)
        if _values(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f"more than {_MOST_VALUES} values by aliases (*name)")
        return node

    loader.get_single_node = checked
    return loader


def _values(node: "Node | None", known: dict[int, float]) -> float:
    """Number of values in a node of YAML with all its aliases written out; infinite for one that holds itself."""
    if node is None:
        return 0
    if id(node) not in known:
        known[id(node)] = math.inf
        pairs = node.id == "mapping"
        parts = chain.from_iterable(node.value) if pairs else node.value if node.id == "sequence" else ()
        known[id(node)] = 1 + sum(_values(part, known) for part in parts)
    return known[id(node)]


def find_config(name: str) -> str:
    """Path of a config: a given file, otherwise one shipped with the package (``paper``, ``configs/paper.yaml``).

    A name that is neither is returned unchanged, for the parser to report.
    """
    plain = Path(name).as_posix().removeprefix("configs/")
    shipped = folder_of("configs") / plain, folder_of("configs") / f"{plain}.yaml"
    return next((str(path) for path in (Path(name), *shipped) if path.is_file()), name)


def shipped_configs() -> list[str]:
    """Names of the configs that come with the package, without their suffix."""
    return sorted(path.stem for path in folder_of("configs").glob("*.yaml"))


def scene_file(path: Path) -> Path:
    """The scene file that is meant.

    Raises:
        FileNotFoundError: There is nothing of that name.
        ValueError: It is a folder without ``scene.nsvq``, or a checkpoint.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no file or folder {path}")
    if path.is_dir():
        file = path / "scene.nsvq"
        if not file.is_file():
            newest = "".join(f", such as {each.parent}" for each in sorted(path.glob("version_*/scene.nsvq"))[-1:])
            raise ValueError(f"{path} holds no scene.nsvq: name a scene file, or the folder of a finished run{newest}")
        return file
    if path.suffix == ".ckpt":
        raise ValueError(f"{path} is a checkpoint; 'nsvq export --ckpt_path {path}' writes its scene as a file")
    return path


def photos_of(path: Path) -> Path | None:
    """Folder of the photos that a scene was trained on, as the run that it lies in says; None if nothing says it.

    Raises:
        ValueError: Beside it is a ``config.yaml`` that is no table of settings.
    """
    config = (path if path.is_dir() else path.parent) / "config.yaml"
    root = _values_by_name(settings_of([str(config)])).get("data.root")
    return Path(root).expanduser() if root and Path(root).expanduser().is_dir() else None


def cameras_of(path: Path, root: Path | None) -> "dict[str, Camera]":
    """Cameras by name of the photos that a scene was trained on; where these are gone, what its run has recorded.

    A run of INRIA's trainer has recorded them in ``cameras.json`` beside the file or one or two folders above it.

    Args:
        path: A scene file, or the folder of a run; without a run, there are none.
        root: Scene folder whose cameras they are instead.

    Raises:
        SceneError: The folder is not a scene.
        ValueError: ``viewer.html`` or ``cameras.json`` of the run is damaged.
    """
    from nsvq_lightning.data.scene import load_scene
    from nsvq_lightning.rendering.camera_paths import CAMERAS, read_cameras
    from nsvq_lightning.report.viewer import page_cameras

    root = root or photos_of(path)
    if root is not None:
        scene = load_scene(root)
        return dict(zip(scene.names, scene.cameras, strict=True))
    folder = (path if path.is_dir() else path.parent).resolve()
    if (folder / "viewer.html").is_file():
        return page_cameras(folder / "viewer.html")
    lists = (place / CAMERAS for place in [folder, *folder.parents][:3])
    found = next((each for each in lists if each.is_file()), None)
    return read_cameras(found) if found else {}


def views_of(path: Path, splats: "SplatTensors", most: int, root: Path | None) -> "tuple[list[Camera], Scene | None]":
    """At most ``most`` views of a scene file in which its pictures count, and its photos if they are known.

    Args:
        path: The file. In the folder of a run, they are those of its train photos, or what the run has recorded.
        splats: Raw attributes of N > 0 splats; without a run, views are those from where they show detail.
        most: Number of views.
        root: Scene folder whose train photos they are instead.

    Raises:
        SceneError: The folder is not a scene.
    """
    from nsvq_lightning.compression.viewpoints import likely_cameras
    from nsvq_lightning.data.scene import load_scene

    root = root or photos_of(path)
    if root is not None:
        scene = load_scene(root)
        return [scene.cameras[index] for index in scene.some_train(most)], scene
    recorded = list(cameras_of(path, None).values())
    # A square picture with the pixels of a photo: what a wide one shows at its edges, photos seldom do.
    return recorded[:: -(-len(recorded) // most) or 1] or likely_cameras(splats, most, 640, 640, degrees=50), None
