"""What callbacks share: they need a SplatModule, act once per iteration, and refuse settings by name."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningModule
from runs import fit

from nsvq_lightning import callbacks
from nsvq_lightning.callbacks import (
    BudgetedGrowth,
    CanonicalCovariance,
    CodebookInit,
    CodebookRefit,
    CodebookReplacement,
    DensityControl,
    ExposureCompensation,
    FiniteCodes,
    FreezeCodes,
    LearningRateDecay,
    LiveScene,
    MetricReport,
    OpacityRegularization,
    PhaseSchedule,
    RateDistortion,
    RunCheckpoint,
    ShDegreeSchedule,
    SplatBudget,
    SplatSelection,
)
from nsvq_lightning.callbacks.base import SplatCallback
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Schedule

KINDS = [
    kind
    for name in callbacks.__all__
    if isinstance(kind := getattr(callbacks, name), type) and issubclass(kind, SplatCallback)
]


@pytest.mark.parametrize("kind", KINDS)
def test_another_module_is_refused_before_anything_starts(kind: type[Callback]) -> None:
    said = rf"{kind.__name__} needs a SplatModule: derive LightningModule from it"
    with pytest.raises(TypeError, match=said):
        kind().setup(SimpleNamespace(callbacks=[]), LightningModule(), "fit")  # type: ignore[arg-type]


class Acting(SplatCallback):
    """Notes the iterations before and after which it acts."""

    state = ("count",)
    count = 0

    def __init__(self) -> None:
        self.noted: list[tuple[str, int]] = []

    def before_step(self, trainer: Any, module: Any, iteration: int) -> None:
        self.noted.append(("before", iteration))

    def after_step(self, trainer: Any, module: Any, iteration: int) -> None:
        self.noted.append(("after", iteration))
        self.count += 1


def play(callback: Acting, steps: int, first: int = 0, micro_batches: int = 3) -> None:
    """Batches as Lightning hands them on with gradient accumulation."""
    trainer: Any = SimpleNamespace(global_step=first)
    for _ in range(steps):
        for batch in range(micro_batches):
            callback.on_train_batch_start(trainer, None, None, batch)  # type: ignore[arg-type]
            trainer.global_step += batch == micro_batches - 1
            callback.on_train_batch_end(trainer, None, {}, None, batch)  # type: ignore[arg-type]


def test_hooks_run_once_an_iteration_also_with_accumulation_and_after_a_resume() -> None:
    whole, stopped, resumed = Acting(), Acting(), Acting()
    play(whole, 3)
    assert whole.noted == [(hook, iteration) for iteration in (1, 2, 3) for hook in ("before", "after")]
    play(stopped, 2)
    # A checkpoint may have been written when the next iteration had begun.
    stopped.on_train_batch_start(SimpleNamespace(global_step=2), None, None, 0)  # type: ignore[arg-type]
    resumed.load_state_dict(stopped.state_dict())
    play(resumed, 1, first=2)
    assert resumed.noted == [("after", 3)]
    assert resumed.state_dict() == whole.state_dict()


@pytest.mark.parametrize(
    ("kind", "hook"),
    [
        (LearningRateDecay, "before_step"),
        (LiveScene, "before_step"),
        (MetricReport, "before_step"),
        (OpacityRegularization, "before_step"),
        (FreezeCodes, "after_step"),
    ],
)
def test_subclasses_may_act_at_each_step(demo_scene: Path, kind: type[SplatCallback], hook: str) -> None:
    noted: list[int] = []
    own: Any = type("Own", (kind,), {hook: lambda *arguments: noted.append(arguments[-1])})
    module = SplatModule(sh_degree=0, codebooks=None)
    fit(module, ColmapDataModule(str(demo_scene), factor=2), [PhaseSchedule(total=4), own()], 4)
    assert noted == [1, 2, 3, 4]


def test_numbers_of_numpy_become_plain_data_in_a_checkpoint(tmp_path: Path) -> None:
    """With them, it could be written and not be read."""
    callback = Acting()
    vars(callback).update(count=np.median([1, 2]), _acted={"after": np.int64(7)})
    torch.save(callback.state_dict(), tmp_path / "state")
    assert torch.load(tmp_path / "state", weights_only=True) == {"_acted": {"after": 7}, "count": 1.5}


def test_a_fit_starts_without_what_an_earlier_one_has_reached() -> None:
    callback = Acting()
    play(callback, 3)
    assert callback.count == 3
    callback.setup(SimpleNamespace(callbacks=[]), SplatModule(codebooks=None), "fit")  # type: ignore[arg-type]
    assert callback.state_dict() == Acting().state_dict()


def test_what_one_needs_of_another_is_on_the_module_whatever_their_order() -> None:
    """A budget in bytes counts on codes that are chosen by their bits, and a length in minutes on how splats grow."""
    found = []
    for strength in (0.5, 2.0):
        rates = RateDistortion(strength=strength)
        for order in ([0, 1], [1, 0]):
            module, both = SplatModule(), (SplatBudget(bytes=1_000_000), rates)
            trainer: Any = SimpleNamespace(callbacks=[both[place] for place in order])
            for callback in trainer.callbacks:
                callback.setup(trainer, module, "fit")
            found.append(module.splat_budget)
    assert found[0] == found[1]
    assert found[2] == found[3]
    assert found[0] is not None
    assert found[2] is not None
    assert found[0] < found[2]


LONG = range(1, 45_001)
DUE: list[tuple[SplatCallback, Iterable[int]]] = [
    (DensityControl(), [*range(600, 14_901, 100), *range(16_000, 20_001, 1000)]),
    (BudgetedGrowth(start=300), range(400, 15_001, 100)),
    (SplatSelection(), [15_001]),
    (OpacityRegularization(), range(15_001, 20_001)),
    (CanonicalCovariance(), [20_000]),
    (CodebookInit(), [20_001]),
    (FreezeCodes(), [43_001]),
    (MetricReport(every=0), [15_000, 20_000, 43_000, 45_000]),
    (RunCheckpoint(every=20_000), [15_000, 20_000, 40_000, 43_000, 45_000]),
]


@pytest.mark.parametrize(("callback", "iterations"), DUE)
def test_callbacks_say_when_they_act(callback: Any, iterations: Iterable[int]) -> None:
    """Oracle: the iterations of the paper's run, written down."""
    module = SimpleNamespace(schedule=Schedule())
    assert [iteration for iteration in LONG if callback.is_due(module, iteration)] == list(iterations)


OUT_OF_RANGE = [
    (PhaseSchedule, {"warmup_end": 30_000}, "phase ends must satisfy"),
    (PhaseSchedule, {"iterations_per_photo": 0}, "iterations_per_photo must be at least 1, got 0"),
    (ShDegreeSchedule, {"every": 0}, "every must be at least 1, got 0"),
    (LearningRateDecay, {"final": 0.0}, r"final must be in \(0, 1\], got 0.0"),
    (SplatBudget, {"splats": 5, "bytes": 5}, "splats and bytes both say how large the scene is to be"),
    (SplatBudget, {"bytes": 0}, "bytes must be at least 1, got 0"),
    (DensityControl, {"every": 0}, "every must be at least 1, got 0"),
    (DensityControl, {"min_opacity": 0.0}, "min_opacity must be between 0 and 1, got 0.0"),
    (DensityControl, {"shrink": 0.0}, "shrink must be above 0, got 0.0"),
    (DensityControl, {"grad_threshold": -1.0}, "grad_threshold must be at least 0, got -1.0"),
    (DensityControl, {"reset_last": None}, "reset_last must have a value, got None"),
    (PhaseSchedule, {"warmup_end": None}, "warmup_end must have a value, got None"),
    (DensityControl, {"max_splats": 3}, "max_splats must be at least min_splats=10, got 3"),
    (BudgetedGrowth, {"start": -1}, "start must be at least 0, got -1"),
    (BudgetedGrowth, {"grad_threshold": math.nan}, "grad_threshold must be at least 0, got nan"),
    (BudgetedGrowth, {"start": 900, "full": 900}, "growth must be full after its start=900, got full=900"),
    (BudgetedGrowth, {"recovery_share": 1.0}, r"recovery_share must be in \[0, 1\), got 1.0"),
    (BudgetedGrowth, {"budget": 1}, "budget must be at least min_splats=10, got 1"),
    (BudgetedGrowth, {"overshoot": 0.9}, "overshoot must be at least 1, got 0.9"),
    (SplatSelection, {"budget": 0}, "budget must be at least 1, got 0"),
    (OpacityRegularization, {"weight": -1.0}, "weight must be at least 0, got -1.0"),
    (CodebookInit, {"values_per_splat": math.inf}, "values_per_splat must be above 0, got inf"),
    (CodebookRefit, {"steps": 0}, "steps must be at least 1, got 0"),
    (CodebookReplacement, {"early_end": 100}, "needs start <= early_end <= end, got 10700, 100 and 12000"),
    (CodebookReplacement, {"late_every": 0}, "late_every must be at least 1, got 0"),
    (CodebookReplacement, {"jitter": 0.0}, r"jitter must be in \(0, 1\], got 0.0"),
    (FiniteCodes, {"every": 0}, "every must be at least 1, got 0"),
    (RateDistortion, {"strength": math.nan}, "strength must be above 0, got nan"),
    (MetricReport, {"every": -1}, "every must be at least 0, got -1"),
    (RunCheckpoint, {"every": -1}, "every must be at least 0, got -1"),
    (ExposureCompensation, {"rate": math.inf}, "rate must be above 0, got inf"),
]


@pytest.mark.parametrize(("kind", "settings", "message"), OUT_OF_RANGE)
def test_settings_out_of_range_are_refused(kind: type[Callback], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**settings)
