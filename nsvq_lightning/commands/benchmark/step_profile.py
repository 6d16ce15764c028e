"""The parts of a training step: which functions belong to each, and what a profile of a step says about them.

cProfile gives each Python function and each Numba kernel the time that it spends in itself. An operator of torch counts
for the Python function that called it.
"""

from __future__ import annotations

import cProfile
import sys
from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numba

from nsvq_lightning.commands.benchmark.fitting import Step
from nsvq_lightning.commands.benchmark.suite_list import Unavailable
from nsvq_lightning.commands.benchmark.timing import milliseconds, sgemm
from nsvq_lightning.data.scene import View

__all__ = ["OTHER", "OUTSIDE", "PARTS", "WHOLE", "Own", "StepSampler", "part_of"]

WHOLE, OTHER, OUTSIDE = "whole step", "other Python", "between the functions"

CPU = "nsvq_lightning.rendering.cpu"
QUANTIZE = "nsvq_lightning.quantize"

PARTS = {
    "data": ("nsvq_lightning.data.*", "torch.utils.data.*", "lightning.pytorch.loops.fetchers.*"),
    "project": (f"{CPU}.projection.project_splats", f"{CPU}.projection.find_visible"),
    "SH and records": (f"{CPU}.projection.finish_records",),
    "sort": (f"{CPU}.binning.sort_by_depth",),
    "bin": (f"{CPU}.binning.count_tiles", f"{CPU}.binning.fill_tiles"),
    "blend": (f"{CPU}.blend.blend",),
    "blend backward": (f"{CPU}.blend.blend_backward", f"{CPU}.blend.total_slots"),
    "projection backward": (f"{CPU}.projection_backward.project_backward",),
    "density statistics": (f"{CPU}.statistics.*", "nsvq_lightning.callbacks.density.*"),
    "rasterizer, its Python": ("nsvq_lightning.rendering.*",),
    "loss": ("nsvq_lightning.quality.*",),
    "Adam": ("nsvq_lightning.training.optim.*", "torch.optim.*"),
    "rows of visible splats": ("nsvq_lightning.compute.rows.*",),
    "buffers, checks and thread counts": ("nsvq_lightning.compute.*",),
    "quantizer: noise backward": (
        f"{QUANTIZE}.substitution.*backward*",
        f"{QUANTIZE}.substitution._add_parts",
        f"{QUANTIZE}.nsvq.*.backward",
    ),
    "quantizer: noise": (f"{QUANTIZE}.substitution.*", f"{QUANTIZE}.nsvq.*"),
    "quantizer: count": (f"{QUANTIZE}.codebook.CodebookQuantizer.count", f"{QUANTIZE}.kmeans.*count_hits"),
    "quantizer: decode": (
        f"{QUANTIZE}.kmeans.*",
        f"{QUANTIZE}.codebook.CodebookQuantizer.decode",
        f"{QUANTIZE}.attributes.*",
    ),
    "quantizer: search": (f"{QUANTIZE}.*",),
    "other callbacks": ("nsvq_lightning.callbacks.*",),
    "module, its Python": ("nsvq_lightning.*",),
    "autograd's own": ("torch.autograd.graph.*",),
    "torch's Python": ("torch.*",),
    "Lightning": ("lightning.*", "contextlib.*"),
}
"""Parts by the functions that belong to them; the first pattern that fits counts. The rest is :data:`OTHER`."""


PRODUCT_EVERY = 3
"""Steps between two matrix products: one after each step would empty the caches for the next. An odd number, so that
steps with and without cProfile come after a product equally often."""


class Own(NamedTuple):
    """What a part takes in a step, and how many calls of its functions that is."""

    milliseconds: float = 0.0
    calls: int = 0


class StepSampler:
    """Times all steps of a run, every second one under cProfile; passed to a clock of steps, which calls it after each.

    Args:
        first: Steps up to this iteration are left out.
        last: Last iteration.

    Attributes:
        plain: The steps without cProfile.
        profiled: Those with it, and what each part took.
        products: Matrix products in between, ms.

    Raises:
        Unavailable: Kernels would not show in a profile.
    """

    def __init__(self, first: int, last: int) -> None:
        if sys.version_info >= (3, 12) and not numba.config.ENABLE_SYS_MONITORING:
            raise Unavailable("kernels show in a profile only if NUMBA_ENABLE_SYS_MONITORING=1 when Numba is loaded")
        self.plain: list[Step] = []
        self.profiled: list[tuple[Step, dict[str, Own]]] = []
        self.products: list[float] = []
        self._first, self._last = first, last
        self._product = sgemm()
        self._profiler = cProfile.Profile(builtins=False, subcalls=False)

    def __call__(self, _: Any, __: View, step: Step) -> None:
        """Keep a step, and profile the next if it is its turn."""
        self._profiler.disable()
        parts = _parts(self._profiler.getstats())
        self._profiler.clear()
        if parts:
            self.profiled.append((step, parts))
        elif step.iteration > self._first:
            self.plain.append(step)
        if step.iteration % PRODUCT_EVERY == 0:
            self.products.append(milliseconds(self._product))
        if self._first <= step.iteration < self._last and step.iteration % 2 == 0:
            self._profiler.enable()


def _parts(stats: Iterable[Any]) -> dict[str, Own]:
    """What each part takes, from the entries of a profile."""
    modules = {getattr(module, "__dict__", {}).get("__file__"): name for name, module in list(sys.modules.items())}
    parts: dict[str, Own] = {}
    for entry in stats:
        file = entry.code.co_filename
        name = part_of(f"{modules.get(file, file)}.{entry.code.co_qualname}")
        before = parts.get(name, Own())
        parts[name] = Own(before.milliseconds + 1000 * entry.inlinetime, before.calls + entry.callcount)
    return parts


def part_of(function: str) -> str:
    """The part that a function belongs to, by its full name: ``nsvq_lightning.rendering.cpu.blend.blend``."""
    fitting = (part for part, patterns in PARTS.items() if any(fnmatchcase(function, p) for p in patterns))
    return next(fitting, OTHER)
