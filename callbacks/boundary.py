"""The state after the last complete iteration: whether it still exists, and how to restore it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any, NamedTuple

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loops.loop import _Loop
from torch import Tensor, nn

from nsvq_lightning.training.host import SplatHost, as_host
from nsvq_lightning.training.optim import raw_optimizer
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.state import RunState

__all__ = ["StepBoundary"]

Fingerprint = list[tuple[int, int, int]]


class _Count(NamedTuple):
    """A counter of codes, its version when it was copied, and the copy."""

    tensor: Tensor
    version: int
    copy: Tensor

    @property
    def is_current(self) -> bool:
        return self.tensor._version == self.version


class StepBoundary:
    """Remembers what an iteration changes before its update, so that an incomplete one can be undone.

    Until its update an iteration may change the phase, the SH degree, the usage counts of the codes, the trainer's
    counters and the state of callbacks: a copy of these, which is small, is kept. All else (splats, codebooks, frozen
    codes, side tables, Adam's moments) must be unchanged, judged by identity, address and version of every tensor. Once
    the update begins, or a view of the next iteration is in the statistics, the state is lost: call :meth:`drop`.
    """

    def __init__(self) -> None:
        self.iteration = -1
        self._kept: Fingerprint | None = None
        self._loop: object = None
        self._places: list[dict[str, Any]] = []
        self._progress: list[dict[str, int]] = []
        self._callbacks: dict[str, Any] = {}
        self._scalars = Phase.WARMUP, 0
        self._counts: list[_Count] = []

    def take(self, trainer: Trainer, module: LightningModule) -> None:
        """Remember the state now, at the end of an iteration."""
        host = as_host(module)
        self.iteration = trainer.global_step
        self._kept = _fingerprint(trainer, module)
        if self._loop is not trainer.fit_loop:
            self._loop, self._places = trainer.fit_loop, list(_places(trainer.fit_loop))
        self._progress = [{k: v for k, v in place.items() if type(v) in (int, bool)} for place in self._places]
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]  # Lightning does not type it
        states = {callback.state_key: callback.state_dict() for callback in callbacks}
        self._callbacks = {key: state for key, state in states.items() if state}
        self._scalars = host.phase, host.active_sh_degree
        before = {id(count.tensor): count for count in self._counts if count.is_current}
        self._counts = [
            before.get(id(tensor)) or _Count(tensor, tensor._version, tensor.clone()) for tensor in _counters(host)
        ]

    def drop(self) -> None:
        """Forget the state: it can no longer be restored."""
        self._kept = None

    def restore(self, trainer: Trainer, module: LightningModule) -> bool:
        """Restore the state of module and trainer; returns whether that was possible."""
        host = as_host(module)
        if self._kept is None or self._kept != _fingerprint(trainer, module):
            return False
        host.phase, host.active_sh_degree = self._scalars
        for count in self._counts:
            count.tensor.copy_(count.copy)
        for place, numbers in zip(self._places, self._progress, strict=True):
            place.update(numbers)
        return True

    def amend(self, checkpoint: dict[str, Any]) -> None:
        """Restore the states of callbacks in a checkpoint that is about to be written."""
        checkpoint["callbacks"] = self._callbacks


def _fingerprint(trainer: Trainer, module: LightningModule) -> Fingerprint:
    """Identity, address and version of every tensor that an iteration must not change before its update."""
    changing = {id(tensor) for tensor in _counters(as_host(module))}
    tensors: list[object] = [value for state in raw_optimizer(trainer).state.values() for value in state.values()]
    # Not module.parameters() and module.buffers(), which take three times as long, and this runs in every step.
    parts: list[nn.Module | None] = [module]
    for part in parts:
        if part is None:
            continue
        parts += part._modules.values()
        tensors += part._parameters.values()
        if not isinstance(part, RunState):
            tensors += part._buffers.values()
    return [
        (id(tensor), tensor.data_ptr(), tensor._version)
        for tensor in tensors
        if isinstance(tensor, Tensor) and id(tensor) not in changing
    ]


def _counters(host: SplatHost) -> Iterator[Tensor]:
    for quantizer in host.quantizers.values():
        yield from (quantizer.usage, quantizer.window)


def _places(loop: object) -> Iterator[dict[str, Any]]:
    """The attribute dictionaries of one of Lightning's loops, of its inner loops and of their counters."""
    yield vars(loop)
    for value in vars(loop).values():
        if isinstance(value, _Loop) or is_dataclass(value):
            yield from _places(value)
