"""Options whose value is a number above 0, for argparse's ``type``."""

from __future__ import annotations

import argparse
from collections.abc import Callable

__all__ = ["positive"]


def positive(kind: type[int] | type[float]) -> Callable[[str], int | float]:
    """A function that reads a number of this kind.

    Raises:
        argparse.ArgumentTypeError: By the function: it is not above 0, or not finite.
    """

    def parse(text: str) -> int | float:
        value = kind(text)
        if not 0 < value < float("inf"):
            raise argparse.ArgumentTypeError(f"must be above 0, got {text}")
        return value

    parse.__name__ = kind.__name__  # argparse says "invalid float value"
    return parse
