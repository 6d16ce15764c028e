"""Pictures for the loggers that can show them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger

__all__ = ["log_pictures"]


def log_pictures(loggers: Sequence[Logger], pictures: Sequence[Path], step: int) -> None:
    """Show PNG files in TensorBoard and Weights & Biases, as ``test/<file name>``; other loggers get none.

    Args:
        loggers: Loggers of a trainer.
        pictures: The files, 8-bit RGB.
        step: Iteration they belong to.
    """
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            names = [path.stem for path in pictures]
            logger.log_image("test/views", [str(path) for path in pictures], step, caption=names)
        elif isinstance(logger, TensorBoardLogger):
            for path in pictures:
                image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
                logger.experiment.add_image(f"test/{path.stem}", image, step, dataformats="HWC")
