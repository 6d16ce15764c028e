"""Describe a scene file of any format; of .nsvq, also its attributes and streams."""

import json
from argparse import ArgumentParser, Namespace
from pathlib import Path

from nsvq_lightning.commands import markdown_table, say
from nsvq_lightning.commands.arguments import folders_beside
from nsvq_lightning.io.errors import Json
from nsvq_lightning.io.formats import describe


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq info`` takes."""
    parser.add_argument("file", type=Path, metavar="FILE", help="file of any format that convert reads")
    parser.add_argument("--json", action="store_true", help="print the description as JSON")


def run(options: Namespace) -> None:
    """Print the description of one file, without importing torch."""
    description = describe(options.file)
    say(json.dumps(description, indent=2, ensure_ascii=False) if options.json else _text(description))


# Columns of a table that hold words.
WORDS = ("attribute", "stream", "storage", "encoding")
# What may have the cameras of a scene file: of INRIA's trainer, of COLMAP or of nerfstudio.
CAMERA_FILES = ("cameras.json", "sparse", "transforms.json", "transforms_train.json")


def _text(facts: Json) -> str:
    size, splats = facts["bytes"], max(1, facts["splats"])
    rows = [
        ("file", facts["file"]),
        ("format", facts["format"]),
        ("splats", f"{facts['splats']:,}"),
        ("SH degree", str(facts["sh_degree"])),
        ("bytes", f"{size:,} ({size / 1e6:.2f} MB, {size / 2**20:.2f} MiB), {8 * size / splats:.2f} bits per splat"),
        ("plain .ply", f"{facts['plain_bytes']:,} bytes, {facts['ratio']:.2f} times this file"),
    ]
    if any(facts.get("origin", ())):
        rows.append(("origin", ", ".join(map(repr, facts["origin"]))))
    if facts.get("cameras"):
        rows.append(("cameras", f"{facts['cameras']} of training"))
    else:
        places = (folder / name for folder in folders_beside(Path(facts["file"])) for name in CAMERA_FILES)
        rows += [("cameras", f"not in the file, but maybe in {place}") for place in places if place.exists()][:1]
    parts = ["\n".join(f"{name:<11} {value}" for name, value in rows)]
    if "attributes" in facts:
        entries = []
        for entry in facts["attributes"]:
            counts = (f"{entry[name]:,}" if entry[name] else "-" for name in ("dim", "codes", "bits"))
            entries.append((entry["name"], entry["storage"], *counts))
        parts.append(markdown_table(("attribute", "storage", "D", "K", "bits"), entries, WORDS))
    if "streams" in facts:
        streams = []
        for stream in facts["streams"]:
            count = stream["bytes"]
            each = f"{count:,}", f"{8 * count / splats:.2f}", f"{100 * count / size:.1f} %"
            streams.append((stream["name"], stream["encoding"], *each))
        parts.append(markdown_table(("stream", "encoding", "bytes", "bits per splat", "share"), streams, WORDS))
    for key in ("metrics", "config"):
        if facts.get(key):
            # Without the outer braces; the lines between them are already indented by two.
            parts.append("\n".join([key, *json.dumps(facts[key], indent=2, ensure_ascii=False).splitlines()[1:-1]]))
    return "\n\n".join(parts)
