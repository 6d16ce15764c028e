"""Train 3D Gaussian splatting scenes and store them small (NSVQ-GS) with PyTorch Lightning.

Public names are imported on first use, so that light commands such as ``nsvq info`` start without torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

from nsvq_lightning.compute.environment import set_defaults
from nsvq_lightning.top_level import find_callbacks
from nsvq_lightning.version import __version__ as __version__

set_defaults()  # before anything imports torch

_HOME = {
    "Camera": "nsvq_lightning.rendering.camera",
    "ColmapDataModule": "nsvq_lightning.data.datamodule",
    "Render": "nsvq_lightning.rendering.rasterize",
    "SplatModule": "nsvq_lightning.training.module",
    "SplatTrainer": "nsvq_lightning.training.trainer",
    "Splats": "nsvq_lightning.splats.splats",
    "compress": "nsvq_lightning.compression.compressor",
    "load": "nsvq_lightning.io.formats",
    "render": "nsvq_lightning.rendering.rasterize",
    "save": "nsvq_lightning.io.formats",
}

if TYPE_CHECKING:
    from nsvq_lightning.compression.compressor import compress as compress
    from nsvq_lightning.data.datamodule import ColmapDataModule as ColmapDataModule
    from nsvq_lightning.io.formats import load as load
    from nsvq_lightning.io.formats import save as save
    from nsvq_lightning.rendering.camera import Camera as Camera
    from nsvq_lightning.rendering.rasterize import Render as Render
    from nsvq_lightning.rendering.rasterize import render as render
    from nsvq_lightning.splats.splats import Splats as Splats
    from nsvq_lightning.training.module import SplatModule as SplatModule
    from nsvq_lightning.training.trainer import SplatTrainer as SplatTrainer

__all__ = [*_HOME]

find_callbacks()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
