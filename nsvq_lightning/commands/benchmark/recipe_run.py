"""Whole runs of a config, as ``nsvq fit`` makes them, watched step by step."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer

from nsvq_lightning.commands.benchmark.fitting import WATCHING, Step, StepClock, quiet
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import use_threads
from nsvq_lightning.commands.configs import find_config
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.data.scene import View
from nsvq_lightning.training.module import SplatModule

__all__ = ["recipe_name", "recipe_run"]

QUICK_DEMO = ("--data.views=9", "--data.width=96", "--data.height=72")


def recipe_run(
    scope: Scope, threads: int, between: Callable[[Any, View, Step], None], options: Sequence[str] = ()
) -> SplatModule:
    """Train ``scope.steps`` iterations of the config on the scene, or on the demo scene if that is no folder of photos.

    Args:
        scope: Says which config, scene, first splats and length.
        threads: Of torch and of the kernels.
        between: Called after every step, see :class:`~nsvq_lightning.commands.benchmark.fitting.StepClock`.
        options: Further ones of ``nsvq fit``.

    Returns:
        What was trained.

    Raises:
        ValueError: A run cannot be made from the config.
    """
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder, use_threads(threads), quiet():
        module: SplatModule = _Run([*_arguments(scope, Path(folder)), *options], StepClock(between)).model
    return module


def recipe_name(scope: Scope) -> str:
    """The run in the tables."""
    scene = "demo" if scope.photos is None else scope.photos.resolve().name
    return f"{scene}, {Path(_config(scope)).name}, {scope.steps} steps"


def _config(scope: Scope) -> str:
    return scope.config or ("fast.yaml" if scope.photos else "demo.yaml")


def _arguments(scope: Scope, folder: Path) -> list[str]:
    data: tuple[str, ...] = ("--data=ColmapDataModule", f"--data.root={scope.photos}")
    if scope.photos is None:
        size = QUICK_DEMO if scope.quick else ()
        root = Path(_demo_scenes().name, "demo" + "".join(size))
        data = ("--data=DemoDataModule", f"--data.root={root}", *size)
    return [
        "fit",
        f"--config={find_config(_config(scope))}",
        *data,
        *(() if scope.init_from is None else (f"--model.init_from={scope.init_from}",)),
        f"--trainer.default_root_dir={folder}",
        f"--trainer.max_steps={scope.steps}",
        "--trainer.enable_progress_bar=false",
        "--trainer.enable_checkpointing=false",
        *(f"--callbacks.{name}=null" for name in sorted(WATCHING)),
    ]


@cache
def _demo_scenes() -> tempfile.TemporaryDirectory[str]:
    """The first run of a size writes its scene here, later ones find it; goes when the process ends."""
    return tempfile.TemporaryDirectory(prefix="nsvq-benchmark-scenes-")


class _Run(SplatCLI):
    """``nsvq fit`` with a clock, and without what follows the last step."""

    def __init__(self, arguments: list[str], clock: StepClock) -> None:
        self._clock = clock
        super().__init__(arguments)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        trainer = super().instantiate_trainer(**kwargs)
        trainer.callbacks.append(self._clock)  # type: ignore[attr-defined]  # Lightning does not type it
        return trainer

    def after_fit(self) -> None:
        """Nothing: the steps are all that is asked for."""
