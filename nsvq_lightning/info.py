"""``nsvq info FILE``: what a scene file holds, said without importing torch."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nsvq_lightning.io.container import read_header
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.frame import MAGIC
from nsvq_lightning.io.ply import plain_ply_bytes, read_ply_size
from nsvq_lightning.io.ply_header import PLY_MAGIC, attribute_of

__all__ = ["describe", "main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the description of one file.

    Args:
        argv: Arguments after ``nsvq info``; those of the process if None.

    Returns:
        0, or 1 after a one-line error if the file cannot be read.
    """
    parser = argparse.ArgumentParser(prog="nsvq info", description="Say what a .nsvq or .ply file holds.")
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


def describe(path: Path) -> dict[str, Any]:
    """Facts about a file, as JSON values.

    Raises:
        FormatError: The file is damaged, or neither ``.nsvq`` nor ``.ply`` of Gaussian splats.
        OSError: It cannot be read.
    """
    with open(path, "rb") as file:
        start = file.read(len(MAGIC))
    if start == MAGIC:
        facts = _describe_nsvq(path)
    elif start.startswith(PLY_MAGIC):
        facts = _describe_ply(path)
    else:
        raise FormatError(f"{path}: neither a .nsvq nor a .ply file", "give the file of a scene")
    facts["plain_bytes"] = plain_ply_bytes(facts["splats"], facts["sh_degree"])
    facts["ratio"] = facts["plain_bytes"] / facts["bytes"]
    return {"file": str(path), **facts}


def _describe_nsvq(path: Path) -> dict[str, Any]:
    header, total = read_header(path), path.stat().st_size
    streams = [{"name": s.name, "encoding": s.encoding, "bytes": s.length} for s in header.streams]
    header_bytes = total - sum(stream.length for stream in header.streams)
    return {
        "format": f"nsvq, level {header.level}",
        "splats": header.splats,
        "sh_degree": header.sh_degree,
        "origin": list(header.origin),
        "bytes": total,
        "attributes": [asdict(entry) for entry in header.attributes],
        "streams": [{"name": "header", "encoding": "json", "bytes": header_bytes}, *streams],
        "config": header.config,
        "metrics": header.metrics,
    }


def _describe_ply(path: Path) -> dict[str, Any]:
    header, total = read_ply_size(path)
    sizes: dict[str, int] = {}
    for name in header.properties:
        attribute = attribute_of(name)
        sizes[attribute] = sizes.get(attribute, 0) + header.count * header.dtype[name].itemsize
    # The lengths of ascii numbers differ, so only the whole is known.
    streams = {"header": header.offset, **sizes} if header.encoding != "ascii" else {"text": total}
    return {
        "format": f"ply, {header.encoding}",
        "splats": header.count,
        "sh_degree": header.sh_degree,
        "bytes": total,
        "streams": [{"name": name, "encoding": "ply", "bytes": size} for name, size in streams.items()],
    }


def _text(facts: dict[str, Any]) -> str:
    size = facts["bytes"]
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
    shares = ((s["name"], s["encoding"], s["bytes"], f"{100 * s['bytes'] / size:.1f} %") for s in facts["streams"])
    parts.append(_table(("stream", "encoding", "bytes", "share"), shares))
    parts += [f"{key}\n{_indented(facts[key])}" for key in ("metrics", "config") if facts.get(key)]
    return "\n\n".join(parts)


def _table(head: tuple[str, ...], rows: Iterable[tuple[str | int, ...]]) -> str:
    """Two columns of words, then columns of numbers; 0 is shown as a dash."""
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
    # The outer braces carry nothing; the lines between them are indented by two already.
    return "\n".join(text.splitlines()[1:-1])
