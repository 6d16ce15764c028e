"""Write and read ``.nsvq`` files."""

import os
from collections.abc import Mapping
from dataclasses import replace

from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.nsvq.header import Header, frame, read_frame
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.splats.attributes import listed


def encode(scene: CompressedScene, storage: Storage) -> tuple[Header, dict[str, bytes]]:
    """Header and streams of a scene; the same arguments give the same bytes.

    Args:
        scene: The scene.
        storage: Level and precision.

    Raises:
        ValueError: ``config`` is not made of JSON values, or a value is too large for its step.
    """
    # Import only the level's module: entropy coding needs Numba, which level ``paper`` does without.
    if storage.level == "compact":
        from nsvq_lightning.io.nsvq.compact import encode_compact

        return encode_compact(scene, storage.precision)
    from nsvq_lightning.io.nsvq.paper import encode_paper

    return encode_paper(scene)


def write_nsvq(path: str | os.PathLike[str], scene: CompressedScene, storage: Storage | None = None) -> int:
    """Write a scene to a file, replaced atomically; the same arguments give the same bytes.

    Args:
        path: File to write.
        scene: The scene; :func:`nsvq_lightning.save` leaves out non-finite splats, which level ``compact`` refuses.
        storage: Level and precision.

    Returns:
        Bytes of the file.

    Raises:
        ValueError: ``config`` is not made of JSON values, or level ``compact`` cannot store a value.
    """
    storage = storage or Storage()
    if storage.level == "compact" and (culprits := scene.finite_rows()[1]):
        raise ValueError(
            f"numbers that are not finite ({listed(culprits)}): drop those splats, or use level 'paper', which stores "
            "float32 as it is"
        )
    parts = frame(*encode(scene, storage))
    with atomic_write(path) as file:
        file.writelines(parts)
    return sum(map(len, parts))


def as_stored(scene: CompressedScene, storage: Storage) -> CompressedScene:
    """What the ``.nsvq`` file of a scene decodes to, for files of other formats that hold the same splats.

    A scene without codebooks stays as it is: rounding it would only cost quality, and its reference is the ``.ply``.
    """
    if not scene.codes:
        return scene
    header, streams = encode(scene, storage)
    return decode(header, {name: memoryview(data) for name, data in streams.items()})


def read_nsvq(path: str | os.PathLike[str]) -> CompressedScene:
    """Read a scene: exact for level ``paper``; within its precision, with splats reordered, for ``compact``.

    Raises:
        FormatError: The file is truncated, altered, of a newer version or level, or not a ``.nsvq`` file.
    """
    header, streams = read_frame(path)
    with naming_file(path):
        scene = decode(header, streams)
    return replace(scene, stored_bytes=os.path.getsize(path))


def decode(header: Header, streams: Mapping[str, memoryview]) -> CompressedScene:
    """Scene from header and streams of any level.

    Raises:
        FormatError: The level is newer, or the streams do not match the header.
    """
    if header.level == "compact":
        from nsvq_lightning.io.nsvq.compact import decode_compact

        return decode_compact(header, streams)
    if header.level == "paper":
        from nsvq_lightning.io.nsvq.paper import decode_paper

        return decode_paper(header, streams)
    raise FormatError(
        f"compression level {header.level!r}; this release reads {', '.join(LEVELS)}", "update nsvq-lightning"
    )
