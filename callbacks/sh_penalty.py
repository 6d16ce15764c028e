"""A pull of the view-dependent colour to zero: what no photo shows stays the same from all sides."""

from __future__ import annotations

import math
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.training.host import as_host

from .hosted import HostedCallback

__all__ = ["ShPenalty"]


class ShPenalty(HostedCallback):
    """Adds weight / 2N · Σ shN² to the loss, so that colours depend on the direction only where it shows.

    With few photos each splat is seen from few directions, and between them its colour is whatever the noise of the
    photos made of it. Coefficients that the photos do not need go to zero, which also makes a file without SH codebook
    smaller.

    Its gradient is added after that of the loss, so it costs no backward pass. It ends when the codes are frozen: from
    then on only codebooks are trained.

    Args:
        weight: Strength; 0 leaves the coefficients alone.

    Raises:
        ValueError: The weight is negative or not finite.

    Example:
        >>> from nsvq_lightning.callbacks import ShPenalty, standard
        >>> callbacks = standard(sh_penalty=ShPenalty(weight=0.1))  # --callbacks.sh_penalty.weight=0.1
        >>> [callback.weight for callback in callbacks if isinstance(callback, ShPenalty)]
        [0.1]
    """

    def __init__(self, weight: float = 0.0) -> None:
        if not (math.isfinite(weight) and weight >= 0):
            raise ValueError(f"weight must be finite and at least 0, got {weight}")
        self.weight = weight

    @torch.no_grad()
    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Any) -> None:
        """Add the gradient of the term."""
        shN = as_host(pl_module).splats.shN
        if self.weight > 0 and shN.grad is not None:
            shN.grad.add_(shN, alpha=self.weight / max(1, len(shN)))
