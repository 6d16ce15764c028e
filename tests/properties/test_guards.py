"""The guard words of the tests: they find what a kernel writes beside its arrays, and change nothing else."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from guards import GuardError, guarded
from kernel_calls import Call, judged
from numba import njit, typeof

from nsvq_lightning.compute.memory import Workspace, recycled
from nsvq_lightning.compute.simd import get, put


@njit
def write_at(array: Any, place: int) -> None:
    put(array, place, 7)


@njit
def read_at(array: Any, place: int) -> Any:
    return get(array, place)


@njit
def first_of(array: Any) -> Any:
    return array[0]


@njit
def copy_both(numbers: Any, pair: Any) -> int:
    integers, table = pair
    for i in range(len(numbers)):
        integers[i] += 1
        table[i] = table[i] + numbers[i]
    return len(numbers)


BUFFERS: dict[str, Callable[[], Any]] = {
    "workspace": lambda: Workspace().array("a", 10),
    "rows of a workspace": lambda: Workspace().rows("a", 2, 5).reshape(-1),
    "recycled": lambda: recycled((5, 2)).numpy().reshape(-1),
    "array": lambda: np.empty(10, np.float32),
}


@pytest.mark.parametrize("buffer", BUFFERS)
def test_a_planted_overrun_is_found(buffer: str) -> None:
    """A workspace and ``recycled`` have room behind what they lend: the write hits memory that is there."""
    array = BUFFERS[buffer]()
    with guarded():
        write_at(array, 9)
        for place in (10, -1, 200):
            with pytest.raises(GuardError, match=r"write_at has written beside array 0"):
                write_at(array, place)
    assert array[9] == 7


def test_a_planted_read_beside_an_array_is_found() -> None:
    def last_of(array: Any) -> Any:
        return read_at(array, array.size - 1)

    def behind(array: Any) -> Any:
        return read_at(array, array.size)

    verdicts = [judged(Call(f, inspect.signature(f).bind(np.arange(9.0))), None) for f in (last_of, behind)]
    assert verdicts == ["right", "it depends on what lies beside its arrays"]


def test_an_overrun_of_an_empty_array_is_found() -> None:
    with guarded(), pytest.raises(GuardError):
        write_at(np.empty(0, np.float32), 0)


def test_arrays_in_tuples_that_share_memory_and_have_gaps_come_back() -> None:
    floats, numbers, table = np.zeros(3, np.float32), np.arange(3), np.zeros((3, 4))
    pair = floats.view(np.int32), table[:, 1]
    with guarded():
        assert copy_both(numbers, pair) == 3
    assert floats.view(np.int32).tolist() == [1, 1, 1]
    assert table[:, 1].tolist() == [0, 1, 2]
    assert not table[:, [0, 2, 3]].any()


def test_read_only_arrays_stay_so() -> None:
    words = np.frombuffer(bytes([1, 0, 0, 0, 2, 0, 0, 0]), np.int32)
    with guarded():
        assert first_of(words) == 1
    signatures = [str(types[0]) for types in first_of.signatures]
    assert signatures == [str(typeof(words))]
    assert "readonly" in signatures[0]


def test_without_them_kernels_are_called_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    before = type(write_at).__call__
    with guarded():
        assert type(write_at).__call__ is not before
    assert type(write_at).__call__ is before
