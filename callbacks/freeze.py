"""Freeze the codes at the start of fine-tuning."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.quantize.base import held_codes
from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.replicas import check_replicas, from_first_process
from nsvq_lightning.training.schedule import Phase, next_iteration

from .finite import keep_finite_splats
from .latch import LatchedCallback

__all__ = ["FreezeCodes"]

log = logging.getLogger(__name__)


class FreezeCodes(LatchedCallback):
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
        if iteration == first and self._latch.first_time(iteration):
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
