"""The state after the last complete iteration: whether it is still there, and what puts it back."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from nsvq_lightning.host import as_host, raw_optimizer
from nsvq_lightning.quantize.base import Quantizer
from nsvq_lightning.schedule import Phase
from nsvq_lightning.state import RunState

__all__ = ["StepBoundary"]

Fingerprint = list[tuple[str, int, int, int]]


class StepBoundary:
    """Remembers what an iteration changes before its update, so that a broken one can be undone.

    Until its update an iteration may change the phase, the SH degree, the usage counts of the codes, the trainer's
    counters and the state of callbacks: of these a copy is kept, which is small. All else (splats, codebooks, frozen
    codes, side tables, Adam's moments) must not have changed, by identity, address and version of every tensor. Once
    the update begins, or a view of the next iteration is in the statistics, there is no way back: call :meth:`drop`.
    """

    def __init__(self) -> None:
        self.iteration = -1
        self._kept: Fingerprint | None = None
        self._loops: dict[str, Any] = {}
        self._callbacks: dict[str, Any] = {}
        self._scalars = Phase.WARMUP, 0
        self._counts: dict[str, list[Tensor]] = {}

    def take(self, trainer: Trainer, module: LightningModule) -> None:
        """Remember the state now, at the end of an iteration."""
        host = as_host(module)
        self.iteration = trainer.global_step
        self._kept = _fingerprint(trainer, module)
        self._loops = trainer.fit_loop.state_dict()
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]  # Lightning does not type it
        states = {callback.state_key: callback.state_dict() for callback in callbacks}
        self._callbacks = {key: state for key, state in states.items() if state}
        self._scalars = host.phase, host.active_sh_degree
        self._counts = {name: [count.clone() for count in _counts(q)] for name, q in host.quantizers.items()}

    def drop(self) -> None:
        """Forget the state: it can no longer be put back."""
        self._kept = None

    def restore(self, trainer: Trainer, module: LightningModule) -> bool:
        """Put the module back into the state; returns whether that was possible."""
        host = as_host(module)
        if self._kept is None or self._kept != _fingerprint(trainer, module):
            return False
        host.phase, host.active_sh_degree = self._scalars
        for name, quantizer in host.quantizers.items():
            for count, before in zip(_counts(quantizer), self._counts[name], strict=True):
                count.copy_(before)
        return True

    def amend(self, checkpoint: dict[str, Any]) -> None:
        """Put the trainer's counters and the states of callbacks back in a checkpoint that is about to be written."""
        checkpoint["loops"]["fit_loop"] = self._loops
        checkpoint["callbacks"] = self._callbacks


def _fingerprint(trainer: Trainer, module: LightningModule) -> Fingerprint:
    """Name, identity, address and version of every tensor that an iteration leaves alone until its update."""
    changing = [tensor for quantizer in as_host(module).quantizers.values() for tensor in _counts(quantizer)]
    for part in module.modules():
        if isinstance(part, RunState):
            changing += part.buffers()
    left_out = {id(tensor) for tensor in changing}
    moments = [(key, value) for state in raw_optimizer(trainer).state.values() for key, value in state.items()]
    return [
        (name, id(tensor), tensor.data_ptr(), tensor._version)
        for name, tensor in (*module.named_parameters(), *module.named_buffers(), *moments)
        if isinstance(tensor, Tensor) and id(tensor) not in left_out
    ]


def _counts(quantizer: Quantizer) -> tuple[Tensor, Tensor]:
    return quantizer.usage, quantizer.window
