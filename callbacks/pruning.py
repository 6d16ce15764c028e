"""What removes splats in the prune phase: the penalty on opacities, and their selection."""

from typing import Any

import torch
from lightning.pytorch import Trainer

from nsvq_lightning.random import top_rows
from nsvq_lightning.top_level import log
from nsvq_lightning.training import distributed, row_ops, run_scene
from nsvq_lightning.training.importance import below_cap, likely_effects
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase

from .base import SplatCallback
from .settings import Count, NonNegative


class OpacityRegularization(SplatCallback):
    """Adds λ · Σ opacity to the loss during the prune phase, so that unneeded splats fade and are pruned.

    The term is a sum over the splats (paper, section 3.2), so its strength grows with their number. A shorter run has
    fewer iterations for splats to fade, and a proportionally larger λ
    (:meth:`nsvq_lightning.training.schedule.Schedule.strength`).

    Example:
        >>> from nsvq_lightning.callbacks import OpacityRegularization
        >>> from nsvq_lightning.training.schedule import Schedule
        >>> regularization = OpacityRegularization(weight=2e-7)  # --callbacks.opacity.weight=2e-7
        >>> Schedule(total=4500).strength(regularization.weight)  # λ of a tenth of the paper's run
        2e-06
    """

    weight: NonNegative = 1e-7
    """λ of the reference run."""

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether the loss of this iteration has the term."""
        return module.schedule.phase_at(iteration) is Phase.PRUNE

    def on_train_batch_start(self, trainer: Trainer, module: SplatModule, *args: Any) -> None:
        """Turn the term on and off."""
        super().on_train_batch_start(trainer, module, *args)
        module.loss_terms.pop("opacity", None)
        if self.is_due(module, trainer.global_step + 1):
            weight = module.schedule.strength(self.weight)
            module.loss_terms["opacity"] = lambda *_: weight * module.splats.opacities.sigmoid().sum()

    def on_train_end(self, trainer: Trainer, module: SplatModule) -> None:
        """Leave a loss without the term."""
        module.loss_terms.pop("opacity", None)


# Train views in which the effect of splats is measured, or a fourth of them where that is more.
VIEWS = 64


class SplatSelection(SplatCallback):
    """After the warm-up phase, removes the splats that the train views miss least, until a budget is left.

    Without a splat, a pixel I changes by Δ = -α ∂I/∂α, exactly; splats with the least Σ Δ² over the pixels of the train
    views go (:func:`nsvq_lightning.training.importance.sensitivity` estimates it, and it is moved towards what is
    typical of a splat's size and opacity). The rest of the phase fits the others to what is missing. Growth to twice
    the budget, and this, is better than growth to the budget (docs/recipe.md).

    It works after any density control, and on a finished scene: ``--model.init_from=scene.ply
    --callbacks.density=null --callbacks.phases.warmup_end=0``.
    """

    budget: Count | None = None
    """How many splats are to be left; None for the module's (:class:`nsvq_lightning.callbacks.SplatBudget`)."""

    def is_due(self, module: SplatModule, iteration: int) -> bool:
        """Whether splats are selected before this iteration."""
        return iteration == module.schedule.ends[Phase.WARMUP] + 1

    def before_step(self, trainer: Trainer, module: SplatModule, iteration: int) -> None:
        """Select when due.

        Raises:
            ValueError: There are splats to be removed, and the trainer has no data module with a scene.
        """
        budget, count = self.budget or module.splat_budget, len(module.splats)
        if budget is None or count <= budget or not self.is_due(module, iteration):
            return
        splats = below_cap(module.splats.raw())
        views = run_scene.train_sensitivities(trainer, module.scene, module.seed, splats, VIEWS)
        squares = sum((found.opacities for _, found, _ in views), torch.zeros_like(splats.opacities))
        effects = likely_effects(splats, distributed.sum_over_processes(trainer, squares))
        row_ops.keep_rows(module.splats, trainer.optimizers[0], top_rows(effects, budget))
        distributed.check_replicas(trainer, "the selection")
        log.info(f"iteration {iteration}: the selection leaves {budget} of {count} splats")
