"""Suite ``train``: whole runs of a config, PSNR against seconds; the parts of their steps.

Runs are those of ``nsvq fit``: its module, data, callbacks, loggers and trainer. What only watches a run (reports,
checkpoints, the progress bar) is left out, and test views are compared while the clock is stopped. Every run has the
same number of steps. Variants differ from the first one in one thing. Where one promises the same bits, the column
``other numbers`` checks it: it counts the trained numbers that are not those of the first row.
"""

import cProfile
import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple, cast

import numba
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.commands.arguments import find_config
from nsvq_lightning.commands.benchmark import Scope, timing
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import View
from nsvq_lightning.report.files import evaluate
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

log = logging.getLogger(__name__)

# Callbacks of ``nsvq fit`` that write files or lines but train nothing; the benchmark measures by itself.
WATCHING = ("report", "export", "predictions", "checkpoint", "kernels", "progress")
QUICK_DEMO = ("--data.factor=4",)
SHIPPED, WHOLE, OUTSIDE = "as shipped", "whole step", "between the functions"


def run(scope: Scope) -> Iterator[timing.Measurement]:
    """Train with every variant, then profile the steps of a run."""
    yield from run_rows(scope)
    if sys.version_info < (3, 12) or numba.config.ENABLE_SYS_MONITORING:
        yield from part_rows(scope)
    else:
        log.warning("train: no profile: it shows kernels only if NUMBA_ENABLE_SYS_MONITORING=1 when Numba is loaded")


class Step(NamedTuple):
    """One step: its 1-based iteration, its phase, and milliseconds."""

    iteration: int
    phase: Phase
    milliseconds: float


class StepClock(Callback):
    """Times steps from the end of one to the end of the next: data, hooks, loggers and loops are in it.

    Args:
        between: Called after each step with the module and the step; not in the time.
    """

    def __init__(self, between: Callable[[SplatModule, Step], None]) -> None:
        self._between = between
        self._since = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the first step."""
        self._since = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: View, batch_idx: int
    ) -> None:
        """End a step, the work of a GPU included, and start the next."""
        timing.finish()
        took = 1000 * (time.perf_counter() - self._since)
        module = cast(SplatModule, pl_module)
        self._between(module, Step(trainer.global_step, module.phase, took))
        self._since = time.perf_counter()


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


def _train(
    scope: Scope, threads: int, between: Callable[[SplatModule, Step], None], options: Sequence[str] = ()
) -> SplatModule:
    """Train ``scope.steps`` iterations of the config on the scene, or on the demo scene if that is no folder of photos.

    Args:
        scope: Says which config, scene, first splats and length.
        threads: Of torch and of the kernels.
        between: Called after every step.
        options: Further ones of ``nsvq fit``.

    Returns:
        What was trained.
    """
    data: tuple[str, ...] = ("--data=ColmapDataModule", f"--data.root={scope.photos}")
    if scope.photos is None:
        data = ("--data=DemoDataModule", *(QUICK_DEMO if scope.quick else ()))
    if scope.init_from is not None:
        data += (f"--model.init_from={scope.init_from}",)
    logging.disable(logging.WARNING)  # of Lightning, about devices, loaders and the end of the run
    try:
        with (
            tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder,
            timing.use_threads(threads),
            warnings.catch_warnings(action="ignore"),
        ):
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
    finally:
        logging.disable(logging.NOTSET)
    return module


def _config(scope: Scope) -> str:
    return scope.config or ("fast.yaml" if scope.photos else "demo.yaml")


def _run_name(scope: Scope) -> str:
    """The run in the tables."""
    scene = "demo" if scope.photos is None else scope.photos.resolve().name
    return f"{scene}, {Path(_config(scope)).name}, {scope.steps} steps"


# Whole runs


class Watched:
    """What is seen of the runs of one variant; its ``between`` is called between their steps.

    Attributes:
        steps: All steps.
        psnr: Of the test views, in dB, at the end of the last run.
        products: Matrix products in between, ms.
        numbers: Everything that the first run has trained, by name.
    """

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.psnr = 0.0
        self.products: list[float] = []
        self.numbers: Mapping[str, Tensor] = {}
        self._product = timing.sgemm()

    def between(self, module: SplatModule, step: Step) -> None:
        """Keep a step, and compare the test views after the last."""
        self.steps.append(step)
        if step.iteration == module.trainer.max_steps:
            self.psnr = _test_psnr(module)
        if step.iteration % 8 == 0 or not self.products:
            self.products.append(timing.milliseconds(self._product))

    @property
    def timing(self) -> timing.Timing:
        """Times of all steps."""
        return timing.Timing(tuple(step.milliseconds for step in self.steps), tuple(self.products))

    @property
    def relative(self) -> float:
        """The mean step in matrix products, so that a busy machine is not mistaken for a slow variant."""
        return fmean(self.timing.samples) / median(self.products)


def run_rows(scope: Scope) -> Iterator[timing.Measurement]:
    """A row as shipped, for fewer threads, and without codebooks or for each inverted switch that is asked for."""
    most, rounds = max(scope.threads), 1 if scope.quick else 2
    variants: dict[str, tuple[int, tuple[str, ...]]] = {SHIPPED: (most, ())}
    variants |= {f"{n} thread{'s' * (n > 1)}": (n, ()) for n in scope.threads if n != most}
    variants |= {f"no skip of {name}": (most, (f"--skips.{name}=false",)) for name in scope.switches}
    if not scope.switches:
        variants["without codebooks"] = most, ("--model.codebooks=null",)
    # Not counted, through all phases: kernels are loaded, and compiled where they never were.
    _train(replace(scope, steps=8), most, lambda module, step: None)
    found = {name: Watched() for name in variants}
    for turn in range(rounds):
        order = list(variants)
        for name in order[turn:] + order[:turn]:
            module = _train(scope, variants[name][0], found[name].between, variants[name][1])
            found[name].numbers = found[name].numbers or {n: p.detach() for n, p in module.named_parameters()}
    shipped = found[SHIPPED]
    for name, watched in found.items():
        by_phase: dict[Phase, list[float]] = {}
        for step in watched.steps:
            by_phase.setdefault(step.phase, []).append(step.milliseconds)
        values = {
            "PSNR dB": watched.psnr,
            "seconds": sum(watched.timing.samples) / 1000 / rounds,
            "times as shipped": watched.relative / shipped.relative,
            **{f"{phase.name.lower()} ms": median(times) for phase, times in by_phase.items()},
            "splats": float(len(watched.numbers["splats.means"])),
            "other numbers": float(different_numbers(watched.numbers, shipped.numbers)),
        }
        if name.startswith("no skip"):
            values["saves %"] = 100 * (1 - shipped.relative / watched.relative)
        threads = variants[name][0]
        note = "times are of whole steps, those that start a phase included; PSNR is that of the test views"
        yield timing.Measurement("run", _run_name(scope), name, threads, watched.timing, values, note)


@torch.no_grad()
def _test_psnr(module: SplatModule) -> float:
    data: ColmapDataModule = module.trainer.datamodule  # type: ignore[attr-defined]  # Lightning does not type it
    splats, views = module.hard_splats(module.phase), data.test_dataloader()
    return evaluate(lambda camera: module.render_splats(splats, camera).image, views, module.device)[0]


def different_numbers(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> int:
    """Numbers of ``found`` that are not bit for bit those of ``expected``; all of a tensor of another shape."""
    different = 0
    for name, tensor in found.items():
        other = expected.get(name)
        if other is None or other.shape != tensor.shape:
            different += tensor.numel()
        else:
            different += int((tensor.view(torch.int32) != other.view(torch.int32)).sum())
    return different


# The parts of a step


class StepSampler:
    """Times all steps of a run, every second one under cProfile; its ``between`` is called between the steps.

    cProfile gives each Python function and each Numba kernel the time that it spends in itself. An operator of torch
    counts for the Python function that called it.

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
        self._last, self._product = last, timing.sgemm()
        self._profiler = cProfile.Profile(builtins=False, subcalls=False)

    def between(self, module: SplatModule, step: Step) -> None:
        """Keep a step, and profile the next if it is its turn."""
        self._profiler.disable()
        stats = self._profiler.getstats()
        self._profiler.clear()
        files = {getattr(each, "__dict__", {}).get("__file__"): name for name, each in list(sys.modules.items())}
        parts: dict[str, float] = {}
        for entry in cast(list[Any], stats):
            # Our modules, each by itself; of other packages only their name.
            package, _, ours = files.get(entry.code.co_filename, "elsewhere").partition(".")
            name = ours if package == "nsvq_lightning" else package
            parts[name] = parts.get(name, 0.0) + 1000 * entry.inlinetime
        if parts:
            self.profiled.append((step, parts))
        else:
            self.plain.append(step)
        # After each step, a product would empty the caches for the next. After every third, steps with and without
        # cProfile come after a product equally often.
        if step.iteration % 3 == 0:
            self.products.append(timing.milliseconds(self._product))
        if step.iteration % 2 == 0 and step.iteration < self._last:
            self._profiler.enable()


def part_rows(scope: Scope) -> Iterator[timing.Measurement]:
    """A table of parts for each phase, whose sum is the whole step, with the largest number of threads."""
    threads, sampler = max(scope.threads), StepSampler(scope.steps)
    _train(scope, threads, sampler.between)
    for phase in Phase:
        plain = [step.milliseconds for step in sampler.plain if step.phase is phase]
        steps = sorted((each for each in sampler.profiled if each[0].phase is phase), key=lambda e: e[0].milliseconds)
        # What is outside the middle half had a disturbance or a pause.
        steps = steps[len(steps) // 4 : len(steps) - len(steps) // 4]
        if not steps or not plain:
            continue  # a short run may have no step of a phase
        found = {WHOLE: [step.milliseconds for step, _ in steps]}
        names = {name for _, parts in steps for name in parts}
        times = {name: [parts.get(name, 0.0) for _, parts in steps] for name in names}
        times[OUTSIDE] = [step.milliseconds - sum(parts.values()) for step, parts in steps]
        little = [name for name in names if sum(times[name]) < 0.01 * sum(found[WHOLE])]
        if little:
            times["others"] = [sum(each) for each in zip(*(times.pop(name) for name in little), strict=True)]
        found |= dict(sorted(times.items(), key=lambda item: -sum(item[1])))
        note = f"cProfile is in the times: without it the median step takes {median(plain):.3g} ms"
        for name, samples in found.items():
            values = {"share %": 100 * fmean(samples) / fmean(found[WHOLE])}
            took, operation = timing.Timing(tuple(samples), tuple(sampler.products)), f"{phase.name.lower()} step"
            yield timing.Measurement(f"parts of a {operation}", _run_name(scope), name, threads, took, values, note)
