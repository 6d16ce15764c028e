"""The 3D limit of anti-aliasing: no splat has more detail than the photos can show."""

from __future__ import annotations

import math
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.compression.pixel_size import pixel_sizes
from nsvq_lightning.training.edit import raise_scales
from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.train_views import train_cameras

from .hosted import HostedCallback

__all__ = ["FrequencyLimit"]

EVERY = 100
"""Iterations after which the sizes of pixels are looked at anew, as splats move; they also are when splats change."""


class FrequencyLimit(HostedCallback):
    """Until the quantize phase, keeps scales at or above a share of a pixel in the photo that sees the splat closest.

    A splat smaller than the pixels of every photo is a guess, which shows when a camera comes closer: it turns into a
    dot or a needle. Mip-Splatting (Yu et al. 2024) widens every splat by a 3D filter of variance 0.2 pixels² for that;
    here the scales themselves are kept from falling below √0.2 pixels, so that files and viewers need to know nothing.
    Use it with ``antialiased`` of :class:`nsvq_lightning.SplatModule`.

    Args:
        pixels: Smallest scale, in pixels of the photo that sees the splat closest.

    Raises:
        ValueError: ``pixels`` is not positive and finite.

    Example:
        >>> from nsvq_lightning.callbacks import FrequencyLimit, standard
        >>> callbacks = [*standard(), FrequencyLimit()]  # --trainer.callbacks+=FrequencyLimit
        >>> round(callbacks[-1].pixels, 3)
        0.447
    """

    def __init__(self, pixels: float = math.sqrt(0.2)) -> None:
        if not 0.0 < pixels < math.inf:
            raise ValueError(f"pixels must be positive and finite, got {pixels}")
        self.pixels = pixels
        self._floor: Tensor | None = None
        self._edits = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Continue with the sizes of pixels that a checkpoint has."""
        super().on_train_start(trainer, pl_module)
        splats = as_host(pl_module).splats
        self._edits = splats.edits
        if self._floor is not None:
            self._floor = self._floor.to(splats.means.device) if len(self._floor) == len(splats) else None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Raise the scales that have become too small."""
        host, iteration = as_host(pl_module), trainer.global_step
        if host.schedule.phase_at(iteration + 1) >= Phase.QUANTIZE:
            return
        splats = host.splats
        if self._floor is None or splats.edits != self._edits or iteration % EVERY == 0:
            sizes = pixel_sizes(splats.means.detach(), train_cameras(trainer))
            # What no photo sees has no limit.
            self._floor = (self.pixels * sizes).log().nan_to_num(-math.inf, -math.inf, -math.inf)[:, None]
            self._edits = splats.edits
        with torch.no_grad():
            raise_scales(splats, self._floor)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the splats."""
        self._floor = None

    def state_dict(self) -> dict[str, Any]:
        """The limits in use."""
        return {"floor": self._floor}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with them."""
        self._floor = state_dict["floor"]
