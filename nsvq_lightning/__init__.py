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
    "load": "nsvq_lightning.io.formats",
    "render": "nsvq_lightning.rendering.rasterize",
    "save": "nsvq_lightning.io.formats",
}

if TYPE_CHECKING:
    from nsvq_lightning.data.datamodule import ColmapDataModule
    from nsvq_lightning.io.formats import load, save
    from nsvq_lightning.rendering.camera import Camera
    from nsvq_lightning.rendering.rasterize import Render, render
    from nsvq_lightning.splats.splats import Splats
    from nsvq_lightning.training.module import SplatModule
    from nsvq_lightning.training.trainer import SplatTrainer

__all__ = ["Camera", "ColmapDataModule", "Render", "SplatModule", "SplatTrainer", "Splats", "load", "render", "save"]

find_callbacks()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
