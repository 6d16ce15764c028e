"""Place the codebooks, and keep all their codes in use."""

from __future__ import annotations

import logging
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.host import SplatHost, as_host, from_first_process, next_iteration, sum_over_processes
from nsvq_lightning.quantize.base import Quantizer
from nsvq_lightning.random import generator
from nsvq_lightning.schedule import Phase

from .latch import StepLatch

__all__ = ["CodebookInit", "CodebookReplacement", "perplexity"]

log = logging.getLogger(__name__)


def perplexity(usage: Tensor) -> float:
    """Number of codes in even use that would have the entropy of ``usage [K]``: exp(-Σ p·log p); 0 without any use."""
    p = usage.double() / usage.sum().clamp(min=1)
    entropy = torch.special.entr(p).sum()
    return float(entropy.exp()) if bool(usage.any()) else 0.0


class CodebookInit(Callback):
    """At the first iteration of the quantize phase, fit every codebook to the rows of all splats (k-means)."""

    def __init__(self) -> None:
        self._latch = StepLatch()

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Fit when the quantize phase starts."""
        host = as_host(pl_module)
        iteration = next_iteration(trainer)
        if iteration != host.schedule.first_of(Phase.QUANTIZE) or not self._latch.first_time(iteration):
            return
        for name, quantizer in host.quantizers.items():
            if trainer.is_global_zero:
                quantizer.fit(host.rows(name), generator=generator(host.seed, iteration, "kmeans", name))
            quantizer.codebook.data = from_first_process(trainer, quantizer.codebook.data)
        sizes = ", ".join(f"{name} {q.codebook.shape[0]}" for name, q in host.quantizers.items())
        if sizes:
            log.info("iteration %d: codebooks for %d splats: %s", iteration, len(host.splats), sizes)


class CodebookReplacement(Callback):
    """Replaces inactive codes by copies of active ones, at first often, then less so (paper, section 3.2).

    All numbers are iterations of the reference run; the paper's are every 100 from 20 100 to 22 000, then every 500 up
    to 43 000. What counts as inactive is the quantizer's rule.

    Args:
        start: First replacement.
        early_end: Last one of the early series.
        early_every: Interval of the early series.
        end: Last one of the late series.
        late_every: Interval of the late series.

    Raises:
        ValueError: The iterations are not ascending, or an interval is below 1.
    """

    def __init__(
        self,
        start: int = 20_100,
        early_end: int = 22_000,
        early_every: int = 100,
        end: int = 43_000,
        late_every: int = 500,
    ) -> None:
        if not 0 < start <= early_end <= end or early_every < 1 or late_every < 1:
            raise ValueError(
                "replacement needs 0 < start <= early_end <= end and intervals of at least 1, got "
                f"start={start}, early_end={early_end}, end={end}, early_every={early_every}, late_every={late_every}"
            )
        self.start, self.early_end, self.early_every = start, early_end, early_every
        self.end, self.late_every = end, late_every
        self._latch = StepLatch()

    def is_due(self, host: SplatHost, iteration: int) -> bool:
        """Whether codes are replaced after this iteration."""
        schedule = host.schedule
        if schedule.phase_at(iteration) is not Phase.QUANTIZE:
            return False
        early = schedule.replacement_times(self.start, self.early_end, self.early_every)
        late = schedule.replacement_times(self.early_end + self.late_every, self.end, self.late_every)
        return iteration in early or iteration in late

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Replace the inactive codes of every codebook when it is time."""
        host = as_host(pl_module)
        iteration = trainer.global_step
        if not self.is_due(host, iteration) or not self._latch.first_time(iteration):
            return
        values: dict[str, float] = {}
        for name, quantizer in host.quantizers.items():
            replaced = self._replace(trainer, quantizer, host.seed, iteration, name, values)
            log.debug("iteration %d: replaced %d codes of %s", iteration, replaced, name)
        pl_module.log_dict(dict(values), batch_size=1)

    def _replace(
        self,
        trainer: Trainer,
        quantizer: Quantizer,
        seed: int,
        iteration: int,
        name: str,
        values: dict[str, float],
    ) -> int:
        """Replace in one codebook; adds what is logged to ``values``. Returns the number of replaced codes."""
        if trainer.world_size > 1:
            quantizer.usage.copy_(sum_over_processes(trainer, quantizer.usage))
            quantizer.window.copy_(sum_over_processes(trainer, quantizer.window))
        values[f"codebook/{name}_perplexity"] = perplexity(quantizer.usage)
        replaced = quantizer.replace_unused(generator(seed, iteration, "replace", name))
        values[f"codebook/{name}_replaced"] = float(replaced.shape[0])
        return replaced.shape[0]

    def state_dict(self) -> dict[str, Any]:
        """The last iteration codes were replaced at."""
        return {"last": self._latch.last}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do not replace again what was replaced before the checkpoint."""
        self._latch.last = state_dict["last"]
