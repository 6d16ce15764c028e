"""Progress of a command's work: a bar on a terminal, a few plain lines in a file."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

__all__ = ["Progress", "progress"]

LINES = 10
"""Lines at most if the output is not a terminal."""
BAR = "{desc}{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}{unit} {elapsed}<{remaining}"

_T = TypeVar("_T")


class Progress:
    """Says on stderr how much of something is done and how long the rest will take.

    Args:
        total: How much there is.
        before: Text in front.
        after: What is counted, in the plural.
    """

    def __init__(self, total: int, before: str = "", after: str = "") -> None:
        self._total, self._before, self._after = max(1, total), before, after
        self._began, self._told = time.monotonic(), 0
        self._bar: Any = None
        if sys.stderr.isatty():
            from tqdm import tqdm

            text = {"desc": f"{before} ", "unit": f" {after}"} if before else {"unit": f" {after}"}
            self._bar = tqdm(total=self._total, bar_format=BAR, **text)

    def show(self, done: int) -> None:
        """Say that this much is done; the last call has done everything."""
        if self._bar is not None:
            self._bar.n = done
            self._bar.refresh()
            if done >= self._total:
                self._bar.close()
            return
        share = done * LINES // self._total
        if share > self._told:
            self._told, passed = share, time.monotonic() - self._began
            left = passed * (self._total - done) / done
            front = f"{self._before}: " if self._before else ""
            what = f" {self._after}" if self._after else ""
            sys.stderr.write(f"{front}{done} of {self._total}{what}, {passed:.0f} s elapsed, {left:.0f} s left\n")
            sys.stderr.flush()


def progress(items: Sequence[_T], what: str) -> Iterator[_T]:
    """Go through items and say how many are done.

    Args:
        items: What is worked on, one after another.
        what: Their name in the plural.
    """
    shown = Progress(len(items), after=what)
    for done, item in enumerate(items, 1):
        yield item
        shown.show(done)
