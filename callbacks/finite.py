"""How NaN and infinite values are handled: codes are mended, splats are dropped."""

from __future__ import annotations

import logging
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer

from nsvq_lightning.quantize.base import is_mendable
from nsvq_lightning.random import generator
from nsvq_lightning.training.edit import drop_non_finite, reset_moments
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.optim import codebook_group, raw_optimizer
from nsvq_lightning.training.schedule import Phase

from .latch import LatchedCallback

__all__ = ["FiniteCodes", "FiniteSearch", "keep_finite_splats"]

log = logging.getLogger(__name__)


class FiniteCodes(LatchedCallback):
    """Searches codebooks for NaN and infinite values, from the quantize phase on, and mends such codes with a warning.

    As with non-finite splats (:class:`~nsvq_lightning.callbacks.DensityControl`), the run continues. A code cannot be
    dropped, as that would renumber the others: the quantizer gives it a new value
    (:class:`nsvq_lightning.quantize.base.Mendable`), and its Adam moments are reset.

    Args:
        every: Iterations between two searches; a step whose loss is not finite always causes one.

    Raises:
        ValueError: ``every`` is below 1.

    Example:
        >>> from nsvq_lightning.callbacks import FiniteCodes, standard
        >>> callbacks = standard(codebook_finite=FiniteCodes(every=50))  # --callbacks.codebook_finite.every=50
        >>> [type(callback).__name__ for callback in callbacks].count("FiniteCodes")
        1
        >>> FiniteCodes(every=0)
        Traceback (most recent call last):
        ValueError: every must be at least 1, got 0
    """

    def __init__(self, every: int = 100) -> None:
        super().__init__()
        self._search = FiniteSearch(every)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Search when due.

        Raises:
            FloatingPointError: All codes of an attribute are non-finite, or its quantizer cannot mend them.
        """
        host, iteration = as_host(pl_module), trainer.global_step
        if iteration == 0 or host.schedule.phase_at(iteration) < Phase.QUANTIZE:
            return
        if self._latch.first_time(iteration) and self._search.is_due(trainer):
            self._mend(trainer, host, iteration)

    def _mend(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        for name, quantizer in host.quantizers.items():
            broken = (~torch.isfinite(quantizer.codebook.detach()).all(1)).nonzero()[:, 0]
            if len(broken) == 0:
                continue
            found = f"step {iteration}: {len(broken)} of {len(quantizer.codebook)} codes of {name} are non-finite"
            if len(broken) == len(quantizer.codebook) or not is_mendable(quantizer):
                raise FloatingPointError(f"{found}; lower the learning rates")
            quantizer.mend(broken, host.rows(name), generator(host.seed, iteration, "mend", name))
            reset_moments(raw_optimizer(trainer), codebook_group(name), broken)
            log.warning("%s (%s); mended", found, _numbers(broken.tolist()))


def _numbers(rows: list[int]) -> str:
    shown = ", ".join(map(str, rows[:5]))
    return f"rows {shown}{', …' * (len(rows) > 5)}"


class FiniteSearch:
    """Decides when to search for NaN and infinite values: at intervals, and after a step without an update.

    After a step with a non-finite loss no parameter has a gradient, on any process
    (:class:`nsvq_lightning.SplatModule`, :class:`nsvq_lightning.training.strategies.ViewParallelStrategy`). So all
    processes decide alike without communication.

    Args:
        every: Iterations between two searches.
        name: Name of the argument, for the error.

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
    """Drop non-finite splats, with their frozen codes (:func:`nsvq_lightning.training.edit.drop_non_finite`).

    The replicas of several processes are equal, so all drop the same splats without communication. Dropping splats
    loses gradients: call it between an update and the next backward pass.

    Raises:
        FloatingPointError: No finite splat is left.
    """
    kept = drop_non_finite(host.splats, raw_optimizer(trainer), trainer.global_step)
    if len(host.splats) == len(kept):
        return
    for quantizer in host.quantizers.values():
        if len(quantizer.codes) > 0:
            quantizer.freeze(quantizer.codes[kept])
