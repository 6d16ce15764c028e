"""Work with any module that hosts splats, say at once what one lacks, and write into the folder of the run."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning.training.host import check_optimizer, splat_host
from nsvq_lightning.training.run_folder import is_trial, run_folder, take

__all__ = ["HostedCallback", "WritingCallback"]


class HostedCallback(Callback):
    """Callback of any module that follows :class:`nsvq_lightning.training.host.SplatHost`; every callback here is one.

    What the module must have is checked before anything starts, what its optimiser must have as soon as there is one.
    A subclass that has these hooks itself calls them here first.
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
            ValueError: There is not one with the parameter groups of a host.
        """
        check_optimizer(trainer, pl_module)


class WritingCallback(HostedCallback):
    """Callback that writes files: it takes the folder of the run when the run starts, not when the first file is due.

    A subclass that has these hooks itself calls them here first.
    """

    stages: ClassVar[tuple[str, ...]] = ("fit",)
    """What it writes in: ``fit``, ``test`` or both."""
    folder: str | Path | None = None
    """Where it writes instead, if it was told to."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Check the module, and for a test take the folder.

        Raises:
            FileExistsError: It holds another run.
        """
        super().setup(trainer, pl_module, stage)
        if stage != "fit":
            self._take_folder(trainer, stage)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the folder, now that the trainer knows what checkpoint it goes on from.

        Raises:
            FileExistsError: It holds another run.
        """
        self._take_folder(trainer, "fit")

    def _take_folder(self, trainer: Trainer, stage: str) -> None:
        if stage not in self.stages:
            return
        if self.folder is None:
            run_folder(trainer)
        elif not is_trial(trainer):
            take(Path(self.folder), trainer.ckpt_path)
