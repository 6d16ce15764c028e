"""Tables as files and as text."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.io.atomic import write_text

__all__ = ["markdown_table", "write_csv"]


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the same keys as CSV, atomically; the keys of the first, in their order, are the head."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[str]) -> str:
    """A Markdown table that also reads well as plain text; the columns named in ``words`` stand left, numbers right."""
    lines = [list(head), *map(list, rows)]
    widths = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    left = [name in words for name in head]
    rule = ["-" * width if word else "-" * (width - 1) + ":" for word, width in zip(left, widths, strict=True)]
    padded = [
        [cell.ljust(width) if word else cell.rjust(width) for word, cell, width in zip(left, line, widths, strict=True)]
        for line in lines
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in [padded[0], rule, *padded[1:]])
