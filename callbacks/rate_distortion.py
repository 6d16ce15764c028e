"""Choose codes by what they cost in the file and by what their error does to the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.compression.importance import row_weights
from nsvq_lightning.compression.sensitivity import sensitivity
from nsvq_lightning.quality.masking import kept
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.quantize.attributes import QUANTIZED, check_attributes
from nsvq_lightning.quantize.base import Holding, is_holding
from nsvq_lightning.quantize.cheapest import cheapest, code_rates
from nsvq_lightning.quantize.scene import codes_of
from nsvq_lightning.random import generator
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.replicas import sum_over_processes
from nsvq_lightning.training.schedule import Phase, next_iteration
from nsvq_lightning.training.train_views import needed_scene

from .latch import LatchedCallback, StepLatch

__all__ = ["RateDistortion"]

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


class RateDistortion(LatchedCallback):
    """In the quantize phase, gives every splat the code with the least error + λ · bits instead of the nearest one.

    The error is that of the pictures: a code's squared distance times what it does to the train views
    (:func:`nsvq_lightning.compression.sensitivity.sensitivity`). The bits are −log2 of how many splats have the code.
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
        self._turn = StepLatch()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget an earlier fit."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit":
            self._prices, self._turn = {}, StepLatch()

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
        if due and self._latch.first_time(iteration):
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
