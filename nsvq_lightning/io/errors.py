"""The one error of all file formats."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, fspath

__all__ = ["FormatError", "naming_file"]


class FormatError(ValueError):
    """A file is truncated, altered, or not of the format it was opened as; the message names file and defect."""


@contextmanager
def naming_file(path: str | PathLike[str]) -> Iterator[None]:
    """Put the file's name in front of every :class:`FormatError` of the block, so that parsers need not know it."""
    try:
        yield
    except FormatError as error:
        raise FormatError(f"{fspath(path)}: {error}") from None
