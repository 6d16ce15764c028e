"""What a scene file holds, and how far what is read is from what was written."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.formats import FORMATS
from nsvq_lightning.io.nsvq.header import MAGIC, read_header
from nsvq_lightning.io.numbers import opacity_of
from nsvq_lightning.io.ply import PLY_MAGIC, attribute_bytes, plain_ply_bytes, read_ply_size, splat_degree
from nsvq_lightning.io.sog import META, ZIP_MAGIC, read_sog_header
from nsvq_lightning.io.splat import SPLAT_LAYOUT, count_splats
from nsvq_lightning.io.spz import DEFAULT_AXES, SPZ_MAGICS, read_spz_header
from nsvq_lightning.splats.conventions import unit

__all__ = ["attribute_errors", "describe"]


def attribute_errors(read: CompressedScene, written: CompressedScene) -> dict[str, float]:
    """Root mean square errors over the splats, by quantity.

    Args:
        read: What the file holds, N splats.
        written: What it was written from, the same splats in the same order; spherical-harmonic coefficients that
            the file does not hold count as 0.

    Returns:
        ``position`` in scene units, ``rotation`` in degrees, ``log-scale``, ``opacity`` in [0, 1], and the coefficients
        ``sh0`` and ``shN``; 0 where there is nothing to compare.
    """
    units, others = (unit(scene.values("quats")) for scene in (read, written))
    nearer = np.minimum(np.linalg.norm(units - others, axis=1), np.linalg.norm(units + others, axis=1))
    shN, written_shN = (scene.values("shN").astype(np.float64) for scene in (read, written))
    missing = written_shN.shape[1] - shN.shape[1]
    errors = {
        "position": read.means - written.means.astype(np.float64),
        "rotation": np.degrees(4 * np.arcsin(np.minimum(nearer / 2, 1))),
        "log-scale": read.values("scales") - written.values("scales").astype(np.float64),
        "opacity": opacity_of(read.opacities) - opacity_of(written.opacities),
        "sh0": read.values("sh0") - written.values("sh0").astype(np.float64),
        "shN": np.pad(shN, ((0, 0), (0, missing), (0, 0))) - written_shN,
    }
    return {name: float(np.sqrt(np.mean(np.square(error)))) if error.size else 0.0 for name, error in errors.items()}


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
        "attributes": [{**entry._asdict(), "bits": entry.bits} for entry in header.attributes],
        "streams": [{"name": "header", "encoding": "json", "bytes": header_bytes}, *streams],
        "config": header.config,
        "metrics": header.metrics,
    }


def _describe_ply(path: Path) -> dict[str, Any]:
    header, total = read_ply_size(path)
    with naming_file(path):
        sh_degree = splat_degree(header)
    sizes = attribute_bytes(header)
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
