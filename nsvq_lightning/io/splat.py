"""The ``.splat`` file of the first web viewers: 32 bytes per splat, no spherical harmonics.

=========  =====  ====================================================================
offset     bytes  content
=========  =====  ====================================================================
0          12     position, 3 float32 little-endian
12         12     axis lengths (not their logarithms), 3 float32
24         4      red, green, blue and opacity, 255ths
28         4      rotation wxyz: unit quaternion times 128, plus 128
=========  =====  ====================================================================
"""

from pathlib import Path

import numpy as np

from nsvq_lightning.io.atomic import StrPath, write_bytes
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.numbers import Clamped, bytes_of, logits_of_bytes, logs_of_lengths
from nsvq_lightning.splats.conventions import SH_C0, Records, unit
from nsvq_lightning.top_level import log

_RECORD = np.dtype([("means", "<f4", 3), ("lengths", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def write_splat(path: StrPath, scene: CompressedScene) -> int:
    """Write a scene as ``.splat``.

    View-dependent colour is lost and colours outside [0, 1] are clamped, each with a warning. Splats with a non-finite
    value are written as they are: :func:`nsvq_lightning.io.save` leaves them out.

    Returns:
        Bytes of the file.
    """
    if scene.sh_degree:
        log.warning(f"{path}: .splat files hold no spherical harmonics; colours no longer change with the view")
    if scene.antialiased:
        advice = "switch it on in the viewer, or small splats look too thick"
        log.warning(f"{path}: the file cannot say that the scene was trained with anti-aliasing: {advice}")
    clamped = Clamped()
    records = np.concatenate([_records(part, clamped) for part in scene.parts()])
    clamped.warn(path, len(scene))
    return write_bytes(path, records.tobytes())


def _records(scene: CompressedScene, clamped: Clamped) -> Records:
    """The splats as they are in the file."""
    records = np.empty(len(scene), _RECORD)
    records["means"] = scene.means
    scales = scene.rows("scales")
    # Between the smallest and the largest length that float32 holds with full precision.
    held = scales.clip(-87.0, 88.0)
    clamped["scales"] += (held != scales).any(1).sum()
    records["lengths"] = np.exp(held)
    records["colors"][:, :3] = clamped.nearest("sh0", 255 * (0.5 + SH_C0 * scene.rows("sh0")), (0, 255))
    records["colors"][:, 3] = bytes_of(scene.opacities)
    units = unit(scene.rows("quats"))
    # Of q and -q, the one whose largest component is negative: -1 fits a byte, 1 does not.
    largest = np.take_along_axis(units, np.abs(units).argmax(1)[:, None], 1)
    records["quats"] = np.rint(128 + 128 * np.where(largest > 0, -units, units))
    return records


def read_splat(path: StrPath) -> CompressedScene:
    """Read a ``.splat`` file.

    Raises:
        FormatError: The file does not consist of whole splats, or begins as one of another format does.
    """
    data = Path(path).read_bytes()
    with naming_file(path):
        # The format has no mark of its own; those of others are no coordinate of a splat.
        if len(data) % _RECORD.itemsize or data[:3] in b"ply PK\3 \x1f\x8b\x08 NGS \x89NS glT #us":
            raise FormatError(f"truncated, or not a .splat file: {len(data)} bytes, {data[:4]!r}…, are no splats of 32")
    records = np.frombuffer(data, _RECORD)
    colors = records["colors"]
    return CompressedScene.from_rows(
        {
            "means": records["means"],
            "quats": (records["quats"].astype(np.float32) - 128) / 128,
            "scales": logs_of_lengths(records["lengths"]),
            "opacities": logits_of_bytes(colors[:, 3]),
            "sh0": (colors[:, :3] / 255 - 0.5) / SH_C0,
        }
    )
