"""What the suites train: splats and the photos they are trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from lightning.pytorch import LightningDataModule

from nsvq_lightning.commands.benchmark.settings import Settings
from nsvq_lightning.commands.benchmark.views import write_views
from nsvq_lightning.commands.benchmark.workloads import single_workload
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.module import SplatModule

__all__ = ["Trainee", "trainee"]


class Trainee(NamedTuple):
    """Splats in the middle of a training, and where their photos are.

    Attributes:
        name: Name in the tables.
        splats: Raw attributes.
        root: COLMAP folder.
    """

    name: str
    splats: RawSplats
    root: Path

    def module(self, **options: Any) -> SplatModule:
        """A module that trains a copy of the splats, at their full SH degree."""
        splats = Splats.from_tensors(*(tensor.clone() for tensor in self.splats))
        module = SplatModule(sh_degree=splats.sh_degree, splats=splats, **options)
        module.active_sh_degree = splats.sh_degree
        return module

    def data(self) -> LightningDataModule:
        """The photos."""
        return ColmapDataModule(str(self.root))


def trainee(settings: Settings, folder: Path, full: str = "B100k") -> Trainee:
    """The user's scene, or a synthetic one; where it has no photos of its own, they are rendered.

    Args:
        settings: Say which.
        folder: Where photos are written.
        full: Synthetic scene of a full run.

    Raises:
        ValueError: As :func:`nsvq_lightning.commands.benchmark.workloads.workloads`.
        SceneError: The COLMAP folder cannot be used.
    """
    workload = single_workload(settings, full)
    photographed = settings.scene is not None and settings.scene.is_dir()
    root = settings.scene if photographed else write_views(workload, folder / "scene")
    assert root is not None
    count = len(workload.splats.means)
    return Trainee(f"{workload}, {count} splats", workload.splats, root)
