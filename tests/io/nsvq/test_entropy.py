"""Entropy coding: exact both ways, near the entropy, and one clear error for altered bytes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.nsvq.entropy import (
    decode_integers,
    decode_keys,
    decode_paths,
    encode_integers,
    encode_keys,
    encode_paths,
)


def before(count: int) -> NDArray[np.int32]:
    """The two rows before each row."""
    rows = np.stack([np.arange(count) - 1, np.arange(count) - 2], 1).astype(np.int32)
    return np.maximum(rows, np.int32(-1))


def keys_of(rng: np.random.Generator, count: int) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """Ascending keys of mixed depths, some of them equal."""
    depths = 3 * rng.integers(0, 22, count)
    keys = rng.integers(0, 1 << 63, count, dtype=np.uint64) >> rng.integers(0, 30, count, dtype=np.uint64)
    keys = keys >> (63 - depths).astype(np.uint64) << (63 - depths).astype(np.uint64)
    order = np.argsort(keys, kind="stable")
    return keys[order], depths[order]


@pytest.mark.parametrize("bits", [0, 1, 7, 16, 17, 32])
@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_paths_come_back(count: int, bits: int) -> None:
    paths = np.random.default_rng([count, bits]).integers(0, 1 << bits, count)
    data = encode_paths(paths, bits, before(count))
    np.testing.assert_array_equal(decode_paths(data, bits, before(count)), paths)


@pytest.mark.parametrize("count", [0, 1, 2, 5000])
def test_keys_come_back(count: int) -> None:
    keys, depths = keys_of(np.random.default_rng(count), count)
    np.testing.assert_array_equal(decode_keys(encode_keys(keys, depths), depths), keys)


@pytest.mark.parametrize("shape", [(0, 3), (1, 1), (300, 5)])
def test_integers_come_back(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape)
    values = np.rint(rng.standard_normal(shape) * 10.0 ** rng.integers(0, 15, shape[1])).astype(np.int64)
    values[:, -1:] = 0
    if shape[0] > 3:
        values[:3, 0] = 2**52 - 1, 1 - 2**52, 2**51
    np.testing.assert_array_equal(decode_integers(encode_integers(values), *shape), values)


def test_surprises_carry_through_the_words() -> None:
    """Long runs of one bit and then the other one make intervals that end in many ones."""
    rng = np.random.default_rng(0)
    for run in (10, 300, 5000):
        paths = np.repeat(rng.integers(0, 2, 40), rng.integers(1, run, 40))
        np.testing.assert_array_equal(
            decode_paths(encode_paths(paths, 1, before(len(paths))), 1, before(len(paths))), paths
        )


def test_paths_take_little_more_than_their_entropy() -> None:
    rng = np.random.default_rng(1)
    chances = rng.dirichlet(np.full(64, 0.3))
    paths = rng.choice(64, 50_000, p=chances)
    entropy = -np.sum(chances[chances > 0] * np.log2(chances[chances > 0]))
    none = np.full((len(paths), 2), -1, np.int32)
    bits = 8 * len(encode_paths(paths, 6, none)) / len(paths)
    assert entropy * 0.99 < bits < entropy * 1.03


def test_a_neighbour_that_is_alike_saves_bits() -> None:
    rng = np.random.default_rng(2)
    walk = np.cumsum(rng.integers(-1, 2, 30_000)) % 256
    none = np.full((len(walk), 2), -1, np.int32)
    assert len(encode_paths(walk, 8, before(len(walk)))) < 0.8 * len(encode_paths(walk, 8, none))


def test_paths_that_change_along_the_file_cost_what_they_do_nearby() -> None:
    """Without neighbours: each is one of 8 values of 256, others further on."""
    rng = np.random.default_rng(6)
    paths = (rng.integers(0, 8, 50_000) + np.arange(50_000) // 200) % 256
    none = np.full((len(paths), 2), -1, np.int32)
    assert 8 * len(encode_paths(paths, 8, none)) / len(paths) < 3 * 1.25


def test_sorted_keys_cost_the_points_but_not_their_order() -> None:
    rng = np.random.default_rng(3)
    count, depth = 30_000, 36
    keys = np.sort(rng.integers(0, 1 << depth, count, dtype=np.uint64)) << np.uint64(63 - depth)
    bits = 8 * len(encode_keys(keys, np.full(count, depth))) / count
    # log2(2^36^N / N!) / N, by Stirling.
    assert bits == pytest.approx(depth - np.log2(count) + np.log2(np.e), rel=0.02)


def test_smooth_columns_are_stored_as_differences() -> None:
    rng = np.random.default_rng(4)
    noise, walk = rng.integers(-500, 500, 5000), np.cumsum(rng.integers(-1, 2, 5000))
    both = 8 * len(encode_integers(np.stack([noise, walk], 1))) / 5000
    assert both < np.log2(1000) + np.log2(3) + 0.3


def test_columns_that_differ_by_little_are_stored_as_differences() -> None:
    rng = np.random.default_rng(7)
    values = rng.integers(-5000, 5000, (3000, 1)) + rng.integers(-4, 5, (3000, 3))
    assert 8 * len(encode_integers(values)) / 3000 < np.log2(10_000) + 2 * np.log2(17) + 1
    walk = np.cumsum(values, 0)
    assert 8 * len(encode_integers(walk)) / 3000 < np.log2(10_000) + 2 * np.log2(17) + 1
    np.testing.assert_array_equal(decode_integers(encode_integers(walk), *walk.shape), walk)


def test_an_unknown_mode_of_a_column_is_an_error() -> None:
    data = encode_integers(np.zeros((10, 2), np.int64))
    with pytest.raises(FormatError, match="mode 4, the largest is 3"):
        decode_integers(b"\x04" + data[1:], 10, 2)


def test_other_lengths_are_an_error() -> None:
    paths = np.random.default_rng(5).integers(0, 256, 100)
    data = encode_paths(paths, 8, before(100))
    for wrong in (data[:-1], data[:-8], data + bytes(8)):
        with pytest.raises(FormatError, match="damaged: an entropy-coded stream"):
            decode_paths(wrong, 8, before(100))
    with pytest.raises(FormatError, match="2 bytes for 3 columns"):
        decode_integers(b"ab", 10, 3)


@pytest.mark.parametrize("seed", range(20))
def test_altered_bytes_never_lead_out_of_the_arrays(seed: int) -> None:
    """Whatever the bytes are, what is decoded has its shape and its range, or is refused."""
    rng = np.random.default_rng(seed)
    data = rng.bytes(4 * int(rng.integers(0, 60)))
    depths = 3 * rng.integers(0, 22, 200)
    attempts = (
        lambda: (decode_paths(data, 12, before(200)) >= 0).all(),
        lambda: (decode_keys(data, depths) < 1 << 63).all(),
        lambda: (np.abs(decode_integers(data, 50, 3).astype(np.float64)) <= 2.0**64).all(),
    )
    for attempt in attempts:
        try:
            assert attempt()
        except FormatError:
            continue


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_an_order_of_rows_is_as_good_as_the_rows_in_that_order(dtype: type[np.signedinteger]) -> None:
    rng = np.random.default_rng(3)
    values = np.cumsum(rng.integers(-9, 9, (300, 3)), axis=0).astype(dtype)
    order = rng.permutation(300)
    assert encode_integers(values, order) == encode_integers(values[order].astype(np.int64))
    with pytest.raises(ValueError, match="order must be in"):
        encode_integers(values, order + 1)
    with pytest.raises(TypeError, match="values must be int64"):
        encode_integers(values.astype(np.int16))
