"""The progress of a run: lines in a file, a bar of 80 columns on a terminal, and a time without compilation."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm
from numba import njit

from nsvq_lightning.callbacks import progress
from nsvq_lightning.callbacks.progress import SplatProgressBar
from nsvq_lightning.compute import jit
from nsvq_lightning.compute.jit import compile_seconds
from nsvq_lightning.training.module import SplatModule


def compiled() -> Callable[[float], float]:
    """A kernel that nobody has called yet."""

    def add(x: float) -> float:
        return x + 1.0

    kernel: Callable[[float], float] = njit(add)
    jit._ours.add(kernel)  # as those that are kept on the disk, which this one is not
    return kernel


def test_the_clock_counts_compilation() -> None:
    kernel, before = compiled(), compile_seconds()
    assert kernel(1.0) == 2.0
    took = compile_seconds() - before
    assert took > 0
    kernel(2.0)
    assert compile_seconds() - before == took
    assert kernel(np.float32(1.0)) == 2.0  # other types are another compilation
    assert compile_seconds() - before > took


@pytest.mark.parametrize("hours", [0, 20])
def test_a_bar_of_the_longest_run_fits_80_columns(hours: int) -> None:
    out = io.StringIO()
    bar = Tqdm(total=45_000, bar_format=SplatProgressBar.BAR_FORMAT, file=out, ncols=80, smoothing=0)
    bar.start_t -= 3600 * hours
    bar.n = 45_000 // 2
    bar.set_postfix_str(f"quantize {progress.Tqdm.format_sizeof(1_234_567)} splats train 31.3 test 31.64")
    (line,) = [part for part in out.getvalue().split("\r") if "quantize" in part]
    assert len(line.rstrip()) <= 80
    assert line.rstrip().endswith("quantize 1.23M splats train 31.3 test 31.64")
    bar.close()


def test_a_second_run_has_lines_of_its_own_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open(tmp_path / "log.txt", "w") as file:
        monkeypatch.setattr(sys, "stdout", file)
        bar = SplatProgressBar()
        for steps, rate in ((10_000, 200), (100, 25)):
            bar.setup(Trainer(logger=False, max_steps=steps), SplatModule(), "fit")
            assert bar.refresh_rate == rate


def test_what_is_no_terminal_gets_lines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with open(tmp_path / "log.txt", "w") as file:
        monkeypatch.setattr(sys, "stdout", file)
        bar = SplatProgressBar()
        bar.setup(Trainer(logger=False, max_steps=9), SplatModule(), "test")
        assert bar.is_disabled
        monkeypatch.setitem(sys.modules, "ipykernel", jit)
        bar.setup(Trainer(logger=False, max_steps=9), SplatModule(), "test")
        assert not bar.is_disabled


class Closed(io.StringIO):
    """A pipe whose reader has gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")


def test_a_run_goes_on_where_nobody_reads_its_lines(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sys, "stdout", Closed())
    bar = SplatProgressBar(refresh_rate=1)
    trainer = Trainer(logger=False, max_steps=9, default_root_dir=tmp_path)
    module = SplatModule()
    bar.setup(trainer, module, "fit")
    bar.on_train_start(trainer, module)
    for _ in range(2):
        bar.on_train_batch_end(trainer, module, None)
    assert caplog.text.count("the progress cannot be shown any more") == 1


class Terminal(io.StringIO):
    """What shows a bar."""

    def isatty(self) -> bool:
        return True


def test_the_bar_ends_with_a_new_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    monkeypatch.setattr(progress, "compile_seconds", lambda: 1e6)  # as where it all has happened only now
    bar = SplatProgressBar(refresh_rate=1)
    trainer = Trainer(logger=False, max_steps=9, default_root_dir=tmp_path)
    module = SplatModule()
    bar.setup(trainer, module, "fit")
    bar.on_train_start(trainer, module)
    bar.on_train_batch_end(trainer, module, None)
    bar.train_progress_bar.refresh()
    bar.train_progress_bar.close()
    assert terminal.getvalue().endswith("\n")
