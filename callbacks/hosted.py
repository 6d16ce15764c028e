"""Base classes: check that a module can host the callbacks, and take the folder of the run."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.training.host import check_optimizer, splat_host
from nsvq_lightning.training.run_folder import hold, is_trial, let_go, run_folder, take

__all__ = ["HostedCallback", "WritingCallback"]


class HostedCallback(Callback):
    """Base of the callbacks that train: works with any :class:`nsvq_lightning.training.host.SplatHost`.

    The module is checked before anything starts, its optimiser as soon as there is one. A subclass that overrides these
    hooks calls them here first.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Check the module.

        Raises:
            TypeError: It lacks something that :class:`~nsvq_lightning.training.host.SplatHost` names.
        """
        splat_host(pl_module)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check the optimiser.

        Raises:
            ValueError: It lacks the parameter groups of a host, or there are several.
        """
        check_optimizer(trainer, pl_module)


class WritingCallback(HostedCallback):
    """Callback that writes files: it takes the folder of the run when the run starts, not when the first file is due.

    A subclass that overrides these hooks calls them here first.
    """

    stages: ClassVar[tuple[str, ...]] = ("fit",)
    """Stages in which it writes: ``fit``, ``test`` or both."""
    folder: str | Path | None = None
    """Where it writes instead of the folder of the run, if set."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Check the module, and for a test take the folder.

        Raises:
            FileExistsError: It holds another run.
        """
        super().setup(trainer, pl_module, stage)
        if stage != "fit":
            self._take_folder(trainer, stage)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the folder, now that the trainer knows which checkpoint it continues from.

        Raises:
            FileExistsError: It holds another run.
        """
        self._take_folder(trainer, "fit")

    def _take_folder(self, trainer: Trainer, stage: str) -> None:
        if stage not in self.stages:
            return
        if self.folder is None:
            folder = run_folder(trainer)
            if trainer.is_global_zero and not is_trial(trainer):
                hold(folder)  # again, if an earlier stage of the run has ended
        elif trainer.is_global_zero and not is_trial(trainer):
            take(Path(self.folder), trainer.ckpt_path)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Let go of the folder: nothing is written after this."""
        if stage in self.stages:
            let_go(run_folder(trainer) if self.folder is None else Path(self.folder))
