"""Load, save and convert scenes; the file's suffix selects the format."""

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsvq_lightning.io import ply, sog, splat, spz
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.file import as_stored, read_nsvq, write_nsvq
from nsvq_lightning.io.nsvq.precision import Storage

if TYPE_CHECKING:
    from nsvq_lightning.splats.splats import Splats, SplatTensors

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Format:
    """Reader and writer of one kind of file.

    Attributes:
        description: A few words for error messages and help.
        read: Scene from a file; codebooks are kept where the format has them.
        write: ``write(path, scene, **options) -> bytes written``.
        native: Whether it is our own: it holds the origin that positions are relative to, and ``write`` has an option
            ``storage``, the level and precision.
        in_order: Gives the splats of a scene that a file holds, in file order, for comparison with what is read back;
            None if the format loses nothing, or states its errors itself.
    """

    description: str
    read: Callable[[Path], CompressedScene]
    write: Callable[..., int]
    native: bool = False
    in_order: Callable[[CompressedScene], CompressedScene] | None = None


def load(path: str | os.PathLike[str]) -> "Splats":
    """Load a scene of any supported format.

    Args:
        path: File; its suffix, upper or lower case, selects the format, see :data:`FORMATS`.

    Raises:
        ValueError: Unknown suffix.
        FormatError: The file is damaged or not in the format of its suffix.
        FileNotFoundError: No such file.
    """
    scene = read_scene(path)
    if any(scene.origin):
        logger.warning(
            "%s: positions are relative to the world point %s; read_nsvq(path).origin has it", path, scene.origin
        )
    return scene.decode()


def read_scene(path: str | os.PathLike[str]) -> CompressedScene:
    """Read a scene of any supported format, keeping its codebooks; arguments and errors are those of :func:`load`."""
    path = Path(path)
    return replace(_format_of(path, "read").read(path), stored_bytes=path.stat().st_size)


def save(
    scene: "SplatTensors | CompressedScene",
    path: str | os.PathLike[str],
    storage: Storage | None = None,
    **options: Any,
) -> int:
    """Save a scene in any supported format; splats with NaN or infinite values are left out with a warning.

    Args:
        scene: For example :class:`nsvq_lightning.Splats`. A :class:`CompressedScene` keeps its codebooks where the
            format has them: all of them in ``.nsvq``, that of the spherical harmonics in ``.sog``.
        path: File to write, replaced atomically; its suffix selects the format.
        storage: Level and precision of ``.nsvq``. For another format, the file then holds what the ``.nsvq`` file
            would decode to, so that all files of a run hold the same splats.
        options: For ``.sog``: ``palette`` (most rows of the palette for spherical harmonics without a codebook, default
            65536). For ``.spz``: ``version`` (3 or 4, default 3) and ``axes`` (``rdf``, those of ``.ply``
            and the default, or ``rub``).

    Returns:
        Bytes of the file.

    Raises:
        ValueError: Unknown suffix, or one that is only read.
        TypeError: The format has no such option.
    """
    path = Path(path)
    if path.name.lower().endswith(".compressed.ply"):
        raise ValueError(f"cannot write {path}: compressed .ply files are only read; .sog and .spz are smaller")
    entry = _format_of(path, "write")
    if not isinstance(scene, CompressedScene):
        scene = CompressedScene.from_splats(scene)
    scene = scene.finite()
    if any(scene.origin) and not entry.native:
        logger.warning("%s: the origin %s of the positions is not stored; add it in the viewer", path, scene.origin)
    if entry.native:
        options["storage"] = storage or Storage()
    elif storage is not None:
        scene = as_stored(scene, storage)
    return entry.write(path, scene, **options)


def _format_of(path: Path, action: str) -> Format:
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        supported = ", ".join(f"{suffix} ({entry.description})" for suffix, entry in FORMATS.items())
        raise ValueError(f"cannot {action} {path}: unknown suffix {path.suffix!r}; supported are {supported}") from None


# Formats by suffix; a new format is one more entry.
FORMATS: dict[str, Format] = {
    ".ply": Format("3D Gaussian Splatting", ply.read_ply, ply.write_ply),
    ".nsvq": Format("compressed scene of this package", read_nsvq, write_nsvq, native=True),
    ".sog": Format("PlayCanvas, SuperSplat", sog.read_sog, sog.write_sog, in_order=sog.in_sog_order),
    ".spz": Format("Niantic", spz.read_spz, spz.write_spz, in_order=spz.in_spz_order),
    ".splat": Format(
        "first viewers on the web, without spherical harmonics",
        splat.read_splat,
        splat.write_splat,
        in_order=lambda scene: scene,
    ),
}
