"""Load and save scenes, the format chosen by the file's suffix."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsvq_lightning.io.arrays import SplatArrays
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.container import read_nsvq, write_nsvq
from nsvq_lightning.io.ply import read_ply, write_ply
from nsvq_lightning.io.precision import DEFAULT_LEVEL, Precision

if TYPE_CHECKING:
    from nsvq_lightning.splats import Splats, SplatTensors

__all__ = ["FORMATS", "Format", "load", "save"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Format:
    """Reader and writer of one kind of file.

    Attributes:
        description: A few words for error messages and help.
        read: Scene from a file; None if the format is only written.
        write: ``write(path, arrays, **options) -> bytes written``; None if the format is only read.
    """

    description: str
    read: Callable[[Path], SplatArrays] | None
    write: Callable[..., int] | None


def load(path: str | os.PathLike[str]) -> Splats:
    """Load a scene of any supported format.

    Args:
        path: File; its suffix (``.ply``, ``.nsvq``, in any case) names the format, see :data:`FORMATS`.

    Raises:
        ValueError: Unknown suffix.
        FormatError: The file is damaged or of another format than its suffix says.
        FileNotFoundError: No such file.
    """
    path = Path(path)
    reader = _format_of(path, "read").read
    if reader is None:
        raise ValueError(f"cannot load {path}: {path.suffix} files are only written")
    return reader(path).to_splats()


def save(splats: SplatTensors, path: str | os.PathLike[str], **options: Any) -> int:
    """Save a scene in any supported format; splats with non-finite values are left out with a warning.

    Args:
        splats: The scene, for example :class:`nsvq_lightning.Splats`.
        path: File to write, replaced atomically; its suffix names the format.
        options: For ``.ply``: ``normals`` (bool, default True). For ``.nsvq``: ``config``, ``metrics``, ``origin``,
            ``level`` and ``precision``; plain splats have no codebooks, so level ``paper`` stores all attributes as
            they are, and ``compact`` within its precision and in another order.

    Returns:
        Bytes of the file.

    Raises:
        ValueError: Unknown suffix.
        TypeError: The format has no such option.
    """
    path = Path(path)
    writer = _format_of(path, "write").write
    if writer is None:
        raise ValueError(f"cannot save {path}: {path.suffix} files are only read")
    return writer(path, SplatArrays.from_splats(splats), **options)


def _format_of(path: Path, action: str) -> Format:
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        supported = ", ".join(f"{suffix} ({entry.description})" for suffix, entry in FORMATS.items())
        raise ValueError(f"cannot {action} {path}: unknown suffix {path.suffix!r}; supported are {supported}") from None


def _read_nsvq(path: Path) -> SplatArrays:
    scene = read_nsvq(path)
    if any(scene.origin):
        logger.warning(
            "%s: positions are relative to the world point %s; read_nsvq(path).origin has it", path, scene.origin
        )
    return scene.arrays()


def _write_nsvq(
    path: Path,
    arrays: SplatArrays,
    *,
    level: str = DEFAULT_LEVEL,
    precision: Precision | None = None,
    **header: Any,
) -> int:
    return write_nsvq(path, CompressedScene.from_arrays(arrays.finite(), **header), level, precision)


FORMATS: dict[str, Format] = {
    ".ply": Format("3D Gaussian Splatting", read_ply, write_ply),
    ".nsvq": Format("compressed scene of this package", _read_nsvq, _write_nsvq),
}
"""Formats by suffix; a new format is one more entry."""
