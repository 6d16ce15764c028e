"""Notify Lightning's callbacks that monitor a metric when there is a new value."""

from __future__ import annotations

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint

__all__ = ["tell_watchers"]


def tell_watchers(trainer: Trainer, module: LightningModule) -> None:
    """Let early stopping and checkpoints that monitor ``report/…`` act now.

    They wait for the end of an epoch or a validation, depending on their settings and the trainer's, and act in one of
    these hooks. Here the sampler is endless and no validation runs, so neither ever comes.
    """
    watchers: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]  # Lightning does not type it
    for watcher in watchers:
        if isinstance(watcher, EarlyStopping | ModelCheckpoint) and (watcher.monitor or "").startswith("report/"):
            watcher.on_train_epoch_end(trainer, module)
            watcher.on_validation_end(trainer, module)
