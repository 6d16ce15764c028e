"""Suite ``train``: whole runs of a config, PSNR against seconds.

Runs are those of ``nsvq fit``: its module, data, callbacks, loggers and trainer. What only watches a run (reports,
checkpoints, the progress bar) is left out, and test views are compared while the clock is stopped. Every run has the
same number of steps. Variants differ from the first one in one thing.
"""

import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from tempfile import TemporaryDirectory
from typing import Any
from warnings import catch_warnings

from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.commands.benchmark import timing
from nsvq_lightning.commands.benchmark.emulation import Region, Regions, makespan
from nsvq_lightning.commands.benchmark.timing import Measurement, Scope
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.commands.settings import find_config
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.report.numbers import evaluate
from nsvq_lightning.skips import switched
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase


class StepClock(Callback):
    """Times the steps of all runs of a variant, from the end of one to the end of the next.

    Data, hooks, loggers and loops are in their time; what the clock itself does between them is not.

    Attributes:
        steps: Phase and milliseconds of every step.
        products: Matrix products in between, ms.
        psnr: Of the test views, in dB, at the end of the last run.
        splats: How many there are then.
        kernels: What kernels did in parallel in each step.

    Args:
        regions: Where that is to be kept, what knows it.
    """

    def __init__(self, regions: Regions | None = None) -> None:
        self.regions = regions
        self.kernels: list[list[Region]] = []
        self.steps: list[tuple[Phase, float]] = []
        self.products: list[float] = []
        self.psnr = 0.0
        self.splats = 0
        self._product = timing.sgemm()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the first step."""
        if self.regions:
            self.regions.taken()
        self._since = time.perf_counter()

    def on_train_batch_end(self, trainer: Trainer, module: SplatModule, outputs: Any, *args: Any) -> None:  # type: ignore[override]
        """End a step, the work of a GPU included, and start the next; compare the test views after the last."""
        if self.regions:
            self.kernels.append(self.regions.taken())
        timing.finish()
        self.steps.append((module.phase, 1000 * (time.perf_counter() - self._since)))
        if trainer.global_step == trainer.max_steps:
            self.psnr = _test_psnr(module)
            self.splats = len(module.splats)
        if trainer.global_step % 8 == 1:
            self.products.append(timing.milliseconds(self._product))
        self._since = time.perf_counter()

    @property
    def by_phase(self) -> dict[str, float]:
        """The median step of each phase, in ms."""
        return {
            f"{phase.name.lower()} ms": median(took for its_phase, took in self.steps if its_phase == phase)
            for phase in dict.fromkeys(phase for phase, _ in self.steps)
        }

    @property
    def relative(self) -> float:
        """The mean step in matrix products, so that a busy machine is not mistaken for a slow variant."""
        return fmean(took for _, took in self.steps) / median(self.products)

    def expected(self, cores: int) -> "StepClock":
        """What a clock would show with so many cores; with 0, what lies between the kernels."""
        clock = StepClock()
        for (phase, took), kernels in zip(self.steps, self.kernels, strict=True):
            seconds = took / 1000 - sum(whole for _, whole in kernels)
            if cores and self.regions:
                seconds += sum(makespan(parts, cores) + self.regions.wake * (cores > 1) for parts, _ in kernels)
            clock.steps.append((phase, 1000 * seconds))
        clock.products, clock.psnr, clock.splats = self.products, self.psnr, self.splats
        return clock


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


QUICK_DEMO = ("--data.factor=4",)
# Callbacks of ``nsvq fit`` that write files or lines but train nothing; the benchmark measures by itself.
WATCHING = ("report", "export", "predictions", "checkpoint", "progress")


def _train(scope: Scope, clock: StepClock) -> None:
    """Train ``scope.steps`` iterations of the config on the scene, or on the demo scene if that is no folder of photos.

    Args:
        scope: Says which config, scene, first splats and length.
        clock: Times the steps.
    """
    data = ["--data=DemoDataModule", *QUICK_DEMO * scope.quick]
    if scope.photos:
        data = ["--data=ColmapDataModule", f"--data.root={scope.photos}"]
    if scope.init_from:
        data.append(f"--model.init_from={scope.init_from}")
    logging.disable(logging.WARNING)  # of Lightning, about devices, loaders and the end of the run
    try:
        with TemporaryDirectory(prefix="nsvq-benchmark-") as folder, catch_warnings(action="ignore"):
            arguments = [
                "fit",
                f"--config={find_config(_config(scope))}",
                *data,
                f"--trainer.default_root_dir={folder}",
                f"--trainer.max_steps={scope.steps}",
                "--callbacks.phases.iterations_per_photo=null",
                "--trainer.enable_progress_bar=false",
                "--trainer.enable_checkpointing=false",
                *(f"--callbacks.{name}=null" for name in WATCHING),
            ]
            _Run(arguments, clock)
    finally:
        logging.disable(logging.NOTSET)


def _config(scope: Scope) -> str:
    return scope.config or ("fast.yaml" if scope.photos else "demo.yaml")


def run(scope: Scope) -> Iterator[Measurement]:
    """Train as shipped, with each inverted switch that is asked for, and on each emulated number of cores."""
    regions = Regions() if scope.emulate else None
    variants: dict[str, dict[str, bool]] = {"as shipped": {}}
    variants |= {f"no skip of {name}": {name: False} for name in scope.switches}
    # Not counted, through all phases: kernels are loaded, and compiled where they never were.
    _train(replace(scope, steps=8), StepClock())
    clocks = {name: StepClock() for name in variants}
    rounds = 1 if scope.quick else 2
    for name in [*variants, *reversed(variants)][: rounds * len(variants)]:
        with switched(**variants[name]):
            _train(scope, clocks[name])
    if regions:
        parts = StepClock(regions)
        regions.emulate(max(scope.emulate))
        for _ in range(rounds):
            _train(scope, parts)
        regions.emulate(0)
        clocks["between kernels"] = parts.expected(0)
        clocks |= {f"{cores}-core machine, expected": parts.expected(cores) for cores in scope.emulate}
    scene = "demo" if scope.photos is None else scope.photos.resolve().name
    described = f"{scene}, {Path(_config(scope)).name}, {scope.steps} steps"
    shipped = clocks["as shipped"]
    for name, clock in clocks.items():
        samples = [took for _, took in clock.steps]
        values = {
            "PSNR dB": clock.psnr,
            "seconds": sum(samples) / 1000 / rounds,
            "times as shipped": clock.relative / shipped.relative,
            **clock.by_phase,
            "splats": clock.splats,
        }
        if name.startswith("no skip"):
            values["saves %"] = 100 * (1 - shipped.relative / clock.relative)
        yield Measurement("run", described, name, samples, clock.products, values)


def _test_psnr(module: SplatModule) -> float:
    data: ColmapDataModule = module.trainer.datamodule  # type: ignore[attr-defined]  # Lightning does not type it
    return evaluate(module.scene.render, module.scene.hard_splats(module.phase), data.test_dataloader())[0]
