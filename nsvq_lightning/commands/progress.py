"""Progress of a command's work: a bar on a terminal, a few plain lines in a file."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

__all__ = ["progress"]

LINES = 10
"""Lines at most if the output is not a terminal."""

_T = TypeVar("_T")


def progress(items: Sequence[_T], what: str) -> Iterator[_T]:
    """Go through items and say on stderr how many are done and how long the rest will take.

    Args:
        items: What is worked on, one after another.
        what: Their name in the plural.
    """
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(
            items,
            unit=f" {what}",
            bar_format="{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}{unit} {elapsed}<{remaining}",
        )
        return
    began, told = time.monotonic(), 0
    for done, item in enumerate(items, 1):
        yield item
        share = done * LINES // len(items)
        if share > told:
            told, passed = share, time.monotonic() - began
            left = passed * (len(items) - done) / done
            sys.stderr.write(f"{done} of {len(items)} {what}, {passed:.0f} s elapsed, {left:.0f} s left\n")
            sys.stderr.flush()
