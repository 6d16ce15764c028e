"""What the quantize and fine-tune phases do to codebooks and codes: place, refit, replace, mend, freeze."""

import math
from collections.abc import Iterable
from dataclasses import field
from typing import Any

import torch
from lightning.pytorch import Trainer
from torch import Tensor
from torch.optim import Optimizer

from nsvq_lightning.quality.loss import apply_mask
from nsvq_lightning.quality.metrics import color_corrected, eight_bit
from nsvq_lightning.quantize import attributes
from nsvq_lightning.quantize.codebook import Quantizer, held_codes
from nsvq_lightning.quantize.nearest import cheapest, code_rates
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import canonical
from nsvq_lightning.top_level import log
from nsvq_lightning.training import distributed, optim, row_ops, run_scene
from nsvq_lightning.training.importance import row_weights
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

from .base import SplatCallback, finite_search_is_due, first_time, keep_finite_splats
from .settings import Count, Factor, Positive


class CanonicalCovariance(SplatCallback):
    """After the last iteration before the quantize phase, gives like covariances like scales and rotations.

    Of the 48 equivalent pairs of scale and rotation that a covariance has, each splat takes one
    (:func:`nsvq_lightning.splats.splats.canonical`), so that k-means groups them; renderings do not change. The form
    is not enforced afterwards: rows move continuously and keep their codes, while a row that jumped to another
    equivalent pair would lose its code.

    With 4k codes on 187 k splats, right after k-means for scales and rotations, test PSNR was 30.47 dB without and
    31.17 dB with it, against 31.64 dB unquantized.
    """

    def on_train_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Act before the first iteration of a run that starts in the quantize phase."""
        if first_time(self, "after", trainer.global_step):
            self.after_step(trainer, module, trainer.global_step)

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether it is the last iteration before the quantize phase, whose first one all callbacks may handle."""
        return iteration + 1 == module.schedule.first_of(Phase.QUANTIZE)

    @torch.no_grad()
    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Act when due, if scales or rotations are quantized."""
        if module.quantizers.keys().isdisjoint(("scales", "quats")) or not self.is_due(module, iteration):
            return
        optimizer, splats = trainer.optimizers[0], module.splats
        new = canonical(splats.scales, splats.quats)
        row_ops.change_coordinates(splats, optimizer, "scales", new.scales, new.scale_maps)
        row_ops.change_coordinates(splats, optimizer, "quats", new.quats, new.quat_maps)
        log.info(f"iteration {iteration}: each covariance as one of its 48 pairs of scale and rotation")


def perplexity(usage: Tensor) -> float:
    """Number of equally used codes with the entropy of ``usage [K]``: exp(-Σ p·log p); 0 if none is used."""
    return float(torch.special.entr(usage.double() / usage.sum()).sum().exp()) if usage.any() else 0.0


class CodebookInit(SplatCallback):
    """At the first iteration of the quantize phase, fit every codebook to the rows of all splats (k-means).

    NaN and infinite splats are dropped first, whenever they were last searched for. A run with codebooks cannot do
    without it: leave out both, with ``--model.codebooks=null``.
    """

    weighted: bool = True
    """Weight splats in k-means by their blending weight in the train views, so that codes go to visible ones; the paper
    weights all equally. Scales stay unweighted: small splats contribute little, but a small splat with the code of
    larger ones is visible. Right after k-means with 4k codes on 187 k splats, weighting changed test PSNR by -0.37 dB
    for scales, +0.07 for rotations, +0.04 for colours and +0.15 for SH."""
    values_per_splat: Positive | None = None
    """Largest K·D of a codebook for each splat; None has no limit. A value takes 4 to 5 bits in the file, so 1024 codes
    of 45 values for 36 000 splats take as much as they save."""

    def tell(self, module: SplatModule) -> None:
        """Tell how large codebooks may be."""
        module.values_per_splat = self.values_per_splat or math.inf

    def before_fit(self, trainer: Trainer, module: SplatModule) -> None:
        """Look for the train views now, not after most of the training.

        Raises:
            ValueError: Weights need a data module with a scene.
        """
        if self.weighted and module.quantizers:
            run_scene.needed_scene(trainer, *run_scene.FOR_WEIGHTS)

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether codebooks are placed before this iteration."""
        return iteration == module.schedule.first_of(Phase.QUANTIZE)

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Fit when due."""
        if not self.is_due(module, iteration):
            return
        keep_finite_splats(module)
        weights = row_weights(run_scene.train_contributions(trainer, module.scene)) if self.weighted else None
        for name, quantizer in module.quantizers.items():
            if trainer.is_global_zero:
                if self.values_per_splat is not None and hasattr(quantizer, "limit"):
                    most = self.values_per_splat * len(module.splats) / quantizer.codebook.shape[1]
                    quantizer.limit(max(1, int(most)))
                weight = None if name == "scales" else weights
                draws = generator(module.seed, iteration, "kmeans", name)
                quantizer.fit(module.scene.rows(name), weight, generator=draws)
            if trainer.world_size > 1:  # a fit may leave fewer codes, so counters and all other buffers must follow
                distributed.follow_first(trainer.strategy, quantizer)  # type: ignore[arg-type]
        if sizes := ", ".join(f"{name} {len(q.codebook)}" for name, q in module.quantizers.items()):
            log.info(f"iteration {iteration}: codebooks for {len(module.splats)} splats: {sizes}")


class CodebookReplacement(SplatCallback):
    """Replaces inactive codes with copies of active ones, at first often, then less often (paper, section 3.2).

    All numbers are iterations of the reference run. The quantizer decides which codes are inactive.

    By the paper's rule the last replacement comes right before the codes freeze, so its new codes are never trained; a
    smaller ``end`` leaves them time. Untrained copies equal their originals, which keep all the rows. Few codes are
    affected: after k-means on 182 k splats, 0 to 5 of 16 384 codes were inactive in a window.

    Raises:
        ValueError: The iterations are not in ascending order.

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

    start: Count = 10_700
    """First replacement."""
    early_end: int = 11_500
    """Last one of the early series."""
    early_every: Count = 200
    """Interval of the early series."""
    end: int = 12_000
    """Last one of the late series."""
    late_every: Count = 200
    """Interval of the late series."""
    jitter: Factor | None = 0.5
    """None copies random active codes, as in the paper. A number in (0, 1] splits the codes that distort most: a row of
    the scene is drawn with probability proportional to its squared distance to its code, the new code is put this share
    of the way from that code to the row, and Adam's moments of it begin anew."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.start <= self.early_end <= self.end:
            raise ValueError(f"needs start <= early_end <= end, got {self.start}, {self.early_end} and {self.end}")

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether codes are replaced after this iteration."""
        schedule = module.schedule
        times = schedule.replacement_times(self.start, self.early_end, self.early_every, self.end, self.late_every)
        return schedule.phase_at(iteration) is Phase.QUANTIZE and iteration in times

    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Replace the inactive codes of every codebook when it is time."""
        if not self.is_due(module, iteration):
            return
        if self.jitter is not None:
            keep_finite_splats(module)
        values = {}
        for name, quantizer in module.quantizers.items():
            _sum_usage(trainer, quantizer)
            values[f"codebook/{name}_perplexity"] = perplexity(quantizer.usage)
            draws = generator(module.seed, iteration, "replace", name)
            if self.jitter is None:
                replaced = quantizer.replace_unused(draws)
            else:
                replaced = quantizer.replace_unused(draws, rows=module.scene.rows(name), jitter=self.jitter)
                row_ops.reset_moments(trainer.optimizers[0], optim.codebook_group(name), replaced)
            values[f"codebook/{name}_replaced"] = len(replaced)
            log.debug(f"iteration {iteration}: replaced {len(replaced)} codes of {name}")
        distributed.check_replicas(trainer, "the replacement of codes")
        module.log_dict(values, batch_size=1)

    def on_train_start(self, trainer: Trainer, module: SplatModule) -> None:
        """Keep a checkpoint's counts on the first process only: they are the sum of all."""
        if not trainer.is_global_zero:
            for quantizer in module.quantizers.values():
                quantizer.usage.zero_()
                quantizer.window.zero_()

    def on_save_checkpoint(self, trainer: Trainer, module: SplatModule, *args: Any) -> None:
        """Sum the counts of all processes in the buffers of the first one, which the checkpoint holds."""
        for quantizer in module.quantizers.values():
            _sum_usage(trainer, quantizer)
        self.on_train_start(trainer, module)


def _sum_usage(trainer: Trainer, quantizer: Quantizer) -> None:
    """Sum the counts of all processes in the buffers of each."""
    for counter in (quantizer.usage, quantizer.window):
        distributed.sum_over_processes(trainer, counter)


class CodebookRefit(SplatCallback):
    """Refits codebooks of ``StraightThrough`` to all splats in the quantize phase, as CompGS (Navaneet et al. 2024).

    Only quantizers that have a method ``refit`` are refitted; the default one has none, and nothing happens. CompGS
    runs up to 10 steps of k-means every 100 iterations.

    A refit comes between backward pass and update: once a step, also with gradient accumulation, and before other
    callbacks replace codes or evaluate, so the order of the callbacks does not matter.

    Example:
        >>> from nsvq_lightning import SplatModule
        >>> from nsvq_lightning.callbacks import CodebookRefit
        >>> from nsvq_lightning.quantize import StraightThrough
        >>> refit = CodebookRefit(every=5000)  # --callbacks.codebook_refit.every=5000
        >>> module = SplatModule(codebooks="4k", quantizer=StraightThrough)
        >>> [iteration for iteration in range(1, 45_001) if refit.is_due(module, iteration)]
        [25000, 30000, 35000, 40000]
    """

    every: Count = 100
    """Iterations of the reference run between two refits."""
    steps: Count = 10
    """Lloyd steps of a refit."""

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether codebooks are refitted in this iteration."""
        schedule = module.schedule
        return schedule.phase_at(iteration) is Phase.QUANTIZE and iteration in schedule.refit_times(self.every)

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Drop non-finite splats before a refit to all rows: after the backward pass this would lose the gradients."""
        if self.is_due(module, iteration) and _refittable(module):
            keep_finite_splats(module)

    def on_before_optimizer_step(self, trainer: Trainer, module: SplatModule, optimizer: Optimizer) -> None:
        """Refit when due, on the first process."""
        iteration = trainer.global_step + 1
        if not self.is_due(module, iteration):
            return
        for name, quantizer in _refittable(module).items():
            if trainer.is_global_zero:
                quantizer.refit(module.scene.rows(name), self.steps)
            quantizer.codebook.data = distributed.from_first_process(trainer, quantizer.codebook.data)
            log.debug(f"iteration {iteration}: refitted the codebook of {name}")


def _refittable(module: SplatModule) -> dict[str, Any]:
    """The quantizers that support it, by attribute."""
    return {name: quantizer for name, quantizer in module.quantizers.items() if hasattr(quantizer, "refit")}


# How often sensitivities are measured in the phase.
MEASUREMENTS = 3
# Train views in which a measurement renders the splats, or a fourth of them where that is more.
VIEWS = 32
# Iterations in which every splat has its codes chosen once.
TURNS = 8
# What a splat takes in a file, about; with the strength it makes the price of a bit independent of the scene.
BITS_A_SPLAT = 64
# Share of the mean that no splat's sensitivity is below: a test view may see what no train view sees.
MIN_SENSITIVITY = 0.05


class RateDistortion(SplatCallback):
    """In the quantize phase, gives every splat the code with the least error + λ · bits instead of the nearest one.

    The error is that of the pictures: a code's squared distance times what it does to the train views
    (:func:`nsvq_lightning.training.importance.sensitivity`). The bits are −log2 of how many splats have the code.
    So a splat that is hardly seen, or nearly round, takes a code that many others have, which costs few bits once the
    file is entropy-coded; and training, which renders these codes, makes up for it. The rest of the phase is as
    before, and the codes that splats have in the end are frozen.

    Only quantizers that can hold codes (:meth:`nsvq_lightning.quantize.CodebookQuantizer.hold`) take part.
    """

    state = ("prices",)

    strength: Positive = 2.0
    """Per cent of squared error worth one per cent of the file."""
    # What a bit costs each splat ``[N]`` in squared error, by attribute.
    prices: dict[str, Tensor] | None = field(default=None, init=False)

    def tell(self, module: SplatModule) -> None:
        """Tell how strongly codes are chosen by their bits."""
        module.rate_strength = self.strength

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether this iteration of the quantize phase begins with a measurement, and the codes of all splats."""
        start, end = module.schedule.ends[Phase.PRUNE], module.schedule.ends[Phase.QUANTIZE]
        every = -(-(end - start) // MEASUREMENTS)
        return module.schedule.phase_at(iteration) is Phase.QUANTIZE and (iteration - 1 - start) % every == 0

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Choose the codes of the splats whose turn it is; of all, by a new measurement, when due or some were dropped.

        Raises:
            ValueError: The trainer has no data module with a scene.
        """
        if module.schedule.phase_at(iteration) is not Phase.QUANTIZE:
            return
        part = slice((iteration - 1) % TURNS, None, TURNS)
        # Where splats were dropped, the prices are those of others.
        fits = all(len(price) == len(module.splats) for price in (self.prices or {}).values())
        if self.is_due(module, iteration) or not fits:
            self._measure(trainer, module)
            part = slice(None)
        self._choose(module, part)

    def _measure(self, trainer: Trainer, module: SplatModule) -> None:
        splats, quantizers = module.scene.hard_splats(Phase.QUANTIZE), module.quantizers.items()
        shown = {name: torch.zeros_like(splats.opacities) for name, each in quantizers if hasattr(each, "hold")}
        error = torch.zeros((), dtype=torch.float64, device=module.device)
        for view, squares, image in run_scene.train_sensitivities(trainer, module.scene, module.seed, splats, VIEWS):
            photo = eight_bit(view.image)
            alike = color_corrected(image.clamp(0, 1), photo, view.mask)  # no code makes up for its exposure
            error += (apply_mask(alike, view.mask) - photo).square().sum(dtype=torch.float64)
            for name, total in shown.items():
                total += getattr(squares, name).flatten(1).mean(1)
        error = distributed.sum_over_processes(trainer, error)
        # In four digits: the last ones of a sum depend on the number of threads.
        a_bit = self.strength * float(f"{error:.4g}") / (BITS_A_SPLAT * len(module.splats))
        self.prices = {}
        for name, total in shown.items():
            self.prices[name] = a_bit / row_weights(distributed.sum_over_processes(trainer, total), MIN_SENSITIVITY)

    def _choose(self, module: SplatModule, part: slice) -> None:
        for name, price in (self.prices or {}).items():
            quantizer, rows = module.quantizers[name], module.scene.rows(name)
            codes = attributes.codes_of(module.splats.raw(), name, quantizer).clone()
            rates = code_rates(codes, len(quantizer.codebook))
            codes[part] = cheapest(rows[part], quantizer.codebook, rates, price[part].to(rows))
            quantizer.hold(codes)  # type: ignore[attr-defined]


class FiniteCodes(SplatCallback):
    """Searches codebooks for NaN and infinite values, from the quantize phase on, and mends such codes with a warning.

    As with non-finite splats (:class:`~nsvq_lightning.callbacks.DensityControl`), the run continues. A code cannot be
    dropped, as that would renumber the others: the quantizer gives it a new value
    (:meth:`nsvq_lightning.quantize.CodebookQuantizer.mend`), and its Adam moments are reset.
    """

    every: Count = 100
    """Iterations between two searches; a step whose loss is not finite always causes one."""

    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Search when due.

        Raises:
            FloatingPointError: All codes of an attribute are non-finite, or its quantizer cannot mend them.
        """
        if module.schedule.phase_at(iteration) < Phase.QUANTIZE or not finite_search_is_due(trainer, self.every):
            return
        for name, quantizer in module.quantizers.items():
            broken = (~torch.isfinite(quantizer.codebook).all(1)).nonzero()[:, 0]
            if len(broken) == 0:
                continue
            found = f"step {iteration}: {len(broken)} of {len(quantizer.codebook)} codes of {name} are non-finite"
            if len(broken) == len(quantizer.codebook) or not hasattr(quantizer, "mend"):
                raise FloatingPointError(f"{found}; lower the learning rates")
            quantizer.mend(broken, module.scene.rows(name), generator(module.seed, iteration, "mend", name))
            row_ops.reset_moments(trainer.optimizers[0], optim.codebook_group(name), broken)
            rows = ", ".join(map(str, broken[:5].tolist())) + ", …" * (len(broken) > 5)
            log.warning(f"{found} (rows {rows}); mended")


class FreezeCodes(SplatCallback):
    """At the first iteration of fine-tuning, freezes the code of every splat: the one it holds, or else the nearest.

    If a quantizer has an attribute ``fitted`` (whether its codebook has been placed), it must be true by then.

    If another callback removes or adds splats in fine-tuning without their codes, the nearest codes are searched again,
    with a warning: the frozen ones belong to other rows.
    """

    passing = ("_edits", "_codes", "_warned")

    _edits = -1
    _codes: dict[str, Tensor] | None = field(default=None, init=False)
    _warned = False

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether codes are frozen before this iteration."""
        return iteration == module.schedule.first_of(Phase.FINETUNE)

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Freeze when due, and again where splats have changed.

        Raises:
            RuntimeError: A codebook has never been placed.
        """
        if self.is_due(module, iteration):
            self._freeze(trainer, module, module.quantizers)
        elif stale := self._stale(module):
            if not self._warned:
                self._warned = True
                log.warning(
                    f"iteration {iteration}: another callback has removed or added splats after codes were frozen; the "
                    f"nearest codes of {', '.join(stale)} are searched again after every such edit. Let that callback "
                    "act before the fine-tune phase"
                )
            self._freeze(trainer, module, stale)
        self._edits = module.splats.edits
        self._codes = {name: quantizer.codes for name, quantizer in module.quantizers.items()}

    def _stale(self, module: SplatModule) -> list[str]:
        """Attributes whose frozen codes belong to other rows; freezing anew would have replaced their tensor."""
        edited, count = self._edits not in (-1, module.splats.edits), len(module.splats)
        frozen = {name: q.codes for name, q in module.quantizers.items() if len(q.codes) > 0}
        before = self._codes or {}
        return [name for name, codes in frozen.items() if len(codes) != count or (edited and codes is before[name])]

    def _freeze(self, trainer: Trainer, module: SplatModule, names: Iterable[str]) -> None:
        keep_finite_splats(module)
        for name in names:
            quantizer = module.quantizers[name]
            held = held_codes(quantizer, len(module.splats))
            codes = quantizer.encode(module.scene.rows(name)) if held is None else held
            # Only now: some quantizers place their codebooks when rows are encoded.
            if not getattr(quantizer, "fitted", True):
                raise RuntimeError(
                    f"iteration {trainer.global_step + 1}: the codebook of {name} has never been placed, so its codes "
                    "cannot be frozen; begin again with CodebookInit, or --model.codebooks=null"
                )
            quantizer.freeze(distributed.from_first_process(trainer, codes))
        distributed.check_replicas(trainer, "freezing the codes")
