"""Scene files of any format: the end of the file's name selects it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from nsvq_lightning.io import glb, lod, ply, sog, splat, spz, usda
from nsvq_lightning.io.atomic import StrPath
from nsvq_lightning.io.compressed import AnySplats, CompressedScene
from nsvq_lightning.io.errors import Json, naming_file
from nsvq_lightning.io.nsvq.file import as_stored, read_nsvq, write_nsvq
from nsvq_lightning.io.nsvq.header import describe_nsvq
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.top_level import log

if TYPE_CHECKING:
    from nsvq_lightning.splats.splats import Splats


class Format(NamedTuple):
    """Reader and writer of one kind of file.

    Attributes:
        description: A few words for error messages and help.
        read: Scene from a file; codebooks are kept where the format has them.
        write: ``write(path, scene, **options) -> bytes written``; None if it is only read.
        native: Whether it is our own: it holds the origin that positions are relative to, and ``write`` has an option
            ``storage``, the level and precision.
    """

    description: str
    read: Callable[[Path], CompressedScene]
    write: Callable[..., int] | None
    native: bool = False


def load(path: StrPath) -> "Splats":
    """Load a scene of any supported format; splats with NaN or infinite values are left out with a warning.

    Args:
        path: File; its suffix, upper or lower case, selects the format, see :data:`FORMATS`.

    Raises:
        ValueError: Unknown suffix.
        FormatError: The file is damaged, not in the format of its suffix, or holds no finite splat.
        FileNotFoundError: No such file.
    """
    scene = read_scene(path)
    if any((*scene.origin, *scene.background, scene.antialiased)):
        facts = f"origin {scene.origin}, background {scene.background}, antialiased {scene.antialiased}"
        log.warning(f"{path}: its splats alone do not say {facts}: nsvq_lightning.io.read_scene does")
    return scene.decode()


def read_scene(path: StrPath) -> CompressedScene:
    """Read a scene of any supported format, keeping its codebooks; arguments and errors are those of :func:`load`."""
    path = Path(path)
    scene = format_of(path).read(path)
    with naming_file(path):
        kept = scene.finite()
    if unturned := len(kept) - kept.rows("quats").any(axis=1).sum():
        log.warning(f"{path}: {unturned} of {len(kept)} splats have the rotation 0 0 0 0: not turned")
    return replace(kept, stored_bytes=scene.stored_bytes or path.stat().st_size)


def save(scene: AnySplats, path: StrPath, storage: Storage | str | None = None, **options: Any) -> int:
    """Save a scene in any supported format; splats with NaN or infinite values are left out with a warning.

    Args:
        scene: For example :class:`nsvq_lightning.Splats`, or a dictionary of what gsplat or nerfstudio have, see
            :meth:`CompressedScene.from_splats`. A :class:`CompressedScene` keeps its codebooks where the
            format has them: all of them in ``.nsvq``, that of the spherical harmonics in ``.sog``.
        path: File to write, replaced atomically; its suffix selects the format.
        storage: Level and precision of ``.nsvq``, or the level alone, a word. For another format, the file then holds
            what the ``.nsvq`` file would decode to, so that all files of a run hold the same splats.
        options: For ``.sog``: ``palette`` (most rows of the palette of spherical harmonics, also of a codebook; default
            65536). For ``.spz``: ``version`` (3 or 4, default 3) and ``axes`` (``rdf``, those of ``.ply``
            and the default, or ``rub``). For ``lod-meta.json``: ``coarser`` (scenes of the coarser levels).

    Returns:
        Bytes of the file, or of all files of a folder.

    Raises:
        ValueError: Unknown suffix, or one that is only read; unknown level.
        FormatError: The scene has no finite splat.
        TypeError: The format has no such option.
    """
    path = Path(path)
    entry = format_of(path)
    if entry.write is None:
        raise ValueError(f"cannot write {path}: {suffix_of(path)} is only read")
    with naming_file(path):
        scene = CompressedScene.from_splats(scene).finite()
    lost = ({} if suffix_of(path) == ".glb" else {"origin": scene.origin}) | {"background": scene.background}
    if any(map(any, lost.values())) and not entry.native:
        told = ", ".join(f"{name} {value}" for name, value in lost.items())
        log.warning(f"{path}: not stored: {told}; set in the viewer")
    storage = None if storage is None else Storage.of(storage)
    if entry.native:
        options["storage"] = storage
    elif storage:
        scene = as_stored(scene, storage)
    return entry.write(path, scene, **options)


def describe(path: StrPath) -> Json:
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
        facts = {
            "format": suffix_of(path).removeprefix("."),
            "splats": len(scene),
            "sh_degree": scene.sh_degree,
            "bytes": scene.stored_bytes,
        }
    plain_bytes = ply.plain_ply_bytes(facts["splats"], facts["sh_degree"])
    return {"file": str(path), **facts, "plain_bytes": plain_bytes, "ratio": plain_bytes / facts["bytes"]}


def suffix_of(path: StrPath) -> str:
    """The longest end of a file's name, in lower case, that is a key of :data:`FORMATS`; empty if none is."""
    name = Path(path).name.lower()
    return max((suffix for suffix in FORMATS if name.endswith(suffix)), key=len, default="")


def format_of(path: StrPath) -> Format:
    """The format that the name of a file selects.

    Raises:
        ValueError: None has such a name.
    """
    if suffix := suffix_of(path):
        return FORMATS[suffix]
    supported = ", ".join(f"{suffix} ({entry.description})" for suffix, entry in FORMATS.items())
    way = _WAYS.get(suffix := Path(path).suffix.lower(), "name a file that ends so")
    raise ValueError(f"{path}: unknown suffix {suffix!r}; supported are {supported}; {way}")


# What turns files of other formats, and folders, into some that are read.
_WAYS = {
    "": "of the folder of a run, name scene.nsvq in it, of others lod-meta.json or meta.json",
    ".ckpt": "of a run, nsvq export --ckpt_path FILE writes its scene",
    **dict.fromkeys((".usd", ".usdc", ".usdz"), usda.BINARY_REMEDY),
    **dict.fromkeys((".ksplat", ".lcc", ".lcc2"), "splat-transform (npm) converts it"),
    ".gltf": "save it as .glb",
    **dict.fromkeys((".zip", ".ssog"), "unzip it, and name the file in it; with meta.json and pictures, name it .sog"),
    ".pt": "of a checkpoint of gsplat: nl.save(torch.load(FILE), 'scene.ply')",
}
# Formats by the end of the file's name; a new format is one more entry.
FORMATS = {
    ".ply": Format("3D Gaussian Splatting", ply.read_ply, ply.write_ply),
    ".nsvq": Format("compressed scene of this package", read_nsvq, write_nsvq, native=True),
    ".sog": Format("PlayCanvas, SuperSplat", sog.read_sog, sog.write_sog),
    ".spz": Format("Niantic", spz.read_spz, spz.write_spz),
    ".glb": Format("glTF, KHR_gaussian_splatting", glb.read_glb, glb.write_glb),
    ".usda": Format("OpenUSD, for scenes of moderate size", usda.read_usda, usda.write_usda),
    ".compressed.ply": Format("PlayCanvas, SuperSplat", ply.read_ply, ply.write_compressed_ply),
    lod.NAME: Format("streamed SOG, a folder with levels of detail", lod.read_lod, lod.write_lod),
    sog.META: Format("SOG as a folder", sog.read_sog, None),
    ".splat": Format("first viewers on the web, without spherical harmonics", splat.read_splat, splat.write_splat),
}
