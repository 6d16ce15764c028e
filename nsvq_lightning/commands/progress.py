"""Progress of a command's work: a bar on a terminal, a few plain lines in a file."""

import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

# Lines at most if the output is not a terminal.
LINES = 10

_T = TypeVar("_T")


class Progress:
    """Says on stderr how much of something is done and how long the rest will take.

    Args:
        total: How much there is.
        before: Text in front.
        after: What is counted, in the plural.
    """

    def __init__(self, total: int, before: str = "", after: str = "") -> None:
        self._total, self._before, self._after = max(1, total), before and f"{before}: ", after and f" {after}"
        self._began, self._told = time.monotonic(), 0
        self._bar: Any = None
        if sys.stderr.isatty():
            from tqdm import tqdm

            form = f"{self._before}{{percentage:3.0f}}%|{{bar}}| {{n}}/{{total}}{self._after} {{elapsed}}<{{remaining}}"
            self._bar = tqdm(total=self._total, bar_format=form)

    def show(self, done: int) -> None:
        """Say that this much is done; the last call has done everything."""
        if self._bar is not None:
            self._bar.n = done
            self._bar.refresh()
            if done >= self._total:
                self._bar.close()
        elif done * LINES // self._total > self._told:
            self._told, passed = done * LINES // self._total, time.monotonic() - self._began
            left = passed * (self._total - done) / done
            text = f"{self._before}{done} of {self._total}{self._after}, {passed:.0f} s elapsed, {left:.0f} s left"
            print(text, file=sys.stderr, flush=True)


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
