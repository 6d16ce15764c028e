"""Show a running fit to those who look."""

from __future__ import annotations

import time
from typing import Any

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import save
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.splats.arrays import SplatArrays
from nsvq_lightning.training import live
from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.run_folder import is_trial, run_folder

from .hosted import WritingCallback

__all__ = ["LiveScene"]

CHECKED_EVERY = 20
"""Iterations after which the callback sees whether somebody asks; it takes some microseconds."""
SHARE = 0.05
"""Largest share of the time that goes into showing."""


class LiveScene(WritingCallback):
    """Shows the splats of a running fit to ``nsvq view --live``.

    It writes them into the folder of the run when somebody asks, and not otherwise. They are those that a file written
    at that moment would hold, stored without loss in ``live.nsvq``. At most a twentieth of the time goes into it, and
    none of that counts as training time. The file goes when the run ends.

    Example:
        >>> from nsvq_lightning.callbacks import STANDARD, LiveScene
        >>> STANDARD["live"] is LiveScene  # --callbacks.live=null leaves it out
        True
    """

    def __init__(self) -> None:
        self._running = False
        self._answered = 0
        self._next = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget who asked an earlier part of the run."""
        super().on_train_start(trainer, pl_module)
        self._running = not is_trial(trainer)
        self._answered, self._next = live.asked(run_folder(trainer)), 0.0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Answer a viewer."""
        due = batch_idx % CHECKED_EVERY == 0 and time.monotonic() >= self._next
        if not (self._running and due and trainer.is_global_zero):
            return
        folder = run_folder(trainer)
        asked = live.asked(folder)
        if asked == self._answered:
            return
        host, began = as_host(pl_module), time.monotonic()
        with host.stopwatch.paused(host.device):
            splats = type(host.splats).from_tensors(*host.hard_splats(host.phase)).to("cpu")
            state = {"iteration": trainer.global_step, "of": trainer.max_steps, "phase": host.phase.name.lower()}
            if host.history:
                state["psnr"] = f"{host.history[-1]['psnr']:.2f}"
            config = {"antialiased": getattr(pl_module, "antialiased", False), "live": state}
            scene = CompressedScene.from_arrays(SplatArrays.from_splats(splats), config=config)
            save(scene, folder / live.LIVE_SCENE, Storage("paper"))
        self._answered, ended = asked, time.monotonic()
        self._next = ended + (ended - began) / SHARE

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the finished scene alone."""
        if self._running and trainer.is_global_zero:
            live.end(run_folder(trainer))
        self._running = False

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Leave nothing behind that only a running fit has."""
        self.on_fit_end(trainer, pl_module)
