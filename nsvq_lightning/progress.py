"""The progress bar: phase, splats, loss and PSNR of the run as a whole."""

from __future__ import annotations

import sys
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm

from nsvq_lightning.host import as_host, splat_host

__all__ = ["SplatProgressBar"]

LOG_FILE_REFRESHES = 50
"""Refreshes a run where the output is no terminal: each is a new line there."""


class SplatProgressBar(TQDMProgressBar):
    """One bar over the iterations of the run, also of a resumed one.

    Shows the phase, the number of splats, loss and training PSNR of recent steps (exponential mean), and the
    latest test PSNR.

    Args:
        refresh_rate: Iterations between two refreshes on a terminal; 0 switches the bar off.
        smoothing: Weight of the past in the exponential mean, in [0, 1).

    Raises:
        ValueError: ``smoothing`` is out of range.
    """

    def __init__(self, refresh_rate: int = 25, smoothing: float = 0.8) -> None:
        if not 0.0 <= smoothing < 1.0:
            raise ValueError(f"smoothing must be in [0, 1), got {smoothing}")
        super().__init__(refresh_rate=refresh_rate)
        self.smoothing = smoothing
        self._means: dict[str, float] = {}

    @property
    def total_train_batches(self) -> int | float:
        """Micro-batches of the whole run; the epoch of an endless sampler never ends."""
        return self.trainer.max_steps * self.trainer.accumulate_grad_batches

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Refresh seldom where the output is a file."""
        super().setup(trainer, pl_module, stage)
        splat_host(pl_module)
        if stage == "fit" and not sys.stdout.isatty() and self._refresh_rate > 0:
            self._refresh_rate = max(self._refresh_rate, trainer.max_steps // LOG_FILE_REFRESHES)

    def init_train_tqdm(self) -> Tqdm:
        """The bar, without the word epoch."""
        bar = super().init_train_tqdm()
        bar.set_description_str("fit", refresh=False)
        return bar

    def on_train_start(self, trainer: Trainer, *args: Any) -> None:
        """Start the bar where the run is."""
        super().on_train_start(trainer, *args)
        done = trainer.global_step * trainer.accumulate_grad_batches
        self.train_progress_bar.reset(total=self.total_train_batches)
        self.train_progress_bar.initial = self.train_progress_bar.n = done  # n - initial, over the time, is the speed

    def on_train_epoch_start(self, trainer: Trainer, *args: Any) -> None:
        """Leave the bar as it is: there is only one epoch, and a resumed run is in the middle of it."""

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """What the bar shows behind the count."""
        host = as_host(pl_module)
        shown: dict[str, int | str | float | dict[str, float]] = {
            "phase": host.phase.name.lower(),
            "splats": len(host.splats),
        }
        for name, digits in (("loss", 4), ("psnr", 2)):
            value = trainer.callback_metrics.get(f"train/{name}")
            if value is not None:
                shown[name] = f"{self._smooth(name, float(value)):.{digits}f}"
        if host.history:
            shown["test_psnr"] = f"{host.history[-1]['psnr']:.2f}"
        return shown

    def _smooth(self, name: str, value: float) -> float:
        past = self._means.get(name, value)
        self._means[name] = self.smoothing * past + (1.0 - self.smoothing) * value
        return self._means[name]
