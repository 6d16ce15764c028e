"""What the quantize and fine-tune phases do to codebooks and codes: place, refit, replace, mend, freeze."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, cast, get_args

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor, nn
from torch.optim import Optimizer

from nsvq_lightning.compression.covariance_error import form_errors
from nsvq_lightning.compression.importance import row_weights, scale_floor, sensitivity
from nsvq_lightning.quality.loss import kept
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.quantize.attributes import QUANTIZED, check_attributes, codes_of
from nsvq_lightning.quantize.base import (
    Holding,
    Quantizer,
    Refittable,
    held_codes,
    is_holding,
    is_limitable,
    is_mendable,
    is_refittable,
)
from nsvq_lightning.quantize.nearest import cheapest, code_rates
from nsvq_lightning.random import derive_seed, generator
from nsvq_lightning.splats.canonical_covariance import Form, canonical
from nsvq_lightning.training.distributed import check_replicas, follow_first, from_first_process, sum_over_processes
from nsvq_lightning.training.edit import change_coordinates, raise_scales, reset_moments, trainable_rows
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.optim import codebook_group, raw_optimizer
from nsvq_lightning.training.scene_access import needed_scene, train_cameras, train_contributions
from nsvq_lightning.training.schedule import Phase, next_iteration

from .base import FiniteSearch, HostedCallback, OncePerStep, StepCallback, keep_finite_splats

__all__ = [
    "CanonicalCovariance",
    "CodebookInit",
    "CodebookRefit",
    "CodebookReplacement",
    "FiniteCodes",
    "FreezeCodes",
    "RateDistortion",
    "perplexity",
]


log = logging.getLogger(__name__)

Mode = Literal["none", "sign", "full", "auto"]


class CanonicalCovariance(StepCallback):
    """After the last iteration before the quantize phase, gives like covariances like scales and rotations.

    ``mode`` gives each one of its 48 equivalent pairs of scale and rotation
    (:mod:`nsvq_lightning.splats.canonical_covariance`), so that k-means groups them; renderings do not change. The form
    is not enforced afterwards: rows move continuously and keep their codes, while a row that jumped to another
    equivalent pair would lose its code.

    ``floor`` raises scales too small to be visible to one value, then and throughout the quantize phase, so that no
    codes are spent on distinguishing them (:func:`nsvq_lightning.compression.importance.scale_floor`).

    With 4k codes on 187 k splats, right after k-means for scales and rotations, test PSNR was 30.47 dB with ``none``,
    30.61 dB with ``sign`` and 31.17 dB with ``full``, against 31.64 dB unquantized; ``auto`` chose the last.

    Args:
        mode: ``none`` leaves everything as it is, as in the paper; ``sign`` gives quaternions length 1 and w ≥ 0;
            ``full`` also sorts the axes and takes the smallest rotation; ``auto`` takes the form with the smallest
            covariance error after k-means on a sample of the scene's splats.
        floor: Smallest scale, in pixels of the train views where those see splats close; 0 is none, as in the paper.

    Raises:
        ValueError: An unknown mode, or a negative floor.

    Example:
        >>> from nsvq_lightning.callbacks import CanonicalCovariance, standard
        >>> canonical = CanonicalCovariance(mode="auto", floor=0.25)  # --callbacks.canonical.mode=auto
        >>> [callback.floor for callback in standard(canonical=canonical) if isinstance(callback, CanonicalCovariance)]
        [0.25]
    """

    def __init__(self, mode: Mode = "none", floor: float = 0.0) -> None:
        super().__init__()
        if mode not in get_args(Mode):
            raise ValueError(f"mode must be one of {', '.join(get_args(Mode))}, got {mode!r}")
        if not 0.0 <= floor < math.inf:
            raise ValueError(f"floor is a number of pixels and must be at least 0, got {floor}")
        self.mode = mode
        self.floor = floor
        self._log_floor: float | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit of the same callback."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._log_floor = None

    def state_dict(self) -> dict[str, Any]:
        """The last iteration acted on, and the floor in use."""
        return super().state_dict() | {"log_floor": self._log_floor}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue with the floor that was in use."""
        super().load_state_dict(state_dict)
        self._log_floor = state_dict.get("log_floor")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Act before the first iteration of a run that starts in the quantize phase."""
        super().on_train_start(trainer, pl_module)
        self._act_if_due(trainer, as_host(pl_module))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Act after the last iteration before the quantize phase, so before any callback handles its first one.

        After each iteration of the phase, keep scales from falling below the floor: Adam moves parameters with tiny
        gradients as far as all others.
        """
        host = as_host(pl_module)
        self._act_if_due(trainer, host)
        if self._log_floor is not None and host.schedule.phase_at(trainer.global_step) is Phase.QUANTIZE:
            raise_scales(host.splats, self._log_floor)

    def _act_if_due(self, trainer: Trainer, host: SplatHost) -> None:
        iteration, first = trainer.global_step, host.schedule.first_of(Phase.QUANTIZE)
        quantized = {"scales", "quats"} & set(host.quantizers)
        acts = self.mode != "none" or self.floor > 0
        if not acts or not quantized or first is None or iteration != first - 1:
            return
        if self._once.first_time(iteration):
            if self.floor and "scales" in quantized:
                self._raise(trainer, host)
            form = self._chosen(trainer, host) if self.mode == "auto" else self.mode
            if form != "none":
                self._apply(trainer, host, form)

    def _chosen(self, trainer: Trainer, host: SplatHost) -> Form:
        """The form with the smallest error over the finite splats; in a tie, the one that changes least."""
        finite, _ = trainable_rows(host.splats)
        scales, quats = host.splats.scales.detach()[finite], host.splats.quats.detach()[finite]
        codes = {name: len(q.codebook) for name, q in host.quantizers.items() if name in ("scales", "quats")}
        errors = form_errors(scales, quats, codes, derive_seed(host.seed, trainer.global_step, "canonical"))
        log.info("covariance error by form: %s", ", ".join(f"{form} {error:.3g}" for form, error in errors.items()))
        form: Form = trainer.strategy.broadcast(min(errors, key=errors.__getitem__))
        return form

    def _raise(self, trainer: Trainer, host: SplatHost) -> None:
        self._log_floor = scale_floor(host.splats.means.detach(), train_cameras(trainer), self.floor)
        if self._log_floor is None:
            log.warning("iteration %d: no train view sees a splat; no scale is raised", trainer.global_step)
            return
        share = float((host.splats.scales < self._log_floor).float().mean())
        raise_scales(host.splats, self._log_floor)
        log.info(
            "iteration %d: raised %.1f %% of all scales to %g pixels, %.3g scene units",
            trainer.global_step,
            100 * share,
            self.floor,
            math.exp(self._log_floor),
        )

    @torch.no_grad()
    def _apply(self, trainer: Trainer, host: SplatHost, form: Form) -> None:
        optimizer, splats = raw_optimizer(trainer), host.splats
        new = canonical(splats.scales.detach(), splats.quats.detach(), form)
        change_coordinates(splats, optimizer, "scales", new.scales, new.scale_maps)
        change_coordinates(splats, optimizer, "quats", new.quats, new.quat_maps)
        log.info("iteration %d: canonical covariances, form %s", trainer.global_step, form)


def perplexity(usage: Tensor) -> float:
    """Number of equally used codes with the entropy of ``usage [K]``: exp(-Σ p·log p); 0 if none is used."""
    p = usage.double() / usage.sum().clamp(min=1)
    entropy = torch.special.entr(p).sum()
    return float(entropy.exp()) if bool(usage.any()) else 0.0


class CodebookInit(StepCallback):
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
        if iteration != host.schedule.first_of(Phase.QUANTIZE) or not self._once.first_time(iteration):
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


class CodebookReplacement(StepCallback):
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
        if not self.is_due(host, iteration) or not self._once.first_time(iteration):
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


class CodebookRefit(HostedCallback):
    """Refits codebooks to the rows of all splats in the quantize phase, as CompGS does (Navaneet et al. 2024).

    Only quantizers that support it (:class:`nsvq_lightning.quantize.base.Refittable`, such as ``StraightThrough``) are
    refitted. CompGS runs up to 10 steps of k-means every 100 iterations.

    A refit comes between backward pass and update: once a step, also with gradient accumulation, and before other
    callbacks replace codes or evaluate, so the order of the callbacks does not matter.

    Args:
        every: Iterations of the reference run between two refits.
        steps: Lloyd steps of a refit.

    Raises:
        ValueError: ``every`` or ``steps`` is below 1.

    Example:
        >>> from nsvq_lightning import SplatModule
        >>> from nsvq_lightning.callbacks import CodebookRefit
        >>> from nsvq_lightning.quantize import StraightThrough
        >>> refit = CodebookRefit(every=5000)  # --callbacks.codebook_refit.every=5000
        >>> module = SplatModule(codebooks="4k", quantizer=StraightThrough)
        >>> [iteration for iteration in range(1, 45_001) if refit.is_due(module, iteration)]
        [25000, 30000, 35000, 40000]
    """

    def __init__(self, every: int = 100, steps: int = 10) -> None:
        if every < 1 or steps < 1:
            raise ValueError(f"refits need every >= 1 and steps >= 1, got every={every}, steps={steps}")
        self.every = every
        self.steps = steps

    def is_due(self, host: SplatHost, iteration: int) -> bool:
        """Whether codebooks are refitted in this iteration."""
        schedule = host.schedule
        if schedule.phase_at(iteration) is not Phase.QUANTIZE:
            return False
        return iteration in schedule.refit_times(self.every)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Drop non-finite splats before a refit to all rows: after the backward pass this would lose the gradients."""
        host = as_host(pl_module)
        if self.is_due(host, next_iteration(trainer)) and _refittable(host):
            keep_finite_splats(trainer, host)

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """Refit when due, on the first process."""
        host = as_host(pl_module)
        iteration = next_iteration(trainer)
        if not self.is_due(host, iteration):
            return
        for name, quantizer in _refittable(host).items():
            if trainer.is_global_zero:
                quantizer.refit(host.rows(name), self.steps)
            quantizer.codebook.data = from_first_process(trainer, quantizer.codebook.data)
            log.debug("iteration %d: refitted the codebook of %s", iteration, name)


def _refittable(host: SplatHost) -> dict[str, Refittable]:
    """The quantizers that support it, by attribute."""
    return {name: quantizer for name, quantizer in host.quantizers.items() if is_refittable(quantizer)}


MEASUREMENTS = 3
"""How often sensitivities are measured in the phase."""
VIEWS = 32
"""Most train views in which a measurement renders the splats."""
TURNS = 8
"""Iterations in which every splat has its codes chosen once."""
BITS_A_SPLAT = 64
"""What a splat takes in a file, about; with the strength it makes the price of a bit independent of the scene."""
LEAST = 0.05
"""Share of the mean that no splat's sensitivity is below: a test view may see what no train view sees."""


class RateDistortion(StepCallback):
    """In the quantize phase, gives every splat the code with the least error + λ · bits instead of the nearest one.

    The error is that of the pictures: a code's squared distance times what it does to the train views
    (:func:`nsvq_lightning.compression.importance.sensitivity`). The bits are −log2 of how many splats have the code.
    So a splat that is hardly seen, or nearly round, takes a code that many others have, which costs few bits once the
    file is entropy-coded; and training, which renders these codes, makes up for it. The rest of the phase is as
    before, and the codes that splats have in the end are frozen.

    Only quantizers that can hold codes (:class:`nsvq_lightning.quantize.base.Holding`) take part.

    Args:
        strength: Per cent of squared error worth one per cent of the file; 0 is off.
        attributes: Those whose codes are chosen so; the others have their nearest codes.

    Raises:
        ValueError: ``strength`` is negative or not finite, or an attribute is unknown.

    Example:
        >>> from nsvq_lightning.callbacks import RateDistortion, standard
        >>> callbacks = standard(rate_distortion=RateDistortion(strength=1.0))  # --callbacks.rate_distortion.strength=1
        >>> [callback.strength for callback in callbacks if isinstance(callback, RateDistortion)]
        [1.0]
    """

    def __init__(self, strength: float = 0.0, attributes: Sequence[str] = tuple(QUANTIZED)) -> None:
        super().__init__()
        if not 0.0 <= strength < float("inf"):
            raise ValueError(f"strength must be a finite number, at least 0, got {strength}")
        check_attributes("attributes", attributes)
        self.strength = strength
        self.attributes = tuple(attributes)
        self._prices: dict[str, Tensor] = {}
        self._turn = OncePerStep()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._prices, self._turn = {}, OncePerStep()

    def state_dict(self) -> dict[str, Any]:
        """The last iterations acted on, and what a bit costs each splat."""
        return {**super().state_dict(), "turn": self._turn.last, "prices": self._prices}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there."""
        super().load_state_dict(state_dict)
        self._turn.last, self._prices = state_dict["turn"], state_dict["prices"]

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Measure, and choose the codes of all splats, when the phase starts and after splats were dropped.

        Raises:
            ValueError: The trainer has no data module with a scene.
        """
        host, iteration = as_host(pl_module), next_iteration(trainer)
        if not self.strength or host.schedule.phase_at(iteration) is not Phase.QUANTIZE:
            return
        due = iteration == host.schedule.first_of(Phase.QUANTIZE) or not self._fits(host)
        if due and self._once.first_time(iteration):
            self._measure(trainer, host, iteration)
            self._choose(host, slice(None))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Choose the codes of the splats whose turn it is; measure again, and choose those of all, when due."""
        host, iteration = as_host(pl_module), trainer.global_step
        if not self._prices or host.schedule.phase_at(iteration + 1) is not Phase.QUANTIZE:
            return
        # Where non-finite splats were just dropped, the next iteration starts with a measurement.
        if not self._fits(host) or not self._turn.first_time(iteration):
            return
        start, end = host.schedule.ends[Phase.PRUNE], host.schedule.ends[Phase.QUANTIZE]
        every = -(-(end - start) // MEASUREMENTS)
        due = (iteration - start) % every == 0
        if due:
            self._measure(trainer, host, iteration)
        self._choose(host, slice(None) if due else slice(iteration % TURNS, None, TURNS))

    def _fits(self, host: SplatHost) -> bool:
        """Whether the prices are those of the splats that there are now."""
        return all(len(price) == len(host.splats) for price in self._prices.values())

    def _measure(self, trainer: Trainer, host: SplatHost, iteration: int) -> None:
        scene = needed_scene(trainer, "codes are to be chosen by what shows in the train views", "set strength=0")
        taking_part = [name for name, q in host.quantizers.items() if name in self.attributes and is_holding(q)]
        splats = host.hard_splats(Phase.QUANTIZE)
        shown = {name: torch.zeros_like(splats.opacities) for name in taking_part}
        error = torch.zeros((), dtype=torch.float64, device=host.device)
        for index in scene.some_train(VIEWS)[trainer.global_rank :: trainer.world_size]:
            view = scene.view(index).to(host.device)
            signs = generator(host.seed, iteration, "signs", index)
            squares, image = sensitivity(splats, view.camera, host.render_splats, signs)
            error += (kept(image, view.mask) - eight_bit(view.image)).square().sum(dtype=torch.float64)
            for name, total in shown.items():
                total += QUANTIZED[name].rows(getattr(squares, name)).mean(1)
        error = sum_over_processes(trainer, error)
        a_bit = self.strength * float(error) / (BITS_A_SPLAT * len(host.splats))
        self._prices = {}
        for name, total in shown.items():
            self._prices[name] = a_bit / row_weights(sum_over_processes(trainer, total), LEAST)

    def _choose(self, host: SplatHost, part: slice) -> None:
        for name, price in self._prices.items():
            quantizer, rows = host.quantizers[name], host.rows(name)
            codes = codes_of(host.splats.raw(), name, quantizer).clone()
            rates = code_rates(codes, len(quantizer.codebook))
            codes[part] = cheapest(rows[part], quantizer.codebook, rates, price[part])
            cast(Holding, quantizer).hold(codes)


class FiniteCodes(StepCallback):
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
        if self._once.first_time(iteration) and self._search.is_due(trainer):
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


class FreezeCodes(StepCallback):
    """At the first iteration of fine-tuning, freezes the code of every splat: the one it holds, or else the nearest.

    If a quantizer has an attribute ``fitted`` (whether its codebook has been placed), it must be true by then.

    If another callback removes or adds splats in fine-tuning without their codes, the nearest codes are searched again,
    with a warning: the frozen ones belong to other rows.

    Example:
        >>> from nsvq_lightning.callbacks import FreezeCodes, standard
        >>> from nsvq_lightning.training.schedule import Phase, Schedule
        >>> any(isinstance(callback, FreezeCodes) for callback in standard())
        True
        >>> Schedule(total=4500).first_of(Phase.FINETUNE)  # the iteration at which codes freeze
        4201
    """

    def __init__(self) -> None:
        super().__init__()
        self._forget()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit of the same callback."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._forget()

    def _forget(self) -> None:
        self._edits: int | None = None
        self._codes: dict[str, Tensor] = {}
        self._warned = False

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Freeze when fine-tuning starts, and again where splats have changed.

        Raises:
            RuntimeError: A codebook has never been placed.
        """
        host = as_host(pl_module)
        iteration, first = next_iteration(trainer), host.schedule.first_of(Phase.FINETUNE)
        if first is None or iteration < first:
            return
        if iteration == first and self._once.first_time(iteration):
            self._freeze(trainer, host, host.quantizers)
        elif stale := self._stale(host):
            self._warn(iteration, stale)
            self._freeze(trainer, host, stale)
        self._edits = host.splats.edits
        self._codes = {name: quantizer.codes for name, quantizer in host.quantizers.items()}

    def _stale(self, host: SplatHost) -> list[str]:
        """Attributes whose frozen codes belong to other rows; freezing anew would have replaced their tensor."""
        edited = self._edits not in (None, host.splats.edits)
        return [
            name
            for name, quantizer in host.quantizers.items()
            if len(quantizer.codes) > 0
            and (len(quantizer.codes) != len(host.splats) or (edited and quantizer.codes is self._codes[name]))
        ]

    def _warn(self, iteration: int, stale: list[str]) -> None:
        if not self._warned:
            self._warned = True
            log.warning(
                "iteration %d: another callback has removed or added splats after codes were frozen; the nearest codes "
                "of %s are searched again after every such edit. Let that callback act before the fine-tune phase",
                iteration,
                ", ".join(stale),
            )

    def _freeze(self, trainer: Trainer, host: SplatHost, names: Iterable[str]) -> None:
        keep_finite_splats(trainer, host)
        for name in names:
            quantizer = host.quantizers[name]
            held = held_codes(quantizer, len(host.splats))
            codes = quantizer.encode(host.rows(name)) if held is None else held
            # Only now: some quantizers place their codebooks when rows are encoded.
            if not getattr(quantizer, "fitted", True):
                raise RuntimeError(
                    f"iteration {next_iteration(trainer)}: the codebook of {name} has never been placed, so its codes "
                    "cannot be frozen; add CodebookInit to the callbacks"
                )
            quantizer.freeze(from_first_process(trainer, codes))
        check_replicas(trainer, "freezing the codes")
