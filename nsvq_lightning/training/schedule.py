"""The four phases of a run, and how the paper's iteration numbers scale to a shorter or longer run.

Only this module decides what scales. Every other part of the package uses numbers of a reference run (45 000 iterations
in the paper, 15 000 in the recipe) and asks the :class:`Schedule` for the numbers of this run.
"""

import math
from bisect import bisect_left
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache
from itertools import pairwise

# Iterations, ascending.
Times = tuple[int, ...]


class Phase(IntEnum):
    """Phase of a run (paper, section 4.1).

    Attributes:
        WARMUP: Plain 3D Gaussian splatting with density control.
        PRUNE: Opacity regularisation, no new splats.
        QUANTIZE: Splats and codebooks are trained together through noise substitution.
        FINETUNE: Codes are frozen; training of codebooks, positions and opacities continues.
    """

    WARMUP = 0
    PRUNE = 1
    QUANTIZE = 2
    FINETUNE = 3


@dataclass(frozen=True)
class Schedule:
    """Phases and milestones of a run of ``total`` iterations.

    Iterations are 1-based: iteration 1 is the first optimiser step, ``phase_at(1)`` is ``WARMUP``. A phase covers the
    iterations after the end of the one before, up to and including its own end. Equal ends skip a phase.

    ===============================  ==========================================================================
    what                             how it scales with ``total / reference_total``
    ===============================  ==========================================================================
    ends of the phases               proportionally; a phase that exists in the reference never vanishes
    length of the fine-tune phase    proportionally, not below ``min_finetune`` unless that is more than half of what
                                     follows the prune phase: it brings back what the codes cost, which takes its time.
                                     Test PSNR after 1500 iterations with 67 / 300 of them: 28.04 / 28.21 dB
    steps of the SH degree           proportionally
    density control: start, stop     proportionally
    density control: interval        proportionally, not below ``min_density_interval`` (its statistic is a mean over
                                     the views of one interval, and a mean over two views is noise). Test PSNR after
                                     2000 of 4500 iterations with 50 / 100: 29.98 dB with 105 k splats / 30.26 dB with
                                     73 k where SfM left 13 k points, 25.44 dB with 162 k / 23.06 dB with 81 k where it
                                     left 5.5 k (25: 25.44 dB with 209 k): fewer times starve a sparse start, so 50
    opacity resets                   proportionally, interval not below ``min_reset_interval`` (opacities need some
                                     hundred steps of Adam to come back)
    pruning in the prune phase       proportionally
    replacement, refits of codes     proportionally, interval not below ``min_replacement_interval`` (a code is called
                                     unused after a window of views, also the first time: after the three views of an
                                     unlimited one in 1500 iterations, a fifth of the SH codes were replaced; to refit
                                     codes takes as long as some steps)
    decay of the position's rate     proportionally (30 000 of 45 000)
    λ of the opacities               inversely: what it takes from an opacity in a whole phase stays the same
    learning rates, thresholds       not at all
    ===============================  ==========================================================================

    Attributes:
        total: Iterations of this run.
        reference_total: Iterations of the reference run, in whose numbers the rules are given; the paper's 45 000.
        warmup_end: Last iteration of the warm-up phase, in the reference run.
        prune_end: Last iteration of the prune phase, in the reference run.
        quantize_end: Last iteration of the quantize phase, in the reference run; fine-tuning takes the rest.
        position_decay: Iteration of the reference run from which the position's learning rate is constant.
        min_density_interval: Lower limit of the interval of density control, in iterations of this run.
        min_reset_interval: Lower limit of the interval of opacity resets, in iterations of this run.
        min_replacement_interval: Lower limit of the window of code replacement and of the interval of refits, in
            iterations of this run.
        min_finetune: Lower limit of the length of the fine-tune phase, in iterations of this run; it never takes more
            than half of the iterations after the prune phase.
        saved: Iterations of the warm-up phase that this run leaves out, as nothing was left to do in them; all that
            follows comes so much earlier.

    To give ends in iterations of this run, set ``reference_total`` to ``total``: then nothing scales.

    Raises:
        ValueError: The ends are not ascending within the run, or an interval is below 1.
    """

    total: int = 45_000
    reference_total: int = 45_000
    warmup_end: int = 15_000
    prune_end: int = 20_000
    quantize_end: int = 43_000
    position_decay: int = 30_000
    min_density_interval: int = 50
    min_reset_interval: int = 300
    min_replacement_interval: int = 50
    min_finetune: int = 300
    saved: int = 0

    def __post_init__(self) -> None:
        if self.total < 1 or self.reference_total < 1:
            raise ValueError(
                f"a schedule needs at least one iteration, got total={self.total}, "
                f"reference_total={self.reference_total}; set trainer.max_steps"
            )
        ends = (0, self.warmup_end, self.prune_end, self.quantize_end, self.reference_total)
        if any(a > b for a, b in pairwise(ends)):
            raise ValueError(
                f"phase ends must satisfy 0 <= warmup_end <= prune_end <= quantize_end <= reference_total, got "
                f"{self.warmup_end}, {self.prune_end}, {self.quantize_end}, {self.reference_total}"
            )
        if self.prune_end == self.quantize_end < self.reference_total:
            raise ValueError(
                f"fine-tuning needs a quantize phase of at least one iteration to place its codebooks in, got "
                f"prune_end = quantize_end = {self.prune_end}; raise quantize_end or set it to reference_total"
            )
        intervals = "min_density_interval", "min_reset_interval", "min_replacement_interval", "min_finetune"
        for name in ("position_decay", *intervals):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1 iteration, got {getattr(self, name)}")
        if self.saved < 0 or (self.saved and self.ends[0] < 1):
            raise ValueError(f"a run cannot save {self.saved} iterations of its warm-up phase")

    @cached_property
    def scale(self) -> float:
        """Length of this run relative to the reference run."""
        return self.total / self.reference_total

    @cached_property
    def ends(self) -> tuple[int, int, int, int]:
        """Last iterations of the four phases in this run; an empty phase repeats the end before it."""
        reference = (0, self.warmup_end, self.prune_end, self.quantize_end, self.reference_total)
        exists = [end > before for before, end in pairwise(reference)]
        ends: list[int] = []
        for phase, end in enumerate(reference[1:]):
            before = ends[-1] if ends else 0
            # Rounding must not drop a phase: at least one iteration for this one and for each that follows.
            latest = self.total - sum(exists[phase + 1 :])
            ends.append(min(max(self._end(phase, end, before), before + 1), latest) if exists[phase] else before)
        warmup, prune, quantize, finetune = (max(end, 0) - self.saved for end in ends)
        if exists[Phase.QUANTIZE] and quantize == prune:
            quantize = finetune  # a run of one iteration: codes must be placed before they are tuned
        return warmup, prune, quantize, finetune

    def _end(self, phase: int, reference: int, before: int) -> int:
        """Where a phase that starts after iteration ``before`` ends in this run, before the rounding of tiny runs."""
        end = round(reference * self.scale)
        if self.scale < 1 and phase == Phase.QUANTIZE and reference < self.reference_total:
            end = min(end, self.total - min(self.min_finetune, (self.total - before) // 2))
        return end

    def phase_at(self, iteration: int) -> Phase:
        """Phase of a 1-based iteration; iterations past the end belong to the last phase that exists."""
        return Phase(bisect_left(self.ends, min(iteration, self.ends[-1])))

    def first_of(self, phase: Phase) -> int | None:
        """First iteration of a phase, or None if this run has no such phase."""
        first = self.ends[phase - 1] + 1 if phase else 1
        return first if first <= self.ends[phase] else None

    def iteration(self, reference: float) -> int:
        """The iteration of this run that corresponds to iteration ``reference`` of the reference run, at least 1."""
        return self.interval(reference) - (self.saved if reference > self.warmup_end else 0)

    def interval(self, reference: float) -> int:
        """How many iterations of this run correspond to ``reference`` of the reference run, at least 1."""
        return max(1, round(reference * self.scale))

    def reference(self, iteration: int) -> float:
        """The iteration of the reference run that corresponds to an iteration of this run."""
        return (iteration + (self.saved if iteration > self.ends[Phase.WARMUP] else 0)) / self.scale

    def share(self, reference: float) -> float:
        """The share of a run that is over after iteration ``reference`` of the reference run."""
        return reference / self.reference_total

    def part(self, parts: int) -> int:
        """How many iterations of this run are one of so many equal parts of it, at least 1."""
        return max(1, self.total // parts)

    def stride(self, reference: int, minimum: int) -> float:
        """The interval ``reference``, in reference iterations, but at least ``minimum`` iterations of this run."""
        return max(reference, minimum / self.scale) if self.scale < 1 else reference

    @lru_cache  # noqa: B019  callbacks ask in every step
    def times(self, start: float, last: float, every: int, minimum: int = 1) -> Times:
        """The iterations ``start, start + every, …, last`` of the reference run as iterations of this run.

        Each is rounded separately: an interval rounded up would lose the last of them.
        """
        stride = self.stride(every, minimum)
        count = math.floor((last - start) / stride + 1e-9) + 1
        return tuple(dict.fromkeys(self.iteration(start + k * stride) for k in range(count)))

    def density_times(self, start: int, last: int, every: int) -> Times:
        """Iterations at which splats are cloned, split and pruned."""
        return self.times(start, last, every, self.min_density_interval)

    def reset_times(self, last: int, every: int) -> Times:
        """Iterations at which opacities are reset: the multiples of the interval up to ``last``."""
        return self.times(self.stride(every, self.min_reset_interval), last, every, self.min_reset_interval)

    def refit_times(self, every: int) -> Times:
        """Iterations of the quantize phase at which codebooks are refitted."""
        first = self.prune_end + self.stride(every, self.min_replacement_interval)
        return self.times(first, self._quantized, every, self.min_replacement_interval)

    def replacement_times(self, start: int, early_end: int, early_every: int, end: int, late_every: int) -> Times:
        """Iterations of the quantize phase at which inactive codes are replaced.

        There is an early series from ``start`` to ``early_end``, and a late one to ``end``. No window, even the first,
        is shorter than ``min_replacement_interval``. If a longer fine-tune phase moves the end of the quantize phase,
        ``end`` keeps its distance from it.
        """
        minimum = self.min_replacement_interval
        first = max(start, self.prune_end + self.stride(1, minimum))
        early = self.times(first, early_end, early_every, minimum)
        last = self._quantized - max(0, self.quantize_end - end)
        return early + self.times(early_end + self.stride(late_every, minimum), last, late_every, minimum)

    @property
    def _quantized(self) -> float:
        """Where the quantize phase of this run ends, in iterations of the reference run."""
        return (self.ends[Phase.QUANTIZE] + self.saved) / self.scale

    def sh_degree_at(self, iteration: int, every: int, highest: int) -> int:
        """SH degree in use at a 1-based iteration: one more every ``every`` reference iterations."""
        return min(highest, iteration // self.interval(every))

    def strength(self, reference: float) -> float:
        """The weight of a loss term whose effect adds up over a phase, from its weight in the reference run.

        Measured with 4500 iterations: with λ = 1e-7 unchanged the prune phase removed 6 % of the splats of a scene that
        the tenfold λ brought to half, at the same test PSNR (25.43 and 25.44 dB).
        """
        return reference / self.scale
