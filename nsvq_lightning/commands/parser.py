"""The parser of Lightning's commands: help with every option once, and errors in one line of plain words."""

import json
import re
import shutil
import sys
from argparse import SUPPRESS
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from pkgutil import resolve_name
from textwrap import wrap
from typing import Any, ClassVar, NamedTuple, NoReturn

from jsonargparse import Namespace
from jsonargparse import _typehints as typehints
from jsonargparse._parameter_resolvers import get_signature_parameters
from lightning.pytorch.cli import LightningArgumentParser

from nsvq_lightning import callbacks, quantize
from nsvq_lightning.commands import COMMANDS, nearest
from nsvq_lightning.commands.arguments import unknown_option
from nsvq_lightning.commands.settings import BUDGET, SHORTHANDS
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.version import check_replaced


class QuietParser(LightningArgumentParser):
    """Reports errors without the usage, which has about a hundred lines, and lists options without their classes.

    Attributes:
        arguments: The command line, and what its configs set, as options.
    """

    arguments: ClassVar[Sequence[str]] = ()

    def format_help(self, *args: Any) -> str:
        """Help of a command, see :func:`command_help`."""
        subcommand = self.prog.rpartition(" ")[2]
        return command_help(self, subcommand) if subcommand in COMMANDS else super().format_help(*args)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Write the message to stderr and exit with status 2."""
        program = f"nsvq {next(iter(self.arguments), 'COMMAND')}"
        if message.endswith("required: root"):
            message += " (--data.root=path/to/scene)"
        elif message.startswith('Parser key "data":') and Path(message.rpartition("Given value: ")[2]).is_dir():
            message = "--data takes the name of a data module; the folder of a scene is --data.root=path/to/scene"
        else:
            message = in_plain_words(message, self.arguments)
            parsers = getattr(self._subcommands_action, "_name_parser_map", {"": self}).values()
            message += unknown_option(message, [name for parser in parsers for name in parser._option_string_actions])
        sys.stderr.write(f"error: {message}\nAll options: {program} --help\n")
        self.exit(2)


def _drop_settings_of_another_class(_: Any, before: Any, value: Any) -> None:
    """Where an option names another class, keep only what was set for the one before that it is derived from.

    jsonargparse keeps all settings of the same name: the paper's threshold would become one of BudgetedGrowth.
    """
    if before and "init_args" in before and before["class_path"] != value["class_path"]:
        old = resolve_name(before["class_path"])
        new = resolve_name(value["class_path"])
        derived = isinstance(old, type) and isinstance(new, type) and issubclass(new, old)
        defaults = {each.name: each.default for each in get_signature_parameters(old)}  # also those behind **settings
        for name, setting in list(before.init_args.items(branches=True, nested=False)):
            if not derived or setting in (None, defaults[name]):
                before.init_args.pop(name)


check_replaced("jsonargparse", typehints, "discard_init_args_on_class_path_change")
typehints.discard_init_args_on_class_path_change = _drop_settings_of_another_class

# What the parser says of types that do not fit; what a class has said of its settings is the cause, and comes first.
_UNFIT = "Not a valid subclass", "Import path", "Expected a"
check_replaced("jsonargparse", typehints, "raise_union_unexpected_value")
_raise = typehints.raise_union_unexpected_value
typehints.raise_union_unexpected_value = lambda subtypes, val, exceptions: _raise(
    subtypes, val, sorted(exceptions, key=lambda error: str(error).startswith(_UNFIT))
)


# Names that options take as they are: short class names resolve to what is imported.
CLASSES = (*callbacks.__all__, *quantize.__all__, "ColmapDataModule", "DemoDataModule")
# Types as users call them; others by their name.
WORDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "text", "NoneType": "null"}


def in_plain_words(message: str, arguments: Iterable[str]) -> str:
    """A message of jsonargparse about a value, in one line that says what is allowed; any other message as it is.

    Args:
        message: The message, which shows Python's types and each attempt to read the value as one of them. The parser
            of a nested class knows only the last part of the option.
        arguments: Options with their values, to find the whole option among.
    """
    key = re.match(r'Parser key "([^"]+)":', message)
    value = re.search(r".*(?:Given|Got) value: (.*)\Z", message, re.S) or re.search(r"path string: (.*)", message)
    if key is None or value is None:
        return message
    name = key[1]
    for argument in arguments:
        option, _, given = argument.removeprefix("--").partition("=")
        if option.endswith(f".{key[1]}") and given == value[1] and not argument.startswith(BUDGET):
            name = option
            break
    meant = nearest(value[1].rpartition(".")[2], CLASSES)
    causes = r"(?:Problem with given class_path|Invalid content in sub-config file).*?(?=\n +- |\Z)"
    if problem := re.search(causes, message, re.S):
        return f"{name}: {' '.join(problem[0].split())}{meant}"
    types = re.search(r"Subtypes: .*", message) or re.search(r"Expected a .*", message)
    kinds = r"Literal\[(.*?)\]|(?:<class '(?:[\w.]*\.)?|Annotated\[|\b(?=dict\[))(\w+)"
    allowed = []
    for literal, kind in re.findall(kinds, types[0] if types else ""):
        if literal:
            allowed += [each.strip("'") for each in literal.split(", ")]
        else:
            allowed.append(WORDS.get(kind, kind))
    *others, last = dict.fromkeys(allowed or ["the name of a class"])
    expected = f"{', '.join(others)} or {last}" if others else last
    return f"{name}: expected {expected}, got {value[1]!r}{meant}"


class Option(NamedTuple):
    """An option of the command line.

    Attributes:
        name: Without dashes.
        default: ``=default`` as one would type it; empty if there is none.
        text: What it does, in one sentence.
    """

    name: str
    default: str
    text: str


# Options of the trainer that the help explains; the others are Lightning's, and are listed.
EXPLAINED = ("run_folder", "allow_other_scene", "max_steps", "accelerator", "devices", "logger", "callbacks")


def command_help(parser: LightningArgumentParser, command: str) -> str:
    """Help text of a command: every option once, with its default and a one-sentence description.

    The parser's own help lists all classes that any option might take, even those of torch, but none of the options of
    the default callbacks.

    Args:
        parser: Its parser, with options named ``group.name``.
        command: Its name.
    """
    groups: dict[str, list[Option]] = {name: [] for name in ("run", "callbacks", "model", "trainer")}
    for option in _options(parser):
        group = option.name.partition(".")[0] if "." in option.name else "run"
        if group in groups and option.name not in (*groups, "model.splats"):
            groups[group].append(option)
    explained = [option for option in groups["trainer"] if option.name.removeprefix("trainer.") in EXPLAINED]
    others = [f"--{option.name}{option.default}" for option in groups["trainer"] if option not in explained]
    parts = [
        f"usage: nsvq {command} [--config NAME] [--OPTION=VALUE ...]\n\n{parser.description}\n",
        _section("run", groups["run"]),
    ]
    if command == "fit":
        parts.append(_section("budget", [Option(name, "", text) for name, text in SHORTHANDS.items()]))
    if command != "export":
        parts.append(class_help("data", ColmapDataModule))
    parts += [
        _section("callbacks", groups["callbacks"], "Their options: --callbacks.density.help; null leaves one out."),
        _section("model", groups["model"]),
        _section("trainer", explained),
        *_wrapped(f"Lightning's own: {' '.join(others)}", "  "),
        "\n--model.quantizer.help=CLASS lists the options of a quantizer; another class for a callback is\n"
        "--callbacks.density=my_package.Class.\n",
    ]
    return "\n".join(parts)


def class_help(prefix: str, kind: type) -> str:
    """Help text for the options of a class, all named ``prefix.…``."""
    parser = LightningArgumentParser(add_help=False)
    parser.add_class_arguments(kind, prefix)
    options = [option for option in _options(parser) if option.name.startswith(f"{prefix}.")]
    return _section(prefix, options, f"{first_sentence(kind.__doc__)}.")


def _options(parser: LightningArgumentParser) -> Iterator[Option]:
    """The options of a parser, with the defaults of its default config."""
    defaults = parser.get_defaults()
    for action in parser._actions:
        name = (action.option_strings or [""])[-1].lstrip("-").removesuffix("+")
        if name and not name.endswith(".help"):
            required = action.default == SUPPRESS or action.required
            yield Option(name, "" if required else _default(defaults.get(action.dest)), first_sentence(action.help))


def _default(value: Any) -> str:
    """``=default`` as one would type it; empty if it cannot be typed."""
    if isinstance(value, Namespace) and "class_path" in value:
        return f"={value.class_path.rpartition('.')[2]}"
    if isinstance(value, tuple | list):
        return f"=[{','.join(map(str, value))}]"
    if value is None or isinstance(value, bool):
        return f"={json.dumps(value)}"
    return f"={value}" if isinstance(value, int | float | str) else ""


def first_sentence(text: str | None) -> str:
    """The first sentence of a docstring or help text, in plain words."""
    plain = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text or "").replace("``", "")
    plain = re.sub(r"\s+", " ", plain.replace("%%", "%")).strip()
    return re.split(r"(?<=[a-z0-9)\]]{2}[.:]) (?=[A-Z*])", plain)[0].rstrip(".:")


def _section(title: str, options: Iterable[Option], introduction: str = "") -> str:
    """A section of the help: the title, and for each option a line with its default, and its text below."""
    lines = [f"{title}:", *_wrapped(introduction, "  ")]
    for option in options:
        lines.append(f"  --{option.name}{option.default}")
        lines += _wrapped(option.text, " " * 8)
    return "\n".join(lines) + "\n"


# Largest width in columns to which text is wrapped, even on a wider terminal.
MAX_WIDTH = 100


def _wrapped(text: str, indent: str) -> list[str]:
    width = min(shutil.get_terminal_size().columns, MAX_WIDTH)
    return wrap(text, width, initial_indent=indent, subsequent_indent=indent)
