"""When codes are replaced and codebooks refitted, which, and by which process; frozen codes stay with their splats."""

from __future__ import annotations

import logging
import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from runs import paper_replacement
from splat_scenes import ball, front_camera
from torch import Tensor

from nsvq_lightning.callbacks import (
    CodebookInit,
    CodebookRefit,
    CodebookReplacement,
    FreezeCodes,
    OpacityRegularization,
    RateDistortion,
    ShDegreeSchedule,
)
from nsvq_lightning.callbacks.base import keep_finite_splats
from nsvq_lightning.callbacks.quantization import perplexity
from nsvq_lightning.data.scene import View
from nsvq_lightning.quantize import NSVQ, StraightThrough
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training import distributed, run_scene
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.row_ops import append_rows, keep_rows
from nsvq_lightning.training.schedule import Phase, Schedule


def host(**values: Any) -> Any:
    return SimpleNamespace(schedule=Schedule(), **values)


@pytest.mark.parametrize("total", [500, 1000, 1500, 2000, 4500, 7000, 20_000])
def test_no_window_of_a_short_run_is_below_the_limit(total: int) -> None:
    """The first counts from the start of the phase: codes that few views could hit are not out of use."""
    schedule = Schedule(total=total)
    short: Any = SimpleNamespace(schedule=schedule)
    due = [i for i in range(1, total + 1) if paper_replacement().is_due(short, i)]
    windows = [b - a for a, b in pairwise([schedule.ends[Phase.PRUNE], *due])]
    assert min(windows) >= 49  # 50, but for the rounding of both ends
    assert len(windows) >= 2


def test_replacement_stops_as_long_before_codes_freeze_as_asked_for() -> None:
    """Also where a longer fine-tune phase ends the quantize phase earlier."""
    callback = paper_replacement(end=40_000)
    for total in (1500, 2000, 4500, 9000):
        schedule = Schedule(total=total)
        short: Any = SimpleNamespace(schedule=schedule)
        last = max(i for i in range(1, total + 1) if callback.is_due(short, i))
        assert schedule.ends[Phase.QUANTIZE] - last >= round(3000 * schedule.scale)


@pytest.mark.parametrize("ends", [{}, {"prune_end": 45_000, "quantize_end": 45_000}])
def test_measurements_are_due_in_the_quantize_phase_alone(ends: dict[str, int]) -> None:
    schedule = Schedule(**ends)
    long: Any = SimpleNamespace(schedule=schedule)
    due = [i for i in range(1, schedule.total + 1) if RateDistortion().is_due(long, i)]
    assert all(schedule.phase_at(iteration) is Phase.QUANTIZE for iteration in due)
    assert len(due) == (0 if ends else 3)


def test_a_bit_costs_what_splats_miss_and_no_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = torch.rand(2, 24, 32, 3, generator=generator(0, 0, "picture"))
    image, photo = 0.2 + 0.6 * seen[0], 0.2 + 0.6 * (0.9 * seen[0] + 0.1 * seen[1])
    splats = ball(9).tensors()
    module = host(
        scene=SimpleNamespace(hard_splats=lambda _: splats),
        quantizers={"scales": StraightThrough(4, 3)},
        splats=splats.means,
        seed=0,
        device="cpu",
    )
    prices = []
    for shown in (photo, 0.6 * photo):
        found = [(View("a", 0, front_camera(32, 24), shown), splats, image)]
        monkeypatch.setattr(run_scene, "train_sensitivities", lambda *_, found=found: found)
        rates = RateDistortion()
        rates._measure(cast(Any, SimpleNamespace(world_size=1)), module)
        prices.append(rates.prices["scales"])
    # What splats miss of a darker photo is as much smaller.
    torch.testing.assert_close(prices[1], 0.36 * prices[0], rtol=0.1, atol=0)


@pytest.mark.parametrize(
    ("usage", "expected"), [([0, 0, 0], 0.0), ([5, 0, 0], 1.0), ([3, 3, 3], 3.0), ([1, 1, 2], 2.0 * 2**0.5)]
)
def test_perplexity_by_hand(usage: list[int], expected: float) -> None:
    assert perplexity(torch.tensor(usage)) == pytest.approx(expected)


def test_lambda_acts_in_the_prune_phase_only() -> None:
    callback = OpacityRegularization()
    opacities = torch.randn(50, generator=generator(1))
    module = host(loss_terms={}, splats=SimpleNamespace(opacities=opacities))
    values = {}
    for step in (0, 14_999, 15_000, 19_999, 20_000):
        callback.on_train_batch_start(SimpleNamespace(global_step=step), module, None, 0)  # type: ignore[arg-type]
        values[step + 1] = [float(term(None, None)) for term in module.loss_terms.values()]
    expected = pytest.approx([1e-7 * float(opacities.sigmoid().sum())])
    assert values == {1: [], 15_000: [], 15_001: expected, 20_000: expected, 20_001: []}
    module.loss_terms["opacity"] = None  # of a run that ends in the phase
    callback.on_train_end(SimpleNamespace(), module)  # type: ignore[arg-type]
    assert not module.loss_terms


def test_photos_that_weights_need_are_missed_at_the_start() -> None:
    trainer: Any = SimpleNamespace(datamodule=None)
    module: Any = SimpleNamespace(quantizers={"scales": NSVQ(4, 3)})
    with pytest.raises(ValueError, match=r"need the train views: .*CodebookInit\(weighted=False\)"):
        CodebookInit().before_fit(trainer, module)
    CodebookInit(weighted=False).before_fit(trainer, module)


def test_the_sh_degree_grows_up_to_that_of_the_splats() -> None:
    callback = ShDegreeSchedule(every=1000)
    module = host(active_sh_degree=0, splats=SimpleNamespace(sh_degree=2))
    degrees = {}
    for step in (0, 998, 999, 1999, 2999, 40_000):
        callback.on_train_batch_start(SimpleNamespace(global_step=step), module, None, 0)  # type: ignore[arg-type]
        degrees[step + 1] = module.active_sh_degree
    assert degrees == {1: 0, 999: 0, 1000: 1, 2000: 2, 3000: 2, 40_001: 2}


@pytest.mark.parametrize("rank", [0, 1])
def test_usage_of_several_processes_is_saved_and_resumed_once(rank: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of two processes that counted the same; the checkpoint holds the buffers of the first.
    monkeypatch.setattr(distributed, "all_reduce", lambda tensor: tensor.mul_(2))
    quantizer = NSVQ(4, 3)
    module: Any = host(quantizers={"scales": quantizer})
    trainer: Any = SimpleNamespace(
        world_size=2,
        is_global_zero=rank == 0,
        optimizers=[build_adam(param_groups(Splats(), {"scales": quantizer}, LearningRates(), 1.0))],
    )
    quantizer.usage.copy_(torch.tensor([3, 0, 1, 0]))
    quantizer.window.fill_(5)
    CodebookReplacement().on_save_checkpoint(trainer, module, {})
    assert quantizer.usage.tolist() == ([0, 0, 0, 0] if rank else [6, 0, 2, 0])
    assert int(quantizer.window) == (0 if rank else 10)
    # A resumed process starts from the checkpoint, whichever it is.
    quantizer.usage.copy_(torch.tensor([6, 0, 2, 0]))
    quantizer.window.fill_(10)
    CodebookReplacement().on_train_start(trainer, module)
    assert quantizer.usage.tolist() == ([0, 0, 0, 0] if rank else [6, 0, 2, 0])
    assert int(quantizer.window) == (0 if rank else 10)


ROWS = torch.randn(50, 3, generator=generator(0))


class Processes:
    """A trainer that knows of ``count`` processes and is number ``rank``; the first one broadcasts ``sent``."""

    def __init__(self, count: int = 1, rank: int = 0, sent: Tensor | None = None) -> None:
        self.world_size, self.is_global_zero, self.global_step = count, rank == 0, 20_099
        self.sent = sent
        self.strategy = SimpleNamespace(broadcast=lambda tensor: tensor if sent is None else sent)


def refit(trainer: Any, steps: int = 2) -> dict[str, Any]:
    """The quantizers of a host after the first refit of the paper's run."""
    quantizers = {"scales": StraightThrough(4, 3), "quats": NSVQ(4, 3)}
    for quantizer in quantizers.values():
        quantizer.fit(ROWS - 1)
    scene = SimpleNamespace(rows=lambda name: ROWS)
    host: Any = SimpleNamespace(schedule=Schedule(), quantizers=quantizers, scene=scene, trainer=trainer)
    CodebookRefit(steps=steps).on_before_optimizer_step(trainer, host, None)  # type: ignore[arg-type]
    return quantizers


def test_only_quantizers_that_offer_it_are_refitted() -> None:
    start, expected = StraightThrough(4, 3), StraightThrough(4, 3)
    for quantizer in (start, expected):
        quantizer.fit(ROWS - 1)
    expected.refit(ROWS, 2)
    quantizers = refit(Processes())
    assert torch.equal(quantizers["scales"].codebook, expected.codebook)
    assert not torch.equal(start.codebook, expected.codebook)
    assert torch.equal(quantizers["quats"].codebook, start.codebook)


def test_other_processes_take_over_what_the_first_fitted() -> None:
    sent = torch.full((4, 3), 7.0)
    assert torch.equal(refit(Processes(2, 1, sent))["scales"].codebook, sent)
    assert torch.equal(refit(Processes(2, 0))["scales"].codebook, refit(Processes())["scales"].codebook)


FIRST = 43_001


class Stage:
    """Four splats whose scales have the codes 0 to 3, at the start of fine-tuning."""

    def __init__(self) -> None:
        self.splats = Splats.from_tensors(
            means=torch.arange(12.0).view(4, 3),
            quats=torch.ones(4, 4),
            scales=torch.arange(4.0)[:, None].repeat(1, 3),
            opacities=torch.zeros(4),
            sh0=torch.zeros(4, 1, 3),
            shN=torch.zeros(4, 0, 3),
        )
        self.optimizer = build_adam(param_groups(self.splats, {}, LearningRates(), 1.0))
        self.quantizer = NSVQ(4, 3)
        with torch.no_grad():
            self.quantizer.codebook.copy_(self.splats.scales)
        self.quantizer.fitted.fill_(True)
        self.callback = FreezeCodes()
        self.trainer: Any = SimpleNamespace(optimizers=[self.optimizer], global_step=0, world_size=1)
        self.module: Any = SimpleNamespace(
            splats=self.splats,
            quantizers={"scales": self.quantizer},
            schedule=Schedule(),
            scene=SimpleNamespace(rows=lambda name: self.splats.scales.detach()),
            trainer=self.trainer,
        )
        assert self.module.schedule.first_of(Phase.FINETUNE) == FIRST

    def start(self, iteration: int) -> list[int]:
        """Start an iteration; the frozen codes."""
        self.trainer.global_step = iteration - 1
        self.callback.on_train_batch_start(self.trainer, self.module, None, 0)
        codes: list[int] = self.quantizer.codes.tolist()
        return codes

    def remove_first(self) -> None:
        keep_rows(self.splats, self.optimizer, torch.arange(len(self.splats)) > 0)

    def append_last(self) -> None:
        rows = RawSplats(*(value.detach()[-1:] for value in self.splats.raw()))
        append_rows(self.splats, self.optimizer, rows)


@pytest.mark.parametrize(
    ("edits", "expected"),
    [("remove_first", [1, 2, 3]), ("append_last", [0, 1, 2, 3, 3]), ("remove_first append_last", [1, 2, 3, 3])],
)
def test_codes_of_changed_splats_are_searched_again_with_one_warning(
    edits: str, expected: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    stage = Stage()
    assert stage.start(FIRST - 1) == []
    assert stage.start(FIRST) == [0, 1, 2, 3]
    with caplog.at_level(logging.WARNING):
        for edit in edits.split():
            getattr(stage, edit)()
        assert stage.start(FIRST + 1) == expected
        stage.remove_first()
        assert stage.start(FIRST + 2) == expected[1:]
    assert [record.message.partition(":")[0] for record in caplog.records] == [f"iteration {FIRST + 1}"]
    assert "codes of scales are searched again" in caplog.text


def test_frozen_codes_are_left_alone_where_splats_are() -> None:
    stage = Stage()
    stage.start(FIRST)
    with torch.no_grad():
        stage.splats.scales.zero_()  # all would have code 0 now
    assert stage.start(FIRST + 1) == [0, 1, 2, 3]


def test_codes_that_follow_an_edit_are_not_searched_again(caplog: pytest.LogCaptureFixture) -> None:
    stage = Stage()
    stage.start(FIRST)
    with torch.no_grad():
        stage.splats.scales.zero_()
        stage.splats.quats[1] = math.nan
    keep_finite_splats(stage.module)
    caplog.clear()
    assert stage.start(FIRST + 1) == [0, 2, 3]
    assert not caplog.records


def test_held_codes_follow_an_edit() -> None:
    stage = Stage()
    stage.quantizer.hold(torch.tensor([3, 3, 0, 1]))
    with torch.no_grad():
        stage.splats.quats[1] = math.nan
    keep_finite_splats(stage.module)
    assert stage.start(FIRST) == [3, 0, 1]


def test_a_resumed_run_keeps_the_codes_of_its_checkpoint() -> None:
    stage = Stage()
    stage.quantizer.freeze(torch.tensor([3, 3, 0, 1]))
    assert stage.start(FIRST + 5) == [3, 3, 0, 1]
    stage.remove_first()
    stage.callback = FreezeCodes()
    assert stage.start(FIRST + 6) == [1, 2, 3]
