"""Lightning's trainer with the subcommand ``export``."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer

from nsvq_lightning.compress import save_as_stored
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.module import SplatModule
from nsvq_lightning.strategies import ViewParallelStrategy  # noqa: F401  registers its name

__all__ = ["SplatTrainer", "read_checkpoint"]

log = logging.getLogger(__name__)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint without running anything that it holds.

    Raises:
        FileNotFoundError: No such checkpoint.
        FormatError: The file is damaged or no checkpoint of Lightning.
    """
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # torch's readers of zip archives and pickles raise whatever damage leads them to
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise FormatError(f"{path}: damaged, or not a checkpoint ({reason})") from error
    if not isinstance(checkpoint, dict) or not isinstance(checkpoint.get("state_dict"), dict):
        raise FormatError(f"{path}: not a checkpoint of Lightning: it has no state_dict")
    return checkpoint


class SplatTrainer(Trainer):
    """:class:`lightning.pytorch.Trainer`; every public method below is a subcommand of ``nsvq``."""

    def export(self, model: SplatModule, ckpt_path: str, output: str = "scene.nsvq") -> Path:
        """Write the scene of a checkpoint as a file.

        Args:
            model: Module that the checkpoint is loaded into.
            ckpt_path: Checkpoint of a run.
            output: File to write; its suffix names the format: .nsvq is the compressed scene, any other format holds
                the decoded splats (.ply, .sog, .spz, .splat).

        Raises:
            FileNotFoundError: No such checkpoint.
            FormatError: It is damaged.
        """
        checkpoint = read_checkpoint(ckpt_path)
        model.on_load_checkpoint(checkpoint)
        model.load_state_dict(checkpoint["state_dict"])
        path = Path(output)
        path.parent.mkdir(parents=True, exist_ok=True)
        scene = model.compressed()
        save_as_stored(scene, path, model.storage)
        log.info("wrote %s: %d splats, %d bytes", path, len(scene), path.stat().st_size)
        return path
