"""Whole runs of a config, as ``nsvq fit`` makes them, timed step by step, and the parts of a step under a profiler.

cProfile gives each Python function and each Numba kernel the time that it spends in itself. An operator of torch counts
for the Python function that called it.
"""

from __future__ import annotations

import cProfile
import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple, cast

from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.commands.arguments import find_config
from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.commands.benchmark.timing import finish, milliseconds, sgemm, use_threads
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.data.scene import View
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

__all__ = ["OTHER", "OUTSIDE", "PARTS", "Step", "StepClock", "StepSampler", "config_run", "part_of", "run_name"]

WATCHING = ("report", "export", "predictions", "checkpoint", "kernels", "progress")
"""Callbacks of ``nsvq fit`` that write files or lines but train nothing; the benchmark measures by itself."""
QUICK_DEMO = ("--data.factor=4",)


class Step(NamedTuple):
    """One step: its 1-based iteration, its phase, and milliseconds."""

    iteration: int
    phase: Phase
    milliseconds: float


Between = Callable[[SplatModule, View, Step], None]
"""Called after a step that has been timed with the module, its view and the step; not in the time."""


class StepClock(Callback):
    """Times steps from the end of one to the end of the next: data, hooks, loggers and loops are in it."""

    def __init__(self, between: Between) -> None:
        self._between = between
        self._since = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the first step."""
        self._since = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: View, batch_idx: int
    ) -> None:
        """End a step, the work of a GPU included, and start the next."""
        finish()
        took = 1000 * (time.perf_counter() - self._since)
        module = cast(SplatModule, pl_module)
        self._between(module, batch, Step(trainer.global_step, module.phase, took))
        self._since = time.perf_counter()


def config_run(scope: Scope, threads: int, between: Between, options: Sequence[str] = ()) -> SplatModule:
    """Train ``scope.steps`` iterations of the config on the scene, or on the demo scene if that is no folder of photos.

    Args:
        scope: Says which config, scene, first splats and length.
        threads: Of torch and of the kernels.
        between: Called after every step.
        options: Further ones of ``nsvq fit``.

    Returns:
        What was trained.

    Raises:
        ValueError: A run cannot be made from the config.
    """
    data: tuple[str, ...] = ("--data=ColmapDataModule", f"--data.root={scope.photos}")
    if scope.photos is None:
        data = ("--data=DemoDataModule", *(QUICK_DEMO if scope.quick else ()))
    if scope.init_from is not None:
        data += (f"--model.init_from={scope.init_from}",)
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder, use_threads(threads), _quiet():
        arguments = [
            "fit",
            f"--config={find_config(_config(scope))}",
            *data,
            f"--trainer.default_root_dir={folder}",
            f"--trainer.max_steps={scope.steps}",
            "--trainer.enable_progress_bar=false",
            "--trainer.enable_checkpointing=false",
            *(f"--callbacks.{name}=null" for name in WATCHING),
            *options,
        ]
        module: SplatModule = _Run(arguments, StepClock(between)).model
    return module


def run_name(scope: Scope) -> str:
    """The run in the tables."""
    scene = "demo" if scope.photos is None else scope.photos.resolve().name
    return f"{scene}, {Path(_config(scope)).name}, {scope.steps} steps"


def _config(scope: Scope) -> str:
    return scope.config or ("fast.yaml" if scope.photos else "demo.yaml")


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


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what Lightning says about devices, loaders and the end of the run."""
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logging.disable(logging.NOTSET)


# The parts of a step

OTHER, OUTSIDE = "other Python", "between the functions"
PARTS = {
    "data": ("nsvq_lightning.data.*", "torch.utils.data.*"),
    "blend": ("nsvq_lightning.rendering.cpu.blend.blend",),
    "blend backward": ("nsvq_lightning.rendering.cpu.blend.*",),
    "projection backward": ("nsvq_lightning.rendering.cpu.projection_backward.*",),
    "project, sort and bin": ("nsvq_lightning.rendering.cpu.projection.*", "nsvq_lightning.rendering.cpu.binning.*"),
    "rasterizer, its Python": ("nsvq_lightning.rendering.*",),
    "loss": ("nsvq_lightning.quality.*",),
    "Adam": ("nsvq_lightning.training.optim.*", "torch.optim.*"),
    "quantizer: noise": tuple(f"nsvq_lightning.quantize.{name}.*" for name in ("substitution", "nsvq")),
    "quantizer: search and decode": ("nsvq_lightning.quantize.*",),
    "buffers, checks and rows of kernels": ("nsvq_lightning.compute.*",),
    "callbacks": ("nsvq_lightning.callbacks.*",),
    "module, its Python": ("nsvq_lightning.*",),
    "autograd's own": ("torch.autograd.graph.*",),
    "torch's Python": ("torch.*",),
    "Lightning": ("lightning.*", "contextlib.*"),
}
"""Parts by the functions that belong to them; the first pattern that fits counts. The rest is :data:`OTHER`."""
PRODUCT_EVERY = 3
"""Steps between two matrix products: one after each step would empty the caches for the next. An odd number, so that
steps with and without cProfile come after a product equally often."""


class StepSampler:
    """Times all steps of a run, every second one under cProfile; what :func:`config_run` calls between steps.

    Args:
        last: Last iteration of the run.

    Attributes:
        plain: The steps without cProfile.
        profiled: Those with it, and what each part took, ms.
        products: Matrix products in between, ms.
    """

    def __init__(self, last: int) -> None:
        self.plain: list[Step] = []
        self.profiled: list[tuple[Step, dict[str, float]]] = []
        self.products: list[float] = []
        self._last = last
        self._product = sgemm()
        self._profiler = cProfile.Profile(builtins=False, subcalls=False)

    def __call__(self, _: SplatModule, __: View, step: Step) -> None:
        """Keep a step, and profile the next if it is its turn."""
        self._profiler.disable()
        parts = _parts(self._profiler.getstats())
        self._profiler.clear()
        if parts:
            self.profiled.append((step, parts))
        else:
            self.plain.append(step)
        if step.iteration % PRODUCT_EVERY == 0:
            self.products.append(milliseconds(self._product))
        if step.iteration % 2 == 0 and step.iteration < self._last:
            self._profiler.enable()


def _parts(stats: Iterable[Any]) -> dict[str, float]:
    """What each part takes, ms, from the entries of a profile."""
    modules = {getattr(module, "__dict__", {}).get("__file__"): name for name, module in list(sys.modules.items())}
    parts: dict[str, float] = {}
    for entry in stats:
        file = entry.code.co_filename
        name = part_of(f"{modules.get(file, file)}.{entry.code.co_qualname}")
        parts[name] = parts.get(name, 0.0) + 1000 * entry.inlinetime
    return parts


def part_of(function: str) -> str:
    """The part that a function belongs to, by its full name: ``nsvq_lightning.rendering.cpu.blend.blend``."""
    fitting = (part for part, patterns in PARTS.items() if any(fnmatchcase(function, p) for p in patterns))
    return next(fitting, OTHER)
