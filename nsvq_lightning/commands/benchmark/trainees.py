"""What the suites train: splats and the photos they are trained on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from nsvq_lightning.commands.benchmark.fitting import Step, StepClock, fit, one_phase, quiet, training_callbacks
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.views import write_views
from nsvq_lightning.commands.benchmark.workloads import Workload, single_workload
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import View
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

__all__ = ["Trainee", "photographed", "trainee"]


class Trainee(NamedTuple):
    """Splats in the middle of a training, and their photos.

    Attributes:
        name: Name in the tables.
        splats: Raw attributes.
        data: The photos, decoded: nothing is loaded in the background of a step.
    """

    name: str
    splats: RawSplats
    data: ColmapDataModule

    def train(
        self,
        phase: Phase,
        steps: int,
        between: Callable[[Any, View, Step], None],
        accelerator: str = "cpu",
        together: int = 1,
        **options: Any,
    ) -> None:
        """Train a copy of the splats in one phase, at their full SH degree, with codebooks of one Lloyd step.

        Args:
            phase: Which.
            steps: How many.
            between: Called after every step, see :class:`~nsvq_lightning.commands.benchmark.fitting.StepClock`.
            accelerator: That of the trainer.
            together: Steps that are timed as one.
            options: Further arguments of :class:`~nsvq_lightning.training.module.SplatModule`.
        """
        splats = Splats.from_tensors(*(tensor.clone() for tensor in self.splats))
        quantizer = partial(NSVQ, kmeans_steps=1)
        module = SplatModule(sh_degree=splats.sh_degree, splats=splats, quantizer=quantizer, **options)
        module.active_sh_degree = splats.sh_degree
        callbacks = [*training_callbacks(phases=one_phase(phase, steps)), StepClock(between, together)]
        fit(module, self.data, callbacks, steps, accelerator)


def trainee(scope: Scope, folder: Path, full: str = "B100k") -> Trainee:
    """The user's scene, or a synthetic one; where it has no photos of its own, they are rendered.

    Args:
        scope: Says which.
        folder: Where photos are written.
        full: Synthetic scene of a full run.

    Raises:
        ValueError: As :func:`nsvq_lightning.commands.benchmark.workloads.workloads`.
        SceneError: The COLMAP folder cannot be used.
    """
    workload = single_workload(scope, full)
    return _with_photos(workload, ColmapDataModule(str(scope.photos or write_views(workload, folder / "scene"))))


def photographed(workload: Workload, folder: Path, views: int) -> Trainee:
    """A workload and photos that are rendered of it."""
    return _with_photos(workload, ColmapDataModule(str(write_views(workload, folder / "scene", views)), max_width=None))


def _with_photos(workload: Workload, data: ColmapDataModule) -> Trainee:
    with quiet():
        for index in data.scene.train:
            data.scene.view(index)
    return Trainee(f"{workload}, {len(workload.splats.means)} splats", workload.splats, data)
