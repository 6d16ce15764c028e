"""The 3D limit of anti-aliasing: no splat has more detail than the photos can show."""

from __future__ import annotations

import math
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.compression.importance import pixel_sizes
from nsvq_lightning.training.edit import raise_scales
from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.train_views import train_cameras

from .hosted import HostedCallback

__all__ = ["FrequencyLimit"]

EVERY = 100
"""Iterations after which the sizes of pixels are looked at anew, as splats move; those of new splats are at once."""
PIXEL_SIZES = "pixel_sizes"
"""Side table: size of a pixel in the photo that sees the splat closest, scene units; 0 where not yet looked at."""
NO_LIMIT = 1e-30
"""Size for splats that no photo sees."""


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
        """Look at the splats anew; what is known of them is in a side table."""
        super().on_train_start(trainer, pl_module)
        self._floor = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Raise the scales that have become too small."""
        host, iteration = as_host(pl_module), trainer.global_step
        if host.schedule.phase_at(iteration + 1) >= Phase.QUANTIZE:
            return
        splats = host.splats
        if self._floor is None or splats.edits != self._edits or iteration % EVERY == 0:
            sizes = splats.add_table(PIXEL_SIZES)
            if iteration % EVERY == 0:
                sizes.zero_()
            new = (sizes == 0).nonzero()[:, 0]
            sizes[new] = pixel_sizes(splats.means.detach()[new], train_cameras(trainer)).nan_to_num(posinf=NO_LIMIT)
            self._floor, self._edits = (self.pixels * sizes).log()[:, None], splats.edits
        raise_scales(splats, self._floor)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the limits."""
        self._floor = None
