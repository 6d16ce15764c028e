"""What ``nsvq fit --help`` prints: every option once, with its default and a one-sentence description.

The parser's own help lists all classes that any option might take, even those of torch, but none of the options of the
default callbacks.
"""

import inspect
import re
import shutil
import textwrap
from argparse import SUPPRESS, ArgumentParser
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple

import docstring_parser
from jsonargparse import Namespace

from nsvq_lightning.commands.arguments import SHORTHANDS


class Option(NamedTuple):
    """An option of the command line."""

    name: str
    default: Any
    text: str


def command_help(parser: ArgumentParser, command: str, data: type | None, own_trainer: Collection[str]) -> str:
    """Help text of a command.

    Args:
        parser: Its parser, with options named ``group.name``.
        command: Its name.
        data: Class whose constructor arguments are also options, ``data.…``, if it reads photos.
        own_trainer: Options of the trainer that are explained; the others are Lightning's, and are listed.
    """
    groups: dict[str, list[Option]] = {"run": [], "callbacks": [], "model": [], "skips": [], "trainer": []}
    defaults = parser.get_defaults()  # type: ignore[attr-defined]  # jsonargparse's, with those of the default config
    for action in parser._actions:
        name = (action.option_strings or [""])[-1].lstrip("-").removesuffix("+")
        group = name.partition(".")[0] if "." in name else "run"
        if name and group in groups and name not in groups and not name.endswith((".help", "model.splats")):
            default = inspect.Parameter.empty if action.default == SUPPRESS else defaults.get(action.dest)
            groups[group].append(Option(name, default, first_sentence(action.help)))
    budget = [Option(name, inspect.Parameter.empty, text) for name, text in SHORTHANDS.items()]
    explained = [option for option in groups["trainer"] if option.name.removeprefix("trainer.") in own_trainer]
    others = " ".join(f"--{each.name}{_default(each.default)}" for each in groups["trainer"] if each not in explained)
    return "\n".join(
        [
            f"usage: nsvq {command} [--config NAME] [--OPTION=VALUE ...]\n\n{parser.description}\n",
            _section("run", groups["run"]),
            *([_section("budget", budget)] if command == "fit" else []),
            *([class_help("data", data)] if data is not None else []),
            _section("callbacks", groups["callbacks"], "Their options: --callbacks.density.help; null leaves one out."),
            _section("model", groups["model"]),
            _section("skips", groups["skips"]),
            _section("trainer", explained),
            *_wrapped(f"Lightning's own: {others}", "  "),
            "\n--model.quantizer.help=CLASS lists the options of a quantizer; another class for a callback is\n"
            "--callbacks.density=my_package.Class.\n",
        ]
    )


def class_help(prefix: str, kind: type) -> str:
    """Help text for the options of a class, all named ``prefix.…``."""
    return _section(prefix, _class_options(prefix, kind), f"{first_sentence(kind.__doc__)}.")


def first_sentence(text: str | None) -> str:
    """The first sentence of a docstring or help text, in plain words."""
    plain = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text or "").replace("``", "")
    plain = re.sub(r"\s+", " ", plain.replace("%%", "%")).strip()
    return re.split(r"(?<=[a-z0-9)\]]{2}[.:]) (?=[A-Z*])", plain)[0].rstrip(".:") if plain else ""


def _class_options(prefix: str, kind: type) -> Iterator[Option]:
    """The options of a class from its constructor and docstring, with dataclass arguments expanded in place.

    Args:
        prefix: Name in front, such as ``callbacks.density``.
        kind: The class.
    """
    texts = _texts(kind)
    for name, parameter in inspect.signature(kind).parameters.items():
        if is_dataclass(parameter.default):
            inner = _texts(type(parameter.default))
            for field in fields(parameter.default):
                value = getattr(parameter.default, field.name)
                yield Option(f"{prefix}.{name}.{field.name}", value, inner.get(field.name, ""))
        elif parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            yield Option(f"{prefix}.{name}", parameter.default, texts.get(name, ""))


def _section(title: str, options: Iterable[Option], introduction: str = "") -> str:
    """A section of the help: the title, and for each option a line with its default, and its text below."""
    lines = [f"{title}:", *_wrapped(introduction, "  ")]
    for option in options:
        lines.append(f"  --{option.name}{_default(option.default)}")
        lines += _wrapped(option.text, " " * 8)
    return "\n".join(lines) + "\n"


def _texts(kind: type) -> Mapping[str, str]:
    """First sentence for each argument or attribute by name, from the docstring."""
    found = docstring_parser.parse(inspect.getdoc(kind) or "", docstring_parser.DocstringStyle.GOOGLE).params
    return {each.arg_name.lstrip("*"): first_sentence(each.description) for each in found}


# Largest width in columns to which text is wrapped, even on a wider terminal.
WIDEST = 100


def _wrapped(text: str, indent: str) -> list[str]:
    width = min(shutil.get_terminal_size().columns, WIDEST)
    return textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent)


def _default(value: Any) -> str:
    """``=default`` as one would type it; empty if there is no default."""
    if value is inspect.Parameter.empty:
        return ""
    if value is None or isinstance(value, bool):
        return f"={'null' if value is None else str(value).lower()}"
    if isinstance(value, type):
        return f"={value.__name__}"
    if isinstance(value, Namespace) and "class_path" in value:
        return f"={value.class_path.rpartition('.')[2]}"
    if isinstance(value, tuple | list):
        return f"=[{','.join(map(str, value))}]"
    return f"={value}" if isinstance(value, int | float | str) else ""
