"""What is said of wrong arguments: in plain words, and with the nearest that exists. Light: no heavy imports."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import NoReturn

__all__ = ["Parser", "in_plain_words", "nearest", "unknown_option"]

WORDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "text", "NoneType": "null"}
"""Types as users call them; others by their name."""


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


def in_plain_words(message: str, classes: Iterable[str]) -> str:
    """A message of jsonargparse about a value, in one line that says what is allowed; any other message as it is.

    Args:
        message: The message, which shows Python's types and each attempt to read the value as one of them.
        classes: Names of classes that may have been meant.
    """
    key = re.match(r'Parser key "([^"]+)":', message)
    value = re.search(r"(?:Given|Got) value: (.*)\Z", message, re.S) or re.search(r"path string: (.*)", message)
    if key is None or value is None:
        return message
    meant = nearest(value[1].rpartition(".")[2], classes)
    problem = re.search(r"Problem with given class_path.*?(?=\n +- |\Z)", message, re.S)
    if problem is not None:
        return f"{key[1]}: {' '.join(problem[0].split())}{meant}"
    types = re.search(r"Subtypes: .*", message) or re.search(r"Expected a .*", message)
    allowed: list[str] = []
    for literal, kind in re.findall(r"Literal\[(.*?)\]|<class '(?:[\w.]*\.)?(\w+)'>", types[0] if types else ""):
        allowed += [each.strip("'") for each in literal.split(", ")] if literal else [WORDS.get(kind, kind)]
    *others, last = dict.fromkeys(allowed or ["the name of a class"])
    return f"{key[1]}: expected {', '.join(others)}{' or ' * bool(others)}{last}, got {value[1]!r}{meant}"


class Parser(argparse.ArgumentParser):
    """:class:`argparse.ArgumentParser` that names the option that a misspelt one resembles."""

    def error(self, message: str) -> NoReturn:
        """Write usage and message to stderr and exit with status 2."""
        super().error(message + unknown_option(message, self._option_string_actions))
