"""The error that all file formats share, and what the bytes of a file can hold.

A count in a file's head is a claim, and no reader allocates memory on its word alone. Streams and pictures of equal
numbers shrink to nothing: a few kilobytes would otherwise ask for all memory there is. In scenes, the position alone
takes 16 bits or more of a splat, and a whole splat 5 bytes or more in every format.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from nsvq_lightning.io.atomic import StrPath


class FormatError(ValueError):
    """A file is truncated, altered, or not of the format it was opened as; the message names file, defect and remedy.

    Args:
        defect: What is wrong, and where.
        remedy: What to do about it; by default, copy a file again that is damaged or truncated, and no other.
    """

    def __init__(self, defect: str, remedy: str = "") -> None:
        if not remedy:
            harmed = defect.startswith(("damaged", "truncated"))
            remedy = "copy the file again or export it anew" if harmed else "export it anew, see docs/formats.md"
        super().__init__(defect, remedy)
        self.defect, self.remedy = defect, remedy

    def __str__(self) -> str:
        return f"{self.defect}; {self.remedy}"


@contextmanager
def naming_file(path: StrPath) -> Iterator[None]:
    """Prefix every :class:`FormatError` of the block with the file's name, so that parsers need not know it."""
    try:
        yield
    except FormatError as error:
        raise FormatError(f"{path}: {error.defect}", error.remedy) from None


# How a file begins that Git LFS has not fetched, and what is wrong with it where the format is not known.
LFS = b"version https://git-lfs"
POINTER = "a pointer of Git LFS, not the file itself: get it by 'git lfs pull'"


def wrong_start(suffix: str, data: bytes, magic: bytes) -> FormatError:
    """The error of a file that does not start as its format does, or ends before it does."""
    if data.startswith(LFS):
        return FormatError(f"a pointer of Git LFS, not the {suffix} file itself", "get it by 'git lfs pull'")
    cut = "truncated, or " if magic.startswith(data[: len(magic)]) else ""
    return FormatError(f"{cut}not a {suffix} file: it does not start with {magic.decode('latin-1')!r}")


def check_start(suffix: str, data: bytes, magic: bytes, least: int = 0) -> None:
    """Refuse a file that does not start as its format does, or has fewer bytes than the ``least`` of all."""
    if len(data) < least or not data.startswith(magic):
        raise wrong_start(suffix, data, magic)


# An object of JSON.
Json = dict[str, Any]
# What reading one raises that holds something else than it should.
STRANGE = ValueError, TypeError, LookupError, AttributeError, RecursionError
# A file, or a part of one.
Bytes = bytes | memoryview


@contextmanager
def as_defect(
    defect: str, kinds: type[Exception] | tuple[type[Exception], ...] = STRANGE, remedy: str = ""
) -> Iterator[None]:
    """Raise a :class:`FormatError` where the block raises one of these kinds, with the reason behind the defect."""
    try:
        yield
    except FormatError:  # a ValueError, too, which has said what is wrong
        raise
    except kinds as error:
        reason = repr(error) if isinstance(error, LookupError) else str(error)
        raise FormatError(f"{defect} ({reason})", remedy) from None


def json_object(text: bytes, name: str) -> Json:
    """The object that a file, or a part of one of this name, holds as JSON.

    Raises:
        FormatError: It holds something else.
    """
    with as_defect(f"damaged: {name} is not JSON"):
        found = json.loads(text.decode(), parse_constant=_no_number)
    if not isinstance(found, dict):
        raise FormatError(f"damaged: {name} is not a JSON object")
    return found


def _no_number(name: str) -> None:
    raise ValueError(f"it holds {name}, which JSON does not have")


# Splats that any file may hold, however short, such as one of equal splats; beyond, each takes two bytes or more. A
# file below 1 MB is then read in half a gigabyte of memory and a few seconds.
FEW_SPLATS = 1 << 18
# The same for the rows of a codebook in level ``compact`` of ``.nsvq``, and the bytes of its stream.
FEW_ROWS = 1 << 16


def check_room(what: str, count: int, size: int, few: int = FEW_SPLATS, each: int = 2) -> None:
    """Refuse more splats, texels or rows than a file or stream of ``size`` bytes can hold.

    Raises:
        FormatError: There are more than ``few``, and not ``each`` bytes for each.
    """
    if count > max(few, size // each):
        raise FormatError(
            f"truncated or damaged: {count} {what} cannot be in {size} bytes; above {few}, each takes {each} or more"
        )
