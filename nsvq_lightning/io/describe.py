"""What a scene file holds, and how far what is read is from what was written."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from nsvq_lightning.io import ply, sog, splat, spz
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.formats import FORMATS
from nsvq_lightning.io.nsvq.header import MAGIC, read_header
from nsvq_lightning.io.numbers import opacity_of
from nsvq_lightning.splats.conventions import unit


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
    total = path.stat().st_size
    facts = _describe_nsvq(path, total) if start.startswith(MAGIC) else _describe_others(path, start, total)
    plain_bytes = ply.plain_ply_bytes(facts["splats"], facts["sh_degree"])
    # An empty .splat has no bytes.
    return {
        "file": str(path),
        **facts,
        "bytes": total,
        "plain_bytes": plain_bytes,
        "ratio": plain_bytes / max(1, total),
    }


def _describe_nsvq(path: Path, total: int) -> dict[str, Any]:
    header = read_header(path)
    streams = [{"name": s.name, "encoding": s.encoding, "bytes": s.length} for s in header.streams]
    header_bytes = total - sum(stream.length for stream in header.streams)
    return {
        "format": f"nsvq, level {header.level}",
        "splats": header.splats,
        "sh_degree": header.sh_degree,
        "origin": list(header.origin),
        "attributes": [{**entry._asdict(), "bits": entry.bits} for entry in header.attributes],
        "streams": [{"name": "header", "encoding": "json", "bytes": header_bytes}, *streams],
        "config": header.config,
        "metrics": header.metrics,
    }


def _describe_others(path: Path, start: bytes, total: int) -> dict[str, Any]:
    suffix = path.suffix.lower()
    if suffix in FORMATS.keys() - {".nsvq", ".ply", ".sog", ".spz", ".splat"}:
        scene = FORMATS[suffix].read(path)
        count, sh_degree, kind, encoding, sizes = len(scene), scene.sh_degree, suffix[1:], suffix[1:], {"file": total}
    elif start.startswith(ply.PLY_MAGIC):
        header = ply.read_ply_header(path)
        with naming_file(path):
            count, sh_degree = header.count, ply.splat_degree(header)
        kind, encoding = f"ply, {'compressed' if header.packed else header.encoding}", "ply"
        # The lengths of ascii numbers vary, so only the total is known.
        sizes = ply.attribute_bytes(header) if header.encoding != "ascii" else {}
        sizes = {"header": total - sum(sizes.values()), **sizes} if sizes else {"text": total}
    elif start.startswith(sog.ZIP_MAGIC):
        count, sh_degree, sizes = sog.read_sog_header(path)
        kind, encoding, sizes = "sog, version 2", "webp", {**sizes, "zip": total - sum(sizes.values())}
    elif start.startswith(spz.SPZ_MAGICS):
        found, sizes = spz.read_spz_header(path)
        count, sh_degree, encoding = found.count, found.sh_degree, "zstd" if found.version == 4 else "gzip"
        kind = f"spz, version {found.version}, axes {found.axes or f'not stated, taken as {spz.DEFAULT_AXES.upper()}'}"
    elif suffix == ".splat":
        count, sh_degree, kind, encoding = splat.count_splats(path), 0, "splat", "splat"
        sizes = {name: count * size for name, size in splat.SPLAT_LAYOUT.items()}
    else:
        raise FormatError(f"{path}: not a {', '.join(FORMATS)} file", "give the file of a scene")
    around = {"header": "plain", sog.META: "json", "zip": "zip"}
    streams = [{"name": s, "encoding": around.get(s, encoding), "bytes": size} for s, size in sizes.items()]
    return {"format": kind, "splats": count, "sh_degree": sh_degree, "streams": streams}
