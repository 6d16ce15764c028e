"""``nsvq info FILE``: describe a scene file without importing torch."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.arguments import Parser
from nsvq_lightning.io.describe import describe
from nsvq_lightning.io.errors import FormatError

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the description of one file.

    Args:
        argv: Arguments after ``nsvq info``; those of the process if None.

    Returns:
        0, or 1 after a one-line error if the file cannot be read.
    """
    parser = Parser(prog="nsvq info", description="Describe a scene file: .nsvq, .ply, .sog, .spz or .splat.")
    parser.add_argument("file", type=Path, metavar="FILE", help="scene file")
    parser.add_argument("--json", action="store_true", help="print the description as JSON")
    options = parser.parse_args(argv)
    try:
        description = describe(options.file)
    except FormatError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(f"{options.file}: {error.strerror or error}")
    text = json.dumps(description, indent=2, ensure_ascii=False) if options.json else _text(description)
    sys.stdout.write(text + "\n")
    return 0


def _fail(message: str) -> int:
    sys.stderr.write(f"nsvq info: {message}\n")
    return 1


def _text(facts: dict[str, Any]) -> str:
    size = facts["bytes"]
    whole = max(1, size)
    rows = [
        ("file", facts["file"]),
        ("format", facts["format"]),
        ("splats", f"{facts['splats']:,}"),
        ("SH degree", str(facts["sh_degree"])),
        ("bytes", f"{size:,} ({size / 1e6:.2f} MB, {size / 2**20:.2f} MiB)"),
        ("plain .ply", f"{facts['plain_bytes']:,} bytes, {facts['ratio']:.2f} times this file"),
    ]
    if any(facts.get("origin", ())):
        rows.append(("origin", ", ".join(map(repr, facts["origin"]))))
    parts = ["\n".join(f"{name:<11} {value}" for name, value in rows)]
    if "attributes" in facts:
        entries = ((a["name"], a["storage"], a["dim"], a["codes"], a["bits"]) for a in facts["attributes"])
        parts.append(_table(("attribute", "storage", "D", "K", "bits"), entries))
    splats = max(1, facts["splats"])
    shares = (
        (s["name"], s["encoding"], s["bytes"], f"{8 * s['bytes'] / splats:.2f}", f"{100 * s['bytes'] / whole:.1f} %")
        for s in facts["streams"]
    )
    parts.append(_table(("stream", "encoding", "bytes", "bits per splat", "share"), shares))
    parts += [f"{key}\n{_indented(facts[key])}" for key in ("metrics", "config") if facts.get(key)]
    return "\n\n".join(parts)


def _table(head: tuple[str, ...], rows: Iterable[tuple[str | int, ...]]) -> str:
    """A table of two columns of words, then columns of numbers; 0 is shown as a dash."""
    lines = [head, *(tuple(_cell(value) for value in row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _cell(value: str | int) -> str:
    return value if isinstance(value, str) else f"{value:,}" if value else "-"


def _indented(value: object) -> str:
    text = json.dumps(value, indent=2, ensure_ascii=False)
    # Drop the outer braces; the lines between them are already indented by two.
    return "\n".join(text.splitlines()[1:-1])
