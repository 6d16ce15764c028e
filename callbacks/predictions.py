"""Write the pictures of ``predict``."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter

from nsvq_lightning.report.pictures import file_stem, write_png
from nsvq_lightning.training.run_folder import is_trial, run_folder
from nsvq_lightning.training.train_views import scene_of

__all__ = ["RenderWriter"]

log = logging.getLogger(__name__)


class RenderWriter(BasePredictionWriter):
    """Writes every predicted view as a PNG named after its photo.

    Args:
        folder: Where; None is ``predictions`` in the folder of the run.

    Example:
        >>> from nsvq_lightning.callbacks import RenderWriter, standard
        >>> writer = RenderWriter(folder="views")  # --callbacks.predictions.folder=views
        >>> [callback.folder for callback in standard(predictions=writer) if isinstance(callback, RenderWriter)]
        ['views']
    """

    def __init__(self, folder: str | None = None) -> None:
        super().__init__()  # after each batch
        self.folder = folder
        self._target = Path()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Take the folder of the run.

        Raises:
            FileExistsError: It holds another run.
        """
        super().setup(trainer, pl_module, stage)
        if stage == "predict" and self.folder is None:
            run_folder(trainer)

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Make the folder in a hook that all processes call: some have fewer views than others."""
        self._target = run_folder(trainer) / "predictions" if self.folder is None else Path(self.folder)
        if not is_trial(trainer):
            self._target.mkdir(parents=True, exist_ok=True)

    def write_on_batch_end(self, trainer: Trainer, pl_module: LightningModule, prediction: Any, *args: Any) -> None:
        """Write one picture."""
        if is_trial(trainer):
            return
        scene = scene_of(trainer)
        stem = file_stem(prediction["name"], scene.names if scene is not None else ())
        write_png(self._target / f"{stem}.png", prediction["image"])

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say where the pictures are."""
        if not is_trial(trainer):
            log.info("rendered views are in %s", self._target)
