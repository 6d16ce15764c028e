from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from nsvq_lightning.io.nsvq.paper import pack_fields, unpack_fields


def _big_integer(fields: Sequence[NDArray[np.int64]], widths: Sequence[int]) -> bytes:
    """Oracle: the whole stream as one integer of Python."""
    stream = position = 0
    for row in zip(*fields, strict=True):
        for value, width in zip(row, widths, strict=True):
            stream |= int(value) << position
            position += width
    return stream.to_bytes(-(-position // 8), "little")


def _random_fields(rows: int, widths: Sequence[int]) -> list[NDArray[np.int64]]:
    rng = np.random.default_rng([rows, *widths])
    return [rng.integers(0, 1 << width, rows) for width in widths]


@pytest.mark.parametrize(
    ("rows", "widths"),
    [
        (0, [14, 12]),
        (1, [1]),
        (5, [0, 3, 0]),
        (7, [14, 14, 12, 12]),
        (13, [1, 32, 5]),
        (9, [16, 17, 31, 32, 24]),
        (3, [0]),
        ((1 << 14) + 3, [9]),
    ],
)
def test_stream_is_the_big_integer_and_comes_back(rows: int, widths: list[int]) -> None:
    fields = _random_fields(rows, widths)
    packed = pack_fields(fields, widths)
    assert packed == _big_integer(fields, widths)
    assert len(packed) == -(-rows * sum(widths) // 8)
    for field, back in zip(fields, unpack_fields(packed, rows, widths), strict=True):
        np.testing.assert_array_equal(back, field)


def test_known_bytes() -> None:
    # 3 bits and 5 bits a row: 5 | 17 << 3 = 0x8D, 2 | 30 << 3 = 0xF2.
    assert pack_fields([np.array([5, 2]), np.array([17, 30])], [3, 5]) == bytes([0x8D, 0xF2])
