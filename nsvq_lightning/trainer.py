"""Lightning's trainer with the subcommand ``export``."""

from __future__ import annotations

import logging
import zipfile
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer

from nsvq_lightning.io.container import write_nsvq
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.formats import save
from nsvq_lightning.module import SplatModule
from nsvq_lightning.strategies import ViewParallelStrategy  # noqa: F401  registers its name

__all__ = ["SplatTrainer", "read_checkpoint"]

log = logging.getLogger(__name__)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint without running anything that it holds; tensors stay in the file until they are used.

    Raises:
        FileNotFoundError: No such checkpoint.
        FormatError: The file is damaged or no checkpoint of a training run of this package.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint; a run has its own in checkpoints/last.ckpt")
    try:
        _check_sums(path)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # readers of zip archives and pickles raise whatever damage leads them to
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise FormatError(
            f"{path}: damaged, or not a checkpoint ({reason})", "copy it again, or take another one of the run"
        ) from error
    state = checkpoint.get("state_dict") if isinstance(checkpoint, dict) else None
    if not isinstance(state, dict) or "splats.means" not in state:
        raise FormatError(f"{path}: not the checkpoint of a run: it holds no splats", "give one that nsvq fit wrote")
    return checkpoint  # type: ignore[no-any-return]


def _check_sums(path: str | Path) -> None:
    """Compare the checksums of a zip archive, which torch's reader ignores.

    Raises:
        ValueError: An entry has been altered.
    """
    with zipfile.ZipFile(path) as archive:
        altered = archive.testzip()
    if altered is not None:
        raise ValueError(f"the checksum of its entry {altered} does not fit")


class SplatTrainer(Trainer):
    """:class:`lightning.pytorch.Trainer`; every public method below is a subcommand of ``nsvq``."""

    def export(self, model: SplatModule, ckpt_path: str, output: str = "scene.nsvq") -> Path:
        """Write the scene of a checkpoint as a file.

        Args:
            model: Module that the checkpoint is loaded into.
            ckpt_path: Checkpoint of a run.
            output: File to write; its suffix names the format: .nsvq is the compressed scene, any other format holds
                the decoded splats.

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
        if path.suffix.lower() == ".nsvq":
            write_nsvq(path, scene, model.storage.level, model.storage.precision)
        else:
            save(scene.decode(), path)
        log.info("wrote %s: %d splats, %d bytes", path, len(scene), path.stat().st_size)
        return path
