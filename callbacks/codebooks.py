"""Place the codebooks, and keep all their codes in use."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any, Literal, cast

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor, nn

from nsvq_lightning.compression.importance import row_weights
from nsvq_lightning.quantize.attributes import check_attributes
from nsvq_lightning.quantize.base import Quantizer, is_limitable
from nsvq_lightning.random import generator
from nsvq_lightning.training.edit import reset_moments
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.optim import codebook_group, raw_optimizer
from nsvq_lightning.training.replicas import check_replicas, follow_first, sum_over_processes
from nsvq_lightning.training.schedule import Phase, next_iteration
from nsvq_lightning.training.train_views import train_contributions

from .finite import keep_finite_splats
from .latch import LatchedCallback

__all__ = ["CodebookInit", "CodebookReplacement", "perplexity"]

log = logging.getLogger(__name__)


def perplexity(usage: Tensor) -> float:
    """Number of equally used codes with the entropy of ``usage [K]``: exp(-Σ p·log p); 0 if none is used."""
    p = usage.double() / usage.sum().clamp(min=1)
    entropy = torch.special.entr(p).sum()
    return float(entropy.exp()) if bool(usage.any()) else 0.0


class CodebookInit(LatchedCallback):
    """At the first iteration of the quantize phase, fit every codebook to the rows of all splats (k-means).

    NaN and infinite splats are dropped first, whenever they were last searched for.

    Args:
        weights: Weight of a splat in k-means: ``none`` weights all equally, as in the paper; ``contribution`` weights
            each by its blending weight in the train views, so that codes go to visible splats.
        weighted: The weighted attributes. Scales are left out: small splats contribute little, but a small splat with
            the code of larger ones is visible. Weighting all four, right after k-means with 4k codes on 187 k splats,
            changed test PSNR by -0.37 dB for scales, +0.07 for rotations, +0.04 for colours and +0.15 for SH.
        values_per_splat: Largest K·D of a codebook for each splat; None has no limit. A value takes 4 to 5 bits in the
            file, so 1024 codes of 45 values for 36 000 splats take as much as they save.

    Raises:
        ValueError: Unknown weights or an unknown attribute, or ``values_per_splat`` is not above 0.

    Example:
        >>> from nsvq_lightning.callbacks import CodebookInit
        >>> CodebookInit(weights="contribution").weighted  # --callbacks.codebook_init.weights=contribution
        ('quats', 'sh0', 'shN')
        >>> CodebookInit(weights="contribution", weighted=["means"])
        Traceback (most recent call last):
        ValueError: weighted must be among scales, quats, sh0, shN, got means
    """

    def __init__(
        self,
        weights: Literal["none", "contribution"] = "none",
        weighted: Sequence[str] = ("quats", "sh0", "shN"),
        values_per_splat: float | None = None,
    ) -> None:
        super().__init__()
        if weights not in ("none", "contribution"):
            raise ValueError(f"weights must be 'none' or 'contribution', got {weights!r}")
        check_attributes("weighted", weighted)
        if values_per_splat is not None and not 0 < values_per_splat < math.inf:
            raise ValueError(f"values_per_splat must be a finite number above 0, got {values_per_splat}")
        self.weights, self.weighted, self.values_per_splat = weights, weighted, values_per_splat

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Fit when the quantize phase starts."""
        host = as_host(pl_module)
        iteration = next_iteration(trainer)
        if iteration != host.schedule.first_of(Phase.QUANTIZE) or not self._latch.first_time(iteration):
            return
        keep_finite_splats(trainer, host)
        weights = row_weights(train_contributions(trainer, host)) if self.weights == "contribution" else None
        for name, quantizer in host.quantizers.items():
            if trainer.is_global_zero:
                if self.values_per_splat is not None and is_limitable(quantizer):
                    values = self.values_per_splat * len(host.splats)
                    quantizer.limit(max(1, int(values / quantizer.codebook.shape[1])))
                weight = weights if name in self.weighted else None
                quantizer.fit(host.rows(name), weight, generator=generator(host.seed, iteration, "kmeans", name))
            if trainer.world_size > 1:  # a fit may leave fewer codes, so counters and all other buffers must follow
                follow_first(trainer.strategy, cast(nn.Module, quantizer))
        sizes = ", ".join(f"{name} {q.codebook.shape[0]}" for name, q in host.quantizers.items())
        if sizes:
            log.info("iteration %d: codebooks for %d splats: %s", iteration, len(host.splats), sizes)


class CodebookReplacement(LatchedCallback):
    """Replaces inactive codes with copies of active ones, at first often, then less often (paper, section 3.2).

    All numbers are iterations of the reference run; the paper's are every 100 from 20 100 to 22 000, then every 500 up
    to 43 000. The quantizer decides which codes are inactive.

    By the paper's rule the last replacement comes right before the codes freeze, so its new codes are never trained; a
    smaller ``end`` leaves them time. Untrained copies equal their originals, which keep all the rows. Few codes are
    affected: after k-means on 182 k splats, 0 to 5 of 16 384 codes were inactive in a window.

    Args:
        start: First replacement.
        early_end: Last one of the early series.
        early_every: Interval of the early series.
        end: Last one of the late series.
        late_every: Interval of the late series.
        jitter: None copies random active codes, as in the paper. A number in (0, 1] splits the codes that distort most:
            a row of the scene is drawn with probability proportional to its squared distance to its code, and the new
            code is put this share of the way from that code to the row.
        reset_moments: Zero Adam's moments of replaced codes, instead of keeping the old ones.

    Raises:
        ValueError: The iterations are not in ascending order, an interval is below 1, or the jitter is not in (0, 1].

    Example:
        >>> from nsvq_lightning import SplatModule
        >>> from nsvq_lightning.callbacks import CodebookReplacement
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> replacement = CodebookReplacement(end=40_000, jitter=0.5)  # --callbacks.codebook_replacement.end=40000
        >>> module = SplatModule(codebooks="4k")
        >>> module.schedule = Schedule(total=4500)
        >>> due = [iteration for iteration in range(1, 4501) if replacement.is_due(module, iteration)]
        >>> due[0], due[1], due[-1]  # the quantize phase is 2001 to 4200
        (2050, 2100, 3900)
    """

    def __init__(
        self,
        start: int = 20_100,
        early_end: int = 22_000,
        early_every: int = 100,
        end: int = 43_000,
        late_every: int = 500,
        jitter: float | None = None,
        reset_moments: bool = False,
    ) -> None:
        super().__init__()
        if jitter is not None and not 0.0 < jitter <= 1.0:
            raise ValueError(f"jitter must be None or above 0 and at most 1, got {jitter}")
        if not 0 < start <= early_end <= end or early_every < 1 or late_every < 1:
            raise ValueError(
                "replacement needs 0 < start <= early_end <= end and intervals of at least 1, got "
                f"start={start}, early_end={early_end}, end={end}, early_every={early_every}, late_every={late_every}"
            )
        self.start, self.early_end, self.early_every = start, early_end, early_every
        self.end, self.late_every = end, late_every
        self.jitter, self.reset_moments = jitter, reset_moments

    def is_due(self, host: SplatHost, iteration: int) -> bool:
        """Whether codes are replaced after this iteration."""
        schedule = host.schedule
        if schedule.phase_at(iteration) is not Phase.QUANTIZE:
            return False
        return iteration in schedule.replacement_times(
            self.start, self.early_end, self.early_every, self.end, self.late_every
        )

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Replace the inactive codes of every codebook when it is time."""
        host = as_host(pl_module)
        iteration = trainer.global_step
        if not self.is_due(host, iteration) or not self._latch.first_time(iteration):
            return
        if self.jitter is not None:
            keep_finite_splats(trainer, host)
        values: dict[str, float] = {}
        for name, quantizer in host.quantizers.items():
            _sum_usage(trainer, quantizer)
            values[f"codebook/{name}_perplexity"] = perplexity(quantizer.usage)
            replaced = self._replace(quantizer, host.rows(name), generator(host.seed, iteration, "replace", name))
            values[f"codebook/{name}_replaced"] = float(len(replaced))
            if self.reset_moments:
                reset_moments(raw_optimizer(trainer), codebook_group(name), replaced)
            log.debug("iteration %d: replaced %d codes of %s", iteration, len(replaced), name)
        check_replicas(trainer, "the replacement of codes")
        pl_module.log_dict(dict(values), batch_size=1)

    def _replace(self, quantizer: Quantizer, rows: Tensor, draws: torch.Generator) -> Tensor:
        """Replace inactive codes in one codebook by the chosen rule; returns the replaced codes."""
        if self.jitter is None:
            return quantizer.replace_unused(draws)
        return quantizer.replace_unused(draws, rows=rows, jitter=self.jitter)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep a checkpoint's counts on the first process only: they are the sum of all."""
        super().on_train_start(trainer, pl_module)
        if not trainer.is_global_zero:
            _forget_usage(as_host(pl_module))

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Sum the counts of all processes in the buffers of the first one, which the checkpoint holds."""
        if trainer.world_size == 1:
            return
        host = as_host(pl_module)
        for quantizer in host.quantizers.values():
            _sum_usage(trainer, quantizer)
        if not trainer.is_global_zero:
            _forget_usage(host)


def _sum_usage(trainer: Trainer, quantizer: Quantizer) -> None:
    """Sum the counts of all processes in the buffers of each."""
    for counter in (quantizer.usage, quantizer.window):
        counter.copy_(sum_over_processes(trainer, counter))


def _forget_usage(host: SplatHost) -> None:
    for quantizer in host.quantizers.values():
        quantizer.usage.zero_()
        quantizer.window.zero_()
