"""Scenes on disk: the compressed ``.nsvq`` file, the formats of viewers, and the registry of formats.

Nothing here imports torch before a scene is turned into :class:`nsvq_lightning.Splats`.
"""

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.formats import FORMATS, describe, load, read_scene, save
from nsvq_lightning.io.nsvq.file import read_nsvq, write_nsvq
from nsvq_lightning.io.nsvq.header import read_header
from nsvq_lightning.io.placing import rotated, turn_up
from nsvq_lightning.io.ply import read_ply, write_ply

__all__ = [
    "FORMATS",
    "CompressedScene",
    "FormatError",
    "describe",
    "load",
    "read_header",
    "read_nsvq",
    "read_ply",
    "read_scene",
    "rotated",
    "save",
    "turn_up",
    "write_nsvq",
    "write_ply",
]
