"""What a scene file holds, found without decoding its splats."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.formats import FORMATS
from nsvq_lightning.io.nsvq.frame import MAGIC, read_header
from nsvq_lightning.io.ply import plain_ply_bytes, read_ply_size
from nsvq_lightning.io.ply_header import PLY_MAGIC, attribute_of, splat_degree
from nsvq_lightning.io.sog import read_sog_header
from nsvq_lightning.io.sog_archive import META, ZIP_MAGIC
from nsvq_lightning.io.splat import SPLAT_LAYOUT, count_splats
from nsvq_lightning.io.spz import DEFAULT_AXES
from nsvq_lightning.io.spz_frame import SPZ_MAGICS, read_spz_header

__all__ = ["describe"]


def describe(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Facts about a file, as JSON values; its first bytes name the format, except that ``.splat`` has none.

    Raises:
        FormatError: The file is damaged, or not in a format of :data:`~nsvq_lightning.io.formats.FORMATS`.
        OSError: It cannot be read.
    """
    path = Path(path)
    with open(path, "rb") as file:
        start = file.read(len(MAGIC))
    for magics, describer in _DESCRIBERS:
        if start.startswith(magics):
            facts = describer(path)
            break
    else:
        if path.suffix.lower() != ".splat":
            raise FormatError(f"{path}: not a {', '.join(FORMATS)} file", "give the file of a scene")
        facts = _describe_splat(path)
    facts["plain_bytes"] = plain_ply_bytes(facts["splats"], facts["sh_degree"])
    facts["ratio"] = facts["plain_bytes"] / max(1, facts["bytes"])  # an empty .splat has no bytes
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
        "attributes": [{**asdict(entry), "bits": entry.bits} for entry in header.attributes],
        "streams": [{"name": "header", "encoding": "json", "bytes": header_bytes}, *streams],
        "config": header.config,
        "metrics": header.metrics,
    }


def _describe_ply(path: Path) -> dict[str, Any]:
    header, total = read_ply_size(path)
    with naming_file(path):
        sh_degree = splat_degree(header)
    sizes: dict[str, int] = {}
    for table in [header, *(header.others[name] for name in ("sh",) if header.packed and name in header.others)]:
        for name in table.properties:
            attribute = attribute_of(name)
            sizes[attribute] = sizes.get(attribute, 0) + table.count * table.dtype[name].itemsize
    # The lengths of ascii numbers vary, so only the total is known.
    streams = {"header": total - sum(sizes.values()), **sizes} if header.encoding != "ascii" else {"text": total}
    name = "compressed" if header.packed else header.encoding
    return _facts(f"ply, {name}", header.count, sh_degree, total, streams, "ply")


def _describe_sog(path: Path) -> dict[str, Any]:
    count, sh_degree, sizes = read_sog_header(path)
    total = path.stat().st_size
    return _facts("sog, version 2", count, sh_degree, total, {**sizes, "zip": total - sum(sizes.values())}, "webp")


def _describe_spz(path: Path) -> dict[str, Any]:
    header, streams = read_spz_header(path)
    encoding = "zstd" if header.version == 4 else "gzip"
    total = path.stat().st_size
    axes = header.axes or f"not stated, taken as {DEFAULT_AXES.upper()}"
    return _facts(
        f"spz, version {header.version}, axes {axes}", header.count, header.sh_degree, total, streams, encoding
    )


def _describe_splat(path: Path) -> dict[str, Any]:
    count = count_splats(path)
    sizes = {name: count * size for name, size in SPLAT_LAYOUT.items()}
    return _facts("splat", count, 0, sum(sizes.values()), sizes, "splat")


def _facts(
    name: str, splats: int, sh_degree: int, total: int, streams: Mapping[str, int], encoding: str
) -> dict[str, Any]:
    return {
        "format": name,
        "splats": splats,
        "sh_degree": sh_degree,
        "bytes": total,
        "streams": [
            {"name": stream, "encoding": _OUTSIDE.get(stream, encoding), "bytes": size}
            for stream, size in streams.items()
        ],
    }


_OUTSIDE = {"header": "plain", META: "json", "zip": "zip"}
"""The part of a file around the streams, and how it is encoded."""

_DESCRIBERS: tuple[tuple[bytes | tuple[bytes, ...], Callable[[Path], dict[str, Any]]], ...] = (
    (MAGIC, _describe_nsvq),
    (PLY_MAGIC, _describe_ply),
    (ZIP_MAGIC, _describe_sog),
    (SPZ_MAGICS, _describe_spz),
)
"""First bytes of each format, and the function that describes it."""
