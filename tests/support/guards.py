"""Guard words: every array that a kernel is called with lies between words that it must leave alone.

Compiled code looks at no bounds, so a write past the end of an array changes whatever lies there, and shows iterations
later or never. With :func:`guarded` a kernel works on copies of its arrays, each in the middle of a block of its own,
and the words around them are looked at after every call: whoever allocated the arrays (a workspace, ``recycled``, an
entry point), and however much longer they are than what is passed on. What a kernel reads past an end are guard words,
too, not the neighbour that happens to lie there: with other words it computes something else.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, NamedTuple

import numpy as np
import torch
from numba.core.registry import CPUDispatcher
from torch import Tensor

GUARD = 4096
"""Bytes before and after each array."""
WORD = 0xA5


class GuardError(AssertionError):
    """A kernel has written beside its arrays."""


class _Block(NamedTuple):
    """Memory from ``low`` to ``high``, copied into ``data`` between guard words."""

    low: int
    high: int
    data: np.ndarray[Any, np.dtype[np.uint8]]

    def is_intact(self, word: int) -> bool:
        return bool((self.data[:GUARD] == word).all() and (self.data[GUARD + self.high - self.low :] == word).all())


@contextmanager
def guarded(word: int = WORD) -> Iterator[None]:
    """Check guard words after every call of a kernel from Python, in the body of a ``with`` statement.

    Kernels are those of Numba, and those that Triton interprets.

    Raises:
        GuardError: A kernel has written beside its arrays; it names kernel and argument.
    """
    interpreter = sys.modules.get("triton.runtime.interpreter")
    kinds: list[Any] = [CPUDispatcher, *([] if interpreter is None else [interpreter.GridExecutor])]
    before = [kind.__call__ for kind in kinds]
    for kind, call in zip(kinds, before, strict=True):
        kind.__call__ = _checked(inspect.unwrap(call), word)
    try:
        yield
    finally:
        for kind, call in zip(kinds, before, strict=True):
            kind.__call__ = call


def _checked(call: Callable[..., Any], word: int) -> Callable[..., Any]:
    @wraps(call)
    def checked(kernel: Any, *arguments: Any, **options: Any) -> Any:
        return _call(lambda *copies: call(kernel, *copies, **options), kernel, arguments, word)

    return checked


def _call(call: Callable[..., Any], kernel: Any, arguments: tuple[Any, ...], word: int) -> Any:
    tensors = {id(value): value.detach().numpy() for value in arguments if isinstance(value, Tensor)}
    given = _replaced(arguments, tensors)
    arrays = list(_arrays(given))
    blocks = _blocks(arrays, word)
    copies = {id(array): _copy(array, blocks) for array in arrays}
    copies |= {number: torch.from_numpy(copies[id(array)]) for number, array in tensors.items()}
    result = call(*_replaced(arguments, copies))
    for number, array in enumerate(arrays):
        if not _block_of(array, blocks).is_intact(word):
            name = getattr(kernel, "py_func", kernel.fn if hasattr(kernel, "fn") else kernel)
            raise GuardError(f"{name.__module__}.{name.__name__} has written beside array {number}")
        if array.flags.writeable:
            np.copyto(array, copies[id(array)])
    return result


def _arrays(value: Any) -> Iterator[Any]:
    """All arrays in arguments, which may be in tuples."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from _arrays(part)


def _replaced(value: Any, copies: dict[int, Any]) -> Any:
    if isinstance(value, np.ndarray | Tensor):
        return copies.get(id(value), value)
    if isinstance(value, tuple):
        parts = (_replaced(part, copies) for part in value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def _span(array: Any) -> tuple[int, int]:
    """Where an array begins and ends in memory; NumPy's function for it is in another place before 2.0."""
    first = array.__array_interface__["data"][0]
    reach = [(length - 1) * stride for length, stride in zip(array.shape, array.strides, strict=True)]
    low, high = (sum(pick(way, 0) for way in reach) for pick in (min, max))
    return first + low, first + high + array.itemsize


def _blocks(arrays: list[Any], word: int) -> list[_Block]:
    """A block for each array; one for those that share memory, such as records as floats and as integers."""
    spans: list[list[int]] = []
    for low, high in sorted(_span(array) for array in arrays if array.size):
        if spans and low < spans[-1][1]:
            spans[-1][1] = max(spans[-1][1], high)
        else:
            spans.append([low, high])
    return [_Block(low, high, np.full(high - low + 2 * GUARD, word, np.uint8)) for low, high in [*spans, (0, 0)]]


def _block_of(array: Any, blocks: list[_Block]) -> _Block:
    """The block of an array; that of no bytes for an empty one."""
    if array.size == 0:
        return blocks[-1]
    low, _ = _span(array)
    return next(block for block in blocks if block.low <= low < block.high)


def _copy(array: Any, blocks: list[_Block]) -> Any:
    """The array in its block, as the compiler sees it: with the same strides, and read-only if it is."""
    block = _block_of(array, blocks)
    place = GUARD + (array.__array_interface__["data"][0] - block.low if array.size else 0)
    copy = np.ndarray(array.shape, array.dtype, block.data.data, place, array.strides)
    np.copyto(copy, array)
    copy.flags.writeable = array.flags.writeable
    return copy
