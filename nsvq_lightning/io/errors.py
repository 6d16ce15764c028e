"""The error that all file formats share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, fspath

__all__ = ["FormatError", "naming_file"]


class FormatError(ValueError):
    """A file is truncated, altered, or not of the format it was opened as; the message names file, defect and remedy.

    Args:
        defect: What is wrong, and where.
        remedy: What to do about it.
    """

    def __init__(self, defect: str, remedy: str = "copy the file again or export it anew") -> None:
        super().__init__(defect, remedy)
        self.defect, self.remedy = defect, remedy

    def __str__(self) -> str:
        return f"{self.defect}; {self.remedy}"


@contextmanager
def naming_file(path: str | PathLike[str]) -> Iterator[None]:
    """Prefix every :class:`FormatError` of the block with the file's name, so that parsers need not know it."""
    try:
        yield
    except FormatError as error:
        raise FormatError(f"{fspath(path)}: {error.defect}", error.remedy) from None
