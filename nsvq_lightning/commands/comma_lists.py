"""Options whose value is a list with commas between its entries, for argparse's ``type``."""

from __future__ import annotations

import argparse

__all__ = ["integers", "names"]


def names(text: str) -> tuple[str, ...]:
    """The entries of ``A,B``, each once."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def integers(text: str) -> tuple[int, ...]:
    """The numbers of ``1,2``, each once.

    Raises:
        argparse.ArgumentTypeError: An entry is not a whole number.
    """
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected whole numbers with commas between them, got {text!r}") from None
