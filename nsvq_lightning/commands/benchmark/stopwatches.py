"""Where time goes: every function of the package timed while a suite runs, without a line of it in the package."""

from __future__ import annotations

import functools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

from lightning.pytorch.profilers import Profiler
from numba.core.dispatcher import Dispatcher

__all__ = ["Own", "Recorder", "RecordingProfiler", "timed_functions"]

PACKAGE = "nsvq_lightning"
UNTIMED = (f"{PACKAGE}.benchmark", f"{PACKAGE}.rendering.cpu.lanes", f"{PACKAGE}.rendering.cpu.jit")
"""Modules left alone: this one, and those whose functions stand in compiled code."""


class Own(NamedTuple):
    """Time spent in something itself, what it called and is timed too left out."""

    seconds: float = 0.0
    calls: int = 0


class Recorder:
    """Adds up own times by label. Only the thread that made it is timed: others work beside it, not in its time."""

    def __init__(self) -> None:
        self._thread = threading.get_ident()
        self._open: list[tuple[str, float]] = []
        self._inside = [0.0]
        self._own: dict[str, Own] = {}

    @property
    def is_listening(self) -> bool:
        """Whether the caller's thread is the one that is timed."""
        return threading.get_ident() == self._thread

    def start(self, label: str) -> None:
        """Enter something."""
        self._inside.append(0.0)
        self._open.append((label, time.perf_counter()))

    def stop(self) -> None:
        """Leave what was entered last."""
        end = time.perf_counter()
        label, start = self._open.pop()
        inside = self._inside.pop()
        self._inside[-1] += end - start
        seconds, calls = self._own.get(label, Own())
        self._own[label] = Own(seconds + end - start - inside, calls + 1)

    def take(self) -> dict[str, Own]:
        """Own times since the last question, of what has been left since then."""
        own, self._own = self._own, {}
        return own

    def timed(self, label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its calls recorded."""

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if not self.is_listening:
                return function(*args, **kwargs)
            self.start(label)
            try:
                return function(*args, **kwargs)
            finally:
                self.stop()

        return call


class RecordingProfiler(Profiler):
    """Hands what Lightning reports about itself (hooks, data, optimiser) to a recorder."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__()
        self._recorder = recorder

    def start(self, action_name: str) -> None:
        """Enter an action of Lightning's loops."""
        if self._recorder.is_listening:
            self._recorder.start(action_name)

    def stop(self, action_name: str) -> None:
        """Leave it."""
        if self._recorder.is_listening:
            self._recorder.stop()


@contextmanager
def timed_functions(recorder: Recorder) -> Iterator[None]:
    """Record the calls of every function, method and kernel of the package that is loaded, for the body of a ``with``.

    Labels are full names (``nsvq_lightning.rendering.cpu.blend.blend``). Kernels must be compiled before: compiled code
    is looked at no more, code still to be compiled must find what it was written for.
    """
    undo: list[tuple[Any, str, Any]] = []
    try:
        replaced = _timed_module_members(recorder, undo)
        for module in _modules():
            for name, value in list(vars(module).items()):
                if id(value) in replaced:
                    _set(module, name, replaced[id(value)], undo)
        yield
    finally:
        for owner, name, value in reversed(undo):
            setattr(owner, name, value)


def _timed_module_members(recorder: Recorder, undo: list[tuple[Any, str, Any]]) -> dict[int, Callable[..., Any]]:
    """Replace methods in their classes; functions by identity, as other modules hold them by other names too."""
    replaced: dict[int, Callable[..., Any]] = {}
    for module in _modules():
        if module.__name__.startswith(UNTIMED):
            continue
        for name, value in list(vars(module).items()):
            if getattr(value, "__module__", None) != module.__name__:
                continue
            if isinstance(value, FunctionType) or _is_kernel(value):
                replaced[id(value)] = recorder.timed(f"{module.__name__}.{name}", value)
            elif isinstance(value, type):
                _time_methods(value, recorder, undo)
    return replaced


def _is_kernel(value: Any) -> bool:
    """Whether this is a compiled function that Python calls; helpers of kernels are not."""
    return isinstance(value, Dispatcher) and bool(value.targetoptions.get("parallel"))


def _time_methods(kind: type, recorder: Recorder, undo: list[tuple[Any, str, Any]]) -> None:
    for name, value in list(vars(kind).items()):
        if name.startswith("__"):
            continue
        label = f"{kind.__module__}.{kind.__qualname__}.{name}"
        if isinstance(value, FunctionType):
            _set(kind, name, recorder.timed(label, value), undo)
        elif isinstance(value, staticmethod):
            _set(kind, name, staticmethod(recorder.timed(label, value.__func__)), undo)


def _set(owner: Any, name: str, value: Any, undo: list[tuple[Any, str, Any]]) -> None:
    undo.append((owner, name, vars(owner)[name]))
    setattr(owner, name, value)


def _modules() -> list[ModuleType]:
    return [module for name, module in sorted(sys.modules.items()) if name.split(".")[0] == PACKAGE]
