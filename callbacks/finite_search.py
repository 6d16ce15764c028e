"""When to look for numbers that are not finite, and how splats with such numbers leave the scene."""

from __future__ import annotations

from lightning.pytorch import Trainer

from nsvq_lightning.training.edit import drop_non_finite
from nsvq_lightning.training.host import SplatHost, raw_optimizer

__all__ = ["FiniteSearch", "keep_finite_splats"]


class FiniteSearch:
    """Says after which iterations to search for NaN and infinite numbers: every so many, and when nothing was updated.

    A step with a loss that is not finite leaves no parameter a gradient, on any process
    (:class:`nsvq_lightning.SplatModule`, :class:`nsvq_lightning.training.strategies.ViewParallelStrategy`). So all
    processes get the same answer without asking each other.

    Args:
        every: Iterations between two searches.
        name: What the number is called, for the error.

    Raises:
        ValueError: ``every`` is below 1.
    """

    def __init__(self, every: int, name: str = "every") -> None:
        if every < 1:
            raise ValueError(f"{name} must be at least 1, got {every}")
        self.every = every

    def is_due(self, trainer: Trainer) -> bool:
        """Whether to search now, at the end of an iteration: before callbacks exchange the parameters."""
        return trainer.global_step % self.every == 0 or not _was_updated(trainer)


def _was_updated(trainer: Trainer) -> bool:
    groups = raw_optimizer(trainer).param_groups
    return any(parameter.grad is not None for group in groups for parameter in group["params"])


def keep_finite_splats(trainer: Trainer, host: SplatHost) -> None:
    """Drop splats that are not finite, with their frozen codes (:func:`nsvq_lightning.training.edit.drop_non_finite`).

    The replicas of several processes are equal, so all drop the same without asking each other. Gradients are lost
    where splats are dropped: call it between an update and the next backward pass.

    Raises:
        FloatingPointError: No finite splat is left.
    """
    kept = drop_non_finite(host.splats, raw_optimizer(trainer), trainer.global_step)
    if len(host.splats) == len(kept):
        return
    for quantizer in host.quantizers.values():
        if len(quantizer.codes) > 0:
            quantizer.freeze(quantizer.codes[kept])
