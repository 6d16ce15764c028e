"""Hold back Ctrl-C and SIGTERM until an iteration is complete."""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType
from typing import Any

__all__ = ["HeldSignals"]

log = logging.getLogger(__name__)


class HeldSignals:
    """Holds back the first SIGINT and the first SIGTERM until :meth:`deliver`; a second one acts at once.

    Delivering calls the handler that was there before, so what a signal means stays with the trainer and the
    interpreter. Signals that were ignored stay so; outside the main thread, where Python allows no handlers, nothing
    is held back.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, Any] = {}
        self._pending: list[int] = []

    def hold(self) -> None:
        """Begin to hold signals back."""
        if self._handlers or threading.current_thread() is not threading.main_thread():
            return
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                self._handlers[number] = handler
                signal.signal(number, self._receive)

    def deliver(self) -> None:
        """Let the signals that came meanwhile do what they do."""
        while self._pending:
            number = self._pending.pop(0)
            self._handlers[number](number, None)

    def release(self) -> None:
        """Give the signals back to the handlers from before."""
        for number, handler in self._handlers.items():
            if signal.getsignal(number) == self._receive:
                signal.signal(number, handler)
        self._handlers, self._pending = {}, []

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if number in self._pending:
            self._pending.remove(number)
            self._handlers[number](number, frame)
            return
        self._pending.append(number)
        name = signal.Signals(number).name
        log.warning("%s: stopping after this iteration; once more stops at once, without a checkpoint", name)
