"""The progress of a whole run: a bar on a terminal, plain lines in a file."""

import sys
import time
from io import StringIO
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm

from nsvq_lightning.compute.jit import compile_seconds
from nsvq_lightning.top_level import log
from nsvq_lightning.training.module import SplatModule

# Lines of a run if the output is not a terminal.
LINES = 50
# Weight of the past in the exponential mean of the training PSNR.
SMOOTHING = 0.8


class SplatProgressBar(TQDMProgressBar):
    """One bar for a whole run; plain lines if the output is not a terminal.

    It counts all iterations, also those of earlier parts of a resumed run. After their number it shows the time that is
    left, without the compilation of kernels, and the time of day at which that ends; then the phase, the number of
    splats, the training PSNR of recent steps (exponential mean) and the latest test PSNR, in dB. It fits 80 columns.

    Args:
        refresh_rate: Iterations between two refreshes on a terminal; 0 turns the bar off.
    """

    train_description = ""
    BAR_FORMAT = "|{bar}| {n_fmt}/{total_fmt} {remaining} to {eta:%H:%M}{postfix}"

    def __init__(self, refresh_rate: int = 25) -> None:
        super().__init__(refresh_rate=refresh_rate)
        self._asked_rate = refresh_rate
        self._is_plain = False

    @property
    def total_train_batches(self) -> int | float:
        """Iterations of the whole run, however many views each has; the epoch of an endless sampler never ends."""
        return self.trainer.max_steps

    @property
    def is_disabled(self) -> bool:
        """Whether no bar is drawn."""
        return super().is_disabled or self._is_plain

    def setup(self, trainer: Trainer, module: SplatModule, stage: str) -> None:
        """Find out whether the output shows bars; write only a few lines to a file."""
        super().setup(trainer, module, stage)
        self._psnr: float | None = None
        # A terminal or a notebook can draw a line again.
        self._is_plain = not (sys.stdout.isatty() or "ipykernel" in sys.modules)
        self._refresh_rate = self._asked_rate
        if stage == "fit" and self._is_plain and self._refresh_rate > 0:
            self._refresh_rate = max(self._refresh_rate, trainer.max_steps // LINES)

    def on_train_start(self, trainer: Trainer, *args: Any) -> None:
        """Start the bar at the current iteration."""
        super().on_train_start(trainer, *args)
        bar = self.train_progress_bar
        bar.reset(total=self.total_train_batches)
        bar.initial = bar.n = trainer.global_step  # (n - initial) / time is the speed
        self._start = time.time() - compile_seconds()  # of the clock that stops while kernels are compiled

    def on_train_epoch_start(self, trainer: Trainer, *args: Any) -> None:
        """Leave the bar unchanged: there is only one epoch, and a resumed run is in the middle of it."""

    def on_train_batch_end(self, trainer: Trainer, module: SplatModule, outputs: Any, *args: Any) -> None:
        """Refresh the bar, or write a line."""
        # A resumed run counts batches from zero; its bar does not.
        done = trainer.global_step
        if not self._should_update(done, int(self.total_train_batches)):
            return
        text = self._text(trainer, module)
        if self._is_plain:
            total = trainer.max_steps
            seconds = time.time() - self._start - compile_seconds()
            left = seconds * (total - done) / max(1.0, done - self.train_progress_bar.initial)
            end = time.strftime("%H:%M", time.localtime(time.time() + left))
            times = f"{Tqdm.format_interval(seconds)} elapsed, {Tqdm.format_interval(left)} left, until {end}"
            try:
                sys.stdout.write(f"iteration {done} of {total} ({100 * done // total} %), {times}: {text}\n")
                sys.stdout.flush()
            except OSError as error:  # nobody reads any more
                log.warning(f"the progress cannot be shown any more ({error}); the run goes on")
                sys.stdout = StringIO()
            return
        bar = self.train_progress_bar
        # Where it started after it was last shown, it would end without a new line.
        bar.start_t = bar.last_print_t = self._start + compile_seconds()
        bar.n, bar.total = done, trainer.max_steps
        bar.set_postfix_str(text)

    def on_train_epoch_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Leave the bar unchanged; the end of the run is the end of its only epoch."""

    def on_exception(self, *args: Any) -> None:
        """Close the bar, so that the error starts on a new line."""
        if self._train_progress_bar is not None:
            self._train_progress_bar.close()

    def _text(self, trainer: Trainer, module: SplatModule) -> str:
        parts = [f"{module.phase.name.lower()} {Tqdm.format_sizeof(len(module.splats))} splats"]
        if (psnr := trainer.callback_metrics.get("train/psnr")) is not None:
            past = float(psnr) if self._psnr is None else self._psnr
            self._psnr = SMOOTHING * past + (1.0 - SMOOTHING) * float(psnr)
            parts.append(f"train {self._psnr:.1f}")
        if module.history:
            parts.append(f"test {module.history[-1]['psnr']:.2f}")
        return " ".join(parts)
