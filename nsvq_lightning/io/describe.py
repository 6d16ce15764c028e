"""What a scene file holds, and how far what is read is from what was written."""

from pathlib import Path
from typing import Any

import numpy as np

from nsvq_lightning.io.atomic import StrPath
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import format_of, read_scene, suffix_of
from nsvq_lightning.io.nsvq.header import describe_nsvq
from nsvq_lightning.io.numbers import opacity_of
from nsvq_lightning.io.ply import plain_ply_bytes
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


def describe(path: StrPath) -> dict[str, Any]:
    """Facts about a file, as JSON values.

    Raises:
        ValueError: Unknown suffix.
        FormatError: The file is damaged, not in the format of its suffix, or holds no finite splat.
        OSError: It cannot be read.
    """
    path = Path(path)
    if format_of(path).native:
        facts = describe_nsvq(path)
    else:
        scene = read_scene(path)
        facts = {"format": suffix_of(path).removeprefix("."), "splats": len(scene), "sh_degree": scene.sh_degree}
        facts["bytes"] = scene.stored_bytes
    plain_bytes = plain_ply_bytes(facts["splats"], facts["sh_degree"])
    return {"file": str(path), **facts, "plain_bytes": plain_bytes, "ratio": plain_bytes / facts["bytes"]}
