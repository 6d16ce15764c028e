"""How many splats a scene needs, from its photos or from a number of bytes."""

from __future__ import annotations

import logging
import math

from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.compression.budget import splats_for_bytes, splats_for_photos
from nsvq_lightning.data.edges import detailed_pixels
from nsvq_lightning.training.host import as_host
from nsvq_lightning.training.train_views import needed_scene

from .hosted import HostedCallback
from .rate_distortion import RateDistortion

__all__ = ["SplatBudget"]

log = logging.getLogger(__name__)


class SplatBudget(HostedCallback):
    """Decides how many splats the scene is to have, and says why.

    :class:`~nsvq_lightning.callbacks.BudgetedGrowth` grows up to it,
    :class:`~nsvq_lightning.callbacks.OpacitySelection` removes what is above it. Give one of the three numbers, or none
    for as many splats as density control makes.

    Args:
        quality: Times the default for the photos (:func:`nsvq_lightning.compression.budget.splats_for_photos`).
        splats: Number of splats.
        bytes: Size of the file at level ``compact``.

    Raises:
        ValueError: More than one number is given, or one is not above 0.

    Example:
        >>> from nsvq_lightning.callbacks import SplatBudget, standard
        >>> callbacks = standard(budget=SplatBudget(splats=100_000))  # --splats 100000
        >>> [callback.splats for callback in callbacks if isinstance(callback, SplatBudget)]
        [100000]
    """

    def __init__(self, quality: float | None = None, splats: int | None = None, bytes: int | None = None) -> None:
        numbers = {"quality": quality, "splats": splats, "bytes": bytes}
        given = {name: value for name, value in numbers.items() if value is not None}
        if len(given) > 1:
            raise ValueError(f"a budget is one number, got {' and '.join(given)}; leave all but one out")
        for name, value in given.items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be finite and above 0, got {value}")
        self.quality = quality
        self.splats = splats
        self.bytes = bytes

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the module's budget.

        Raises:
            ValueError: The budget in bytes has no room for codebooks; or it is to come from photos, and the trainer has
                no data module with a scene.
        """
        super().on_train_start(trainer, pl_module)
        host = as_host(pl_module)
        host.splat_budget, reason = self.splats, "as asked"
        if self.bytes is not None:
            codebooks = {name: tuple(quantizer.codebook.shape) for name, quantizer in host.quantizers.items()}
            choices = [c.strength for c in trainer.callbacks if isinstance(c, RateDistortion)]  # type: ignore[attr-defined]
            host.splat_budget = splats_for_bytes(
                self.bytes, codebooks, host.splats.sh_degree, host.storage.precision, max(choices, default=0.0)
            )
            reason = f"for a file of {self.bytes} bytes"
        elif self.quality is not None:
            scene = needed_scene(
                trainer,
                "a budget from the photos needs them",
                "give a number of splats (--splats) or bytes (--bytes)",
            )
            detail = detailed_pixels(scene)
            host.splat_budget = splats_for_photos(len(scene.train), detail, self.quality)
            reason = (
                f"quality {self.quality:g} times what {len(scene.train)} photos with {detail:,.0f} detailed pixels "
                "each support; --quality changes it"
            )
        if host.splat_budget is not None:
            log.info("budget: %d splats, %s", host.splat_budget, reason)
