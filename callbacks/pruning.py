"""What removes splats in the prune phase: the penalty on opacities, and their selection."""

import logging
from dataclasses import dataclass, field

import torch
from lightning.pytorch import Trainer
from torch import Tensor

from nsvq_lightning.compression.importance import most_contributing
from nsvq_lightning.compute.devices import mean
from nsvq_lightning.data.scene import View
from nsvq_lightning.random import draw_rows, generator
from nsvq_lightning.training import distributed, row_ops
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

from .base import SplatCallback


@dataclass(eq=False)
class OpacityRegularization(SplatCallback):
    """Adds λ · Σ opacity to the loss during the prune phase, so that unneeded splats fade and are pruned.

    The term is a sum over the splats (paper, section 3.4), so its strength grows with their number. A shorter run has
    fewer iterations for splats to fade, and a proportionally larger λ
    (:meth:`nsvq_lightning.training.schedule.Schedule.strength`).

    Args:
        weight: λ of the reference run.

    Raises:
        ValueError: λ is negative or not finite.

    Example:
        >>> from nsvq_lightning.callbacks import OpacityRegularization
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> regularization = OpacityRegularization(weight=2e-7)  # --callbacks.opacity.weight=2e-7
        >>> Schedule(total=4500).strength(regularization.weight)  # λ of a tenth of the paper's run
        2e-06
    """

    weight: float = 1e-7

    def __post_init__(self) -> None:
        self.check({"at least 0": ("weight",)})

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, batch: View, batch_idx: int) -> None:
        """Turn the term on and off."""
        module.loss_terms.pop("opacity", None)
        if module.schedule.phase_at(trainer.global_step + 1) is Phase.PRUNE:
            weight = module.schedule.strength(self.weight)
            module.loss_terms["opacity"] = lambda *_: weight * module.splats.opacities.sigmoid().sum()


log = logging.getLogger(__name__)

# Logit from which the pressure on opacities counts: below it no splat is ever seen.
SHIFT = 20.0
# Between these shares of the line the strength of the pressure stays.
NEAR_LINE = 0.9, 1.1
# Factors of the strength below and above.
WEAKER, STRONGER = 0.8, 1.2
# Where the line starts, as a share of the opacity of the last splat within the budget.
START_OF_LINE = 0.8


@dataclass(eq=False)
class OpacitySelection(SplatCallback):
    """Removes splats in the prune phase until a budget is left: those that do not hold their opacity under pressure.

    A term in the loss pushes all opacities down while their learning rate is raised; splats that matter for the photos
    resist, the others fade and are pruned (Gradient-Driven Natural Selection, Deng et al. 2025). The strength λ of the
    term follows the opacity of the last splat within the budget, which is to fall along a straight line to 0 shortly
    before the end of the phase. The last twentieth above the budget goes at once, the faintest first; if more are left
    at the end of the phase, those that stay are drawn in proportion to their opacity.

    It works after any density control, and on a finished scene: ``--model.init_from=scene.ply
    --callbacks.density=null --callbacks.phases.warmup_end=0``.

    Args:
        budget: How many splats are to be left; None for the module's
            (:class:`nsvq_lightning.callbacks.SplatBudget`).
        strength: λ at the start.
        pushes: How often the term is applied in the phase; the strength follows at every second time.
        gentle: Share of the phase in which the term spares opaque splats, and none are pruned.
        lead: Share of the phase before its end at which the line reaches 0.
        rate: Factor of the opacities' learning rate from the start until the selection is done.
        min_opacity: Splats with a lower opacity are pruned.
        close: The selection is done as soon as there are fewer than this many times the budget.

    Raises:
        ValueError: An argument is out of range.

    Example:
        >>> from nsvq_lightning.callbacks import OpacitySelection, standard
        >>> callbacks = standard(selection=OpacitySelection(budget=50_000))  # --callbacks.selection.budget=50000
        >>> [callback.budget for callback in callbacks if isinstance(callback, OpacitySelection)]
        [50000]
    """

    state = ("current_strength", "line", "done")

    budget: int | None = None
    strength: float = 2e-4
    pushes: int = 160
    gentle: float = 0.125
    lead: float = 0.125
    rate: float = 4.0
    min_opacity: float = 0.001
    close: float = 1.05
    current_strength: float | None = field(default=None, init=False)
    """λ now; None before the first time."""
    line: float | None = field(default=None, init=False)
    """Where the line starts, as an opacity; None before the first time."""
    done: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.check(
            {
                "at least 1": ("budget", "pushes"),
                "in [0, 1)": ("gentle", "lead", "min_opacity"),
                "above 0": ("strength", "rate", "close"),
            }
        )

    def limit(self, module: SplatModule) -> int | None:
        """How many splats are to be left; None for all."""
        return module.splat_budget if self.budget is None else self.budget

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, batch: View, batch_idx: int) -> None:
        """While the opacities compete, raise their learning rate, and press on them when due."""
        module.loss_terms.pop("selection", None)
        if self._is_selecting(module, trainer.global_step + 1):
            module.scale_rate("opacities", self.rate)
            super().on_train_batch_start(trainer, module, batch, batch_idx)
            since, length = self._place(module, trainer.global_step + 1)
            if since % self._every(length) == 0:
                module.loss_terms["selection"] = lambda *_: self._pressure(module, gentle=since < self.gentle * length)

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Adjust the strength so that the opacity of the last splat within the budget falls along its line."""
        budget, (since, length) = self.limit(module), self._place(module, iteration)
        assert budget is not None
        if since % self._every(length) != 0:
            return
        opacities = module.splats.opacities.detach()
        last = float(opacities.kthvalue(max(1, len(opacities) - budget + 1)).values.sigmoid())
        if self.line is None:
            self.line, self.current_strength = START_OF_LINE * last, self.strength
        elif since % (2 * self._every(length)) == 0 and self.current_strength is not None:
            goal = self.line * max(0.0, 1.0 - since / max(1.0, (1.0 - self.lead) * length))
            if last < NEAR_LINE[0] * goal:
                self.current_strength *= WEAKER
            elif last > NEAR_LINE[1] * goal:
                self.current_strength *= STRONGER

    def _pressure(self, module: SplatModule, *, gentle: bool) -> Tensor:
        """The pressure as a term of the loss: it has the right gradient, and no value, which would hide the others."""
        assert self.current_strength is not None
        opacities = module.splats.opacities
        term = (pressure(opacities.detach(), self.current_strength, gentle=gentle) * opacities).sum()
        return term - term.detach()

    def after_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Prune when due, and end the selection once the budget is reached."""
        if not self._is_selecting(module, iteration):
            return
        since, length = self._place(module, iteration)
        budget = self.limit(module)
        assert budget is not None
        optimizer, opacities = trainer.optimizers[0], module.splats.opacities.detach()
        if since >= self.gentle * length and (since + 1) % self._every(length) == 0:
            kept = opacities.sigmoid() >= self.min_opacity
            # Never below the budget: the pressure may have been too strong.
            if int(kept.sum()) >= min(budget, len(kept)):
                row_ops.keep_rows(module.splats, optimizer, kept)
        count = len(module.splats)
        if count >= self.close * budget and since + 1 < length:
            return
        if count > budget:
            weight = module.splats.opacities.detach().sigmoid()
            # A few too many are those that have faded. Of many, the most opaque would be those in the foreground.
            few = count < self.close * budget
            draws = generator(module.seed, iteration, "select")
            kept = most_contributing(weight, budget) if few else draw_rows(weight, budget, draws)
            row_ops.keep_rows(module.splats, optimizer, kept)
        self.done = True
        distributed.check_replicas(trainer, "the selection")
        log.info("iteration %d: the selection is done, %d splats are left", iteration, len(module.splats))

    def _is_selecting(self, module: SplatModule, iteration: int) -> bool:
        budget = self.limit(module)
        if self.done or budget is None or module.schedule.phase_at(iteration) is not Phase.PRUNE:
            return False
        return self.line is not None or len(module.splats) >= self.close * budget

    def _every(self, length: int) -> int:
        """Iterations between two applications of the term, in a phase of ``length`` iterations."""
        return max(1, round(length / self.pushes))

    def _place(self, module: SplatModule, iteration: int) -> tuple[int, int]:
        """Iterations since the start of the phase, 0 for its first, and its length."""
        ends = module.schedule.ends
        return iteration - ends[Phase.WARMUP] - 1, ends[Phase.PRUNE] - ends[Phase.WARMUP]


@torch.no_grad()
def pressure(opacities: Tensor, strength: float, *, gentle: bool) -> Tensor:
    """Gradient ``[N]`` of the pressure on opacity logits o (Gradient-Driven Natural Selection, section 3.2).

    The term is λ·m² with m = mean((o + 20) / max(0.05, 1 - σ(o))) if ``gentle``, and 3·λ·(mean(o) + 20)² otherwise.

    Args:
        opacities: Opacity logits ``[N]``.
        strength: λ.
        gentle: See above.
    """
    count = opacities.shape[0]
    if not gentle:
        return torch.full_like(opacities, 6 * strength * (mean(opacities) + SHIFT) / count)
    above, transparency = opacities + SHIFT, 1 - opacities.sigmoid()
    held = transparency.clamp_min(0.05)
    # d/do of (o + 20)/h is 1/h + (o + 20)/h² · σ(1 - σ), the second term only where h is not clamped.
    slope = torch.where(transparency > 0.05, above / held.square() * opacities.sigmoid() * transparency, 0.0)
    return 2 * strength * mean(above / held) * (1 / held + slope) / count
