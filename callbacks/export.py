"""Write the scene when training ends."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.io.formats import FORMATS, save
from nsvq_lightning.io.nsvq.file import as_stored
from nsvq_lightning.report.viewer import BACKGROUNDS, some_cameras, write_viewer
from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.run_folder import is_trial, run_folder

from .hosted import WritingCallback

__all__ = ["ExportScene"]

log = logging.getLogger(__name__)


EXPORT_FORMATS = tuple(suffix.removeprefix(".") for suffix in FORMATS)
"""Formats that can be written."""
DEFAULT_EXPORT = ("nsvq", "ply")
"""The compressed scene, and its decoded splats for viewers."""


class ExportScene(WritingCallback):
    """Writes the scene when training ends.

    The compressed scene is ``scene.nsvq``, and ``scene.ply`` has its decoded splats, for any viewer. With
    ``scene.nsvq`` comes ``viewer.html``, a page that holds it and shows it in a browser.

    Args:
        formats: Suffixes without the dot; ``sog``, ``spz`` and ``splat`` are smaller files for viewers.
        folder: Where; None is the folder of the run.

    Raises:
        ValueError: An unknown format.

    Example:
        >>> from nsvq_lightning.callbacks import ExportScene
        >>> ExportScene(["nsvq", "sog"]).formats  # --callbacks.export.formats=[nsvq,sog]
        ('nsvq', 'sog')
        >>> ExportScene(["obj"])
        Traceback (most recent call last):
        ValueError: unknown export formats obj; choose from ply, nsvq, sog, spz, splat
    """

    def __init__(self, formats: Sequence[str] = DEFAULT_EXPORT, folder: str | None = None) -> None:
        unknown = sorted(set(formats) - set(EXPORT_FORMATS))
        if unknown:
            raise ValueError(f"unknown export formats {', '.join(unknown)}; choose from {', '.join(EXPORT_FORMATS)}")
        self.formats = tuple(formats)
        self.folder = folder

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the files, on the first process."""
        folder = run_folder(trainer) if self.folder is None else Path(self.folder)
        if is_trial(trainer) or not trainer.is_global_zero:
            return
        host = as_host(pl_module)
        scene = host.compressed().finite()
        # The files of viewers hold what the compressed one decodes to: found once, however many there are.
        decoded = as_stored(scene, host.storage) if set(self.formats) - {"nsvq"} else scene
        folder.mkdir(parents=True, exist_ok=True)
        for suffix in self.formats:
            path = folder / f"scene.{suffix}"
            size = save(scene, path, host.storage) if suffix == "nsvq" else save(decoded, path)
            log.info("wrote %s (%d bytes)", path, size)
        photos = getattr(getattr(trainer, "datamodule", None), "scene", None)
        if "nsvq" in self.formats and photos is not None:
            page = folder / "viewer.html"
            title = page.resolve().parent.parent.name
            background = BACKGROUNDS.get(host.background, BACKGROUNDS["black"])
            size = write_viewer(page, folder / "scene.nsvq", some_cameras(photos), title, background)
            log.info("wrote %s (%d bytes)", page, size)
