"""What removes splats in the prune phase: the penalty on opacities, their selection, the least contributions."""

from __future__ import annotations

import logging
import math
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor
from torch.optim import Optimizer

from nsvq_lightning.compression.importance import least_contributing, most_contributing
from nsvq_lightning.random import generator
from nsvq_lightning.training.distributed import check_replicas
from nsvq_lightning.training.edit import keep_rows
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.scene_access import train_contributions
from nsvq_lightning.training.schedule import Phase, next_iteration

from .base import HostedCallback, StepCallback
from .growth import draw_rows

__all__ = ["ContributionPruning", "OpacityRegularization", "OpacitySelection", "pressure"]


class OpacityRegularization(HostedCallback):
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

    def __init__(self, weight: float = 1e-7) -> None:
        if not (math.isfinite(weight) and weight >= 0):
            raise ValueError(f"weight must be finite and at least 0, got {weight}")
        self.weight = weight

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Turn the term on and off."""
        host = as_host(pl_module)
        pruning = host.schedule.phase_at(next_iteration(trainer)) is Phase.PRUNE
        host.opacity_weight = host.schedule.strength(self.weight) if pruning else 0.0


log = logging.getLogger(__name__)

SHIFT = 20.0
"""Logit from which the pressure on opacities counts: below it no splat is ever seen."""
NEAR_LINE = 0.9, 1.1
"""Between these shares of the line the strength of the pressure stays."""
WEAKER, STRONGER = 0.8, 1.2
"""Factors of the strength below and above."""
START_OF_LINE = 0.8
"""Where the line starts, as a share of the opacity of the last splat within the budget."""


class OpacitySelection(StepCallback):
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

    def __init__(
        self,
        budget: int | None = None,
        strength: float = 2e-4,
        pushes: int = 160,
        gentle: float = 0.125,
        lead: float = 0.125,
        rate: float = 4.0,
        min_opacity: float = 0.001,
        close: float = 1.05,
    ) -> None:
        super().__init__()
        if budget is not None and budget < 1:
            raise ValueError(f"budget must be at least 1, got {budget}")
        if pushes < 1:
            raise ValueError(f"pushes must be at least 1, got {pushes}")
        for name, share in (("gentle", gentle), ("lead", lead)):
            if not 0.0 <= share < 1.0:
                raise ValueError(f"{name} must be in [0, 1), got {share}")
        for name, value in (("strength", strength), ("rate", rate), ("close", close)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be finite and above 0, got {value}")
        if not 0.0 <= min_opacity < 1.0:
            raise ValueError(f"min_opacity must be in [0, 1), got {min_opacity}")
        self.budget = budget
        self.initial_strength = strength
        self.pushes = pushes
        self.gentle = gentle
        self.lead = lead
        self.rate = rate
        self.min_opacity = min_opacity
        self.close = close
        self._restart()

    def _restart(self) -> None:
        self.strength = self.initial_strength
        self.line: float | None = None
        self.done = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit of the same callback; a checkpoint's state is loaded after this."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._restart()

    def state_dict(self) -> dict[str, Any]:
        """What the selection has reached."""
        return {**super().state_dict(), "strength": self.strength, "line": self.line, "done": self.done}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from there."""
        super().load_state_dict(state_dict)
        self.strength, self.line, self.done = (state_dict[name] for name in ("strength", "line", "done"))

    def limit(self, host: SplatHost) -> int | None:
        """How many splats are to be left; None for all."""
        return host.splat_budget if self.budget is None else self.budget

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Raise the learning rate of the opacities while they compete."""
        host = as_host(pl_module)
        if self._is_selecting(host, next_iteration(trainer)):
            host.scale_rate("opacities", self.rate)

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """Add the gradient of the pressure when due; the same on every process, after their gradients were averaged."""
        host, iteration = as_host(pl_module), next_iteration(trainer)
        if not self._is_selecting(host, iteration):
            return
        since, length = self._place(host, iteration)
        if since % self._every(length) != 0:
            return
        # Also in a step that will not update, which processes learn of at different times.
        self._follow_line(host, since, length)
        opacities = host.splats.opacities
        if opacities.grad is not None:
            opacities.grad += pressure(opacities.detach(), self.strength, gentle=since < self.gentle * length)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Prune when due, and end the selection once the budget is reached."""
        host, iteration = as_host(pl_module), trainer.global_step
        if iteration == 0 or not self._once.first_time(iteration) or not self._is_selecting(host, iteration):
            return
        since, length = self._place(host, iteration)
        budget = self.limit(host)
        assert budget is not None
        optimizer, opacities = raw_optimizer(trainer), host.splats.opacities.detach()
        if since >= self.gentle * length and (since + 1) % self._every(length) == 0:
            kept = opacities.sigmoid() >= self.min_opacity
            # Never below the budget: the pressure may have been too strong.
            if int(kept.sum()) >= min(budget, len(kept)):
                keep_rows(host.splats, optimizer, kept)
        count = len(host.splats)
        if count >= self.close * budget and since + 1 < length:
            return
        if count > budget:
            weight = host.splats.opacities.detach().sigmoid()
            # A few too many are those that have faded. Of many, the most opaque would be those in the foreground.
            few = count < self.close * budget
            draws = generator(host.seed, iteration, "select")
            kept = most_contributing(weight, budget) if few else draw_rows(weight, budget, draws)
            keep_rows(host.splats, optimizer, kept)
        self.done = True
        check_replicas(trainer, "the selection")
        log.info("iteration %d: the selection is done, %d splats are left", iteration, len(host.splats))

    def _is_selecting(self, host: SplatHost, iteration: int) -> bool:
        budget = self.limit(host)
        if self.done or budget is None or host.schedule.phase_at(iteration) is not Phase.PRUNE:
            return False
        return self.line is not None or len(host.splats) >= self.close * budget

    def _every(self, length: int) -> int:
        """Iterations between two applications of the term, in a phase of ``length`` iterations."""
        return max(1, round(length / self.pushes))

    def _place(self, host: SplatHost, iteration: int) -> tuple[int, int]:
        """Iterations since the start of the phase, 0 for its first, and its length."""
        ends = host.schedule.ends
        return iteration - ends[Phase.WARMUP] - 1, ends[Phase.PRUNE] - ends[Phase.WARMUP]

    def _follow_line(self, host: SplatHost, since: int, length: int) -> None:
        """Adjust the strength so that the opacity of the last splat within the budget falls along its line."""
        budget = self.limit(host)
        assert budget is not None
        opacities = host.splats.opacities.detach()
        last = float(opacities.kthvalue(max(1, len(opacities) - budget + 1)).values.sigmoid())
        if self.line is None:
            self.line = START_OF_LINE * last
        elif since % (2 * self._every(length)) == 0:
            goal = self.line * max(0.0, 1.0 - since / max(1.0, (1.0 - self.lead) * length))
            if last < NEAR_LINE[0] * goal:
                self.strength *= WEAKER
            elif last > NEAR_LINE[1] * goal:
                self.strength *= STRONGER


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
        return torch.full_like(opacities, 6 * strength * float(opacities.mean() + SHIFT) / count)
    above, transparency = opacities + SHIFT, 1 - opacities.sigmoid()
    held = transparency.clamp_min(0.05)
    # d/do of (o + 20)/h is 1/h + (o + 20)/h² · σ(1 - σ), the second term only where h is not clamped.
    slope = torch.where(transparency > 0.05, above / held.square() * opacities.sigmoid() * transparency, 0.0)
    return 2 * strength * (above / held).mean() * (1 / held + slope) / count


class ContributionPruning(StepCallback):
    """Once before the quantize phase, removes the splats that contribute least to the train views.

    The contribution of a splat is its blending weight, summed over all pixels
    (:func:`nsvq_lightning.compression.importance.contributions`): unlike opacity, this also finds splats that are small
    or hidden behind others. The paper prunes by opacity alone.

    Of 187 k splats at iteration 18 000, before any further training: share 0.001 removed 11 % and cost 0.03 dB of test
    PSNR; 0.003, 18 % and 0.11 dB; 0.01, 30 % and 0.38 dB.

    Args:
        share: The least contributing splats go that together have at most this share of the total contribution.
            0 removes nothing, as in the paper.
        at: Iteration of the reference run; leave some before the quantize phase to close the gaps.

    Raises:
        ValueError: ``share`` is not in [0, 1), or ``at`` is below 1.

    Example:
        >>> from nsvq_lightning.callbacks import ContributionPruning
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> pruning = ContributionPruning(share=0.002, at=18_000)  # --callbacks.contribution.share=0.002
        >>> Schedule(total=4500).iteration(pruning.at)
        1800
    """

    def __init__(self, share: float = 0.0, at: int = 18_500) -> None:
        super().__init__()
        if not 0.0 <= share < 1.0:
            raise ValueError(f"share must be at least 0 and below 1, got {share}")
        if at < 1:
            raise ValueError(f"at must be at least 1, got {at}")
        self.share = share
        self.at = at

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check that the pruning comes before the quantize phase.

        Raises:
            ValueError: It does not.
        """
        super().on_train_start(trainer, pl_module)
        schedule = as_host(pl_module).schedule
        if self.share and schedule.phase_at(schedule.iteration(self.at) + 1) > Phase.PRUNE:
            raise ValueError(
                f"contribution pruning at={self.at} must leave an iteration before the quantize phase, which starts "
                f"after {schedule.prune_end}; lower at (--callbacks.contribution.at)"
            )

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Prune after iteration ``at``, now that all callbacks have finished with it."""
        host = as_host(pl_module)
        iteration = next_iteration(trainer) - 1
        if self.share and iteration == host.schedule.iteration(self.at) and self._once.first_time(iteration):
            self._prune(trainer, host)

    def _prune(self, trainer: Trainer, host: SplatHost) -> None:
        before = len(host.splats)
        contribution = train_contributions(trainer, host)
        if not bool(contribution.any()):
            log.warning("iteration %d: no train view sees a splat; none is pruned", trainer.global_step)
            return
        keep_rows(host.splats, raw_optimizer(trainer), ~least_contributing(contribution, self.share))
        log.info(
            "iteration %d: pruned %d of %d splats, at most %g of the total contribution",
            trainer.global_step,
            before - len(host.splats),
            before,
            self.share,
        )
