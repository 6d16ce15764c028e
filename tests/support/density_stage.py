"""A few splats, and a module and a trainer around them in which density control acts, view by view."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

from nsvq_lightning.callbacks.density import Densification
from nsvq_lightning.rendering.rasterize import Render
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.schedule import Phase, Schedule

EXTENT = 2.0


def make_splats(opacities: list[float], scales: torch.Tensor) -> Splats:
    """Splats in a row, with logarithms of scales ``[N, 3]``."""
    n = len(opacities)
    return Splats.from_tensors(
        means=torch.arange(3.0 * n).view(n, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        scales=scales,
        opacities=torch.tensor(opacities).logit(),
        sh0=torch.zeros(n, 1, 3),
        shN=torch.zeros(n, 0, 3),
    )


class Stage:
    """Module and trainer in a run of this schedule."""

    def __init__(
        self, splats: Splats, control: Densification, schedule: Schedule, micro: int = 1, background: str = "black"
    ) -> None:
        self.control = control
        self.module: Any = SimpleNamespace(
            **{"splats": splats, "quantizers": {}, "schedule": schedule, "phase": Phase.WARMUP, "extent": EXTENT},
            **{"seed": 0, "background": background, "pixel_weights": None, "splat_budget": None},
        )
        self.trainer: Any = SimpleNamespace(
            optimizers=[build_adam(param_groups(splats, {}, LearningRates(), EXTENT))],
            global_step=0,
            world_size=1,
            accumulate_grad_batches=micro,
        )
        self.module.trainer = self.trainer

    def start_batch(self, iteration: int, batch: Any = None) -> None:
        self.trainer.global_step = iteration - 1
        self.control.on_train_batch_start(self.trainer, self.module, batch, 0)

    def step(self, iteration: int, render: Render | None = None, batch: Any = None, **beside: Any) -> None:
        """An iteration with a view and what it returns beside it, or one without an update."""
        self.start_batch(iteration, batch)
        self.trainer.global_step = iteration
        for parameter in self.module.splats.parameters():
            parameter.grad = None if render is None else torch.zeros_like(parameter)
        outputs = {} if render is None else {"render": render, **beside}
        self.control.on_train_batch_end(self.trainer, self.module, outputs, batch, 0)

    @property
    def count(self) -> int:
        return len(self.module.splats)

    @property
    def opacities(self) -> list[float]:
        return self.module.splats.opacities.sigmoid().tolist()  # type: ignore[no-any-return]
