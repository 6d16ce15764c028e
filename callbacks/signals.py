"""Hold back Ctrl-C and SIGTERM until an iteration is complete."""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType
from typing import Any

import torch
from lightning.pytorch import Trainer

from nsvq_lightning.training.replicas import sum_over_processes

__all__ = ["HeldSignals"]

log = logging.getLogger(__name__)

HELD = (signal.SIGINT, signal.SIGTERM)
APART = 16
"""Steps between two exchanges of signals among several GPUs."""


class HeldSignals:
    """Holds back the first SIGINT and the first SIGTERM until :meth:`deliver`; a second one acts at once.

    With several processes a second one does nothing: launchers forward signals that a process has already received, and
    a process that stopped in the middle of an iteration would leave the others waiting.

    Delivering calls the previous handler, so the trainer and the interpreter still decide what a signal does. Ignored
    signals stay ignored; outside the main thread, where Python allows no handlers, nothing is held back.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, Any] = {}
        self._pending: list[int] = []
        self._several = False

    def hold(self, trainer: Trainer) -> None:
        """Start to hold signals back."""
        self._several = trainer.world_size > 1
        if self._handlers or threading.current_thread() is not threading.main_thread():
            return
        for number in HELD:
            handler = signal.getsignal(number)
            if callable(handler):
                self._handlers[number] = handler
                signal.signal(number, self._receive)

    def received(self, trainer: Trainer, *, now: bool = False) -> list[int]:
        """Signals received by any process in the meantime: a collective, which every process must call.

        Several GPUs ask each other only in one step of 16, because the answer is waited for.

        Args:
            trainer: The trainer.
            now: Ask in any case; what one process says, all must say.
        """
        if trainer.world_size == 1:
            return list(self._pending)
        if trainer.strategy.root_device.type != "cpu" and trainer.global_step % APART and not now:
            return []
        own = torch.tensor([number in self._pending for number in HELD], dtype=torch.float32)
        counts = sum_over_processes(trainer, own.to(trainer.strategy.root_device)).tolist()
        return [number for number, count in zip(HELD, counts, strict=True) if count]

    def deliver(self, received: list[int]) -> None:
        """Call the previous handlers of the signals."""
        for number in received:
            if number in self._pending:
                self._pending.remove(number)
            if number in self._handlers:
                self._handlers[number](number, None)

    def release(self) -> None:
        """Restore the previous handlers."""
        for number, handler in self._handlers.items():
            if signal.getsignal(number) == self._receive:
                signal.signal(number, handler)
        self._handlers, self._pending = {}, []

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if number not in self._pending:
            self._pending.append(number)
            more = "" if self._several else "; a second one stops at once, without a checkpoint"
            log.warning("%s: stopping after this iteration%s", signal.Signals(number).name, more)
        elif not self._several:
            self._pending.remove(number)
            self._handlers[number](number, frame)
