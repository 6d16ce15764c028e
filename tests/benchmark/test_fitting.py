from __future__ import annotations

import itertools
import logging
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nsvq_lightning.commands.benchmark import fitting
from nsvq_lightning.commands.benchmark.fitting import Step, StepClock, fit, one_phase, quiet, training_callbacks
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

PAUSE = 0.1
CODES = {"scales": 24, "quats": 24, "sh0": 16, "shN": 16}


@pytest.mark.parametrize("phase", Phase)
def test_steps_of_one_phase_are_timed_without_what_is_between(phase: Phase, demo_scene: Path) -> None:
    seen: list[tuple[str, Step]] = []

    def between(module: SplatModule, view: Any, step: Step) -> None:
        seen.append((view.name, step))
        time.sleep(PAUSE)

    clock = StepClock(between)
    module = SplatModule(sh_degree=1, codebooks=CODES)
    start = time.perf_counter()
    fit(module, ColmapDataModule(str(demo_scene)), [*training_callbacks(phases=one_phase(phase, 4)), clock], 4)
    elapsed = time.perf_counter() - start
    assert [step for _, step in seen] == clock.steps
    assert [step.iteration for step in clock.steps] == [1, 2, 3, 4]
    first = Phase.QUANTIZE if phase is Phase.FINETUNE else phase
    assert [step.phase for step in clock.steps] == [first, phase, phase, phase]
    assert min(step.milliseconds for step in clock.steps) > 0
    assert sum(step.milliseconds for step in clock.steps) / 1000 < elapsed - 4 * PAUSE
    assert len({name for name, _ in seen}) == 4


def test_steps_that_are_timed_together_are_waited_for_once(demo_scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[int] = []
    seconds = itertools.count()
    monkeypatch.setattr(fitting, "finish", lambda: waits.append(0))
    monkeypatch.setattr(fitting, "time", SimpleNamespace(perf_counter=lambda: next(seconds)))
    clock = StepClock(lambda *_: None, together=4)
    schedule = one_phase(Phase.PRUNE, 9)
    fit(SplatModule(sh_degree=1, codebooks=CODES), ColmapDataModule(str(demo_scene)), [schedule, clock], 9)
    assert clock.steps == [Step(4, Phase.PRUNE, 250), Step(8, Phase.PRUNE, 250)]
    assert len(waits) == 2


def test_callbacks_are_those_of_the_command_that_train() -> None:
    names = [type(callback).__name__ for callback in training_callbacks()]
    assert names[0] == "PhaseSchedule"
    assert {"DensityControl", "CodebookInit", "FreezeCodes"} < set(names)
    assert not {"MetricReport", "RunCheckpoint", "SplatProgressBar", "ExportScene"} & set(names)
    mine = one_phase(Phase.PRUNE, 7)
    assert training_callbacks(phases=mine)[0] is mine


def test_lightning_may_speak_again_afterwards() -> None:
    logger = logging.getLogger("lightning.pytorch")
    before = logger.level
    with quiet():
        assert logger.level == logging.ERROR
    assert logger.level == before
