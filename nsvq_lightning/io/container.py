"""Write and read ``.nsvq`` files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace

from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError, naming_file
from nsvq_lightning.io.frame import frame, read_frame, read_header
from nsvq_lightning.io.header import Header
from nsvq_lightning.io.paper import decode_paper, encode_paper

__all__ = ["LEVELS", "CompressedScene", "read_header", "read_nsvq", "write_nsvq"]

Encode = Callable[[CompressedScene], tuple[Header, dict[str, bytes]]]
Decode = Callable[[Header, Mapping[str, memoryview]], CompressedScene]

LEVELS: dict[str, tuple[Encode, Decode]] = {"paper": (encode_paper, decode_paper)}
"""Encoder and decoder of each compression level."""


def write_nsvq(path: str | os.PathLike[str], scene: CompressedScene, level: str = "paper") -> int:
    """Write a scene; the same scene and level give the same bytes.

    Args:
        path: File to write, replaced atomically.
        scene: The scene.
        level: Key of :data:`LEVELS`.

    Returns:
        Bytes of the file.

    Raises:
        ValueError: Unknown level, or ``config`` is not made of JSON values.
    """
    if level not in LEVELS:
        raise ValueError(f"unknown compression level {level!r}; there is {', '.join(LEVELS)}")
    header, streams = LEVELS[level][0](scene)
    parts = frame(header, streams)
    with atomic_write(path) as file:
        file.writelines(parts)
    return sum(map(len, parts))


def read_nsvq(path: str | os.PathLike[str]) -> CompressedScene:
    """Read a scene; the arrays are exactly those that were written.

    Raises:
        FormatError: The file is truncated, altered, of a newer version or level, or no ``.nsvq`` file.
    """
    header, streams = read_frame(path)
    with naming_file(path):
        if header.level not in LEVELS:
            raise FormatError(f"compression level {header.level!r}; this release reads {', '.join(LEVELS)}: update it")
        scene = LEVELS[header.level][1](header, streams)
    return replace(scene, stored_bytes=os.path.getsize(path))
