"""The vector type, lane by lane, against NumPy."""

from typing import Any

import numba
import numpy as np
import pytest

from nsvq_lightning.compute import simd
from nsvq_lightning.rendering.formulas import exp2_clamped

Array = np.ndarray[Any, np.dtype[Any]]


def run(function: Any, *arrays: Array, outputs: int = 1) -> Array:
    out = np.zeros((outputs, 16), np.float32)
    numba.njit(function)(*arrays, out.reshape(-1))
    return out if outputs > 1 else out[0]


@pytest.fixture
def values() -> Array:
    return np.random.default_rng(0).uniform(0.1, 4.0, 16 * 17).astype(np.float32)


def test_operators(values: Array) -> None:
    def kernel(a: Array, out: Array) -> None:
        x, y = simd.load(a, 0), simd.load(a, 16)
        simd.store(out, 0, x + y)
        simd.store(out, 16, x - y)
        simd.store(out, 32, x * y)
        simd.store(out, 48, x / y)
        simd.store(out, 64, -x)
        simd.store(out, 80, simd.fma(x, y, simd.broadcast(a[40])))
        simd.store(out, 96, simd.fnma(x, y, simd.broadcast(a[40])))

    x, y, z = values[:16], values[16:32], np.float64(values[40])
    out = run(kernel, values, outputs=7)
    np.testing.assert_array_equal(out[:5], [x + y, x - y, x * y, x / y, -x])
    exact = x.astype(np.float64) * y
    np.testing.assert_allclose(out[5], exact + z, rtol=1.2e-7)
    np.testing.assert_allclose(out[6], z - exact, atol=1e-6)


@pytest.mark.parametrize("kind", [np.float32, np.int32, np.uint16, np.int64])
def test_an_element_as_an_integer(kind: type[np.generic]) -> None:
    numbers = np.array([7, 60_000, 3 if kind is np.uint16 else -3], kind)

    def kernel(a: Array, out: Array) -> None:
        for k in range(3):
            out[k] = simd.integer(a, k) // 2

    assert run(kernel, numbers)[:3].tolist() == (numbers.astype(np.int64) // 2).tolist()


def test_a_scalar_stands_for_a_vector_of_it(values: Array) -> None:
    third = np.float32(1 / 3)

    def kernel(a: Array, out: Array) -> None:
        x = simd.load(a, 0)
        simd.store(out, 0, 2 * x - third)
        simd.store(out, 16, 1 / (x + 0.1))
        simd.store(out, 32, simd.where(x > third, simd.fma(third, x, 1), 0))
        simd.store(out, 48, simd.maximum(2, simd.minimum(x, 3)))
        simd.store(out, 64, third)
        simd.store(out, 80, simd.get(a, 5))
        simd.store(out, 96, simd.load_vectors(a, 16)[2])

    x, one = values[:16], np.float32(1)
    out = run(kernel, values, outputs=7)
    np.testing.assert_allclose(out[0], 2 * x - third, rtol=1e-6)
    np.testing.assert_array_equal(out[1], one / (x + np.float32(0.1)))
    np.testing.assert_allclose(out[2], np.where(x > third, third * x + one, 0), rtol=2e-7)
    np.testing.assert_array_equal(out[3], np.clip(x, 2, 3))
    assert (out[4] == third).all()
    assert (out[5] == values[5]).all()
    np.testing.assert_array_equal(out[6], values[48:64])


def test_minimum_and_maximum_take_the_second_argument_for_nan(values: Array) -> None:
    def kernel(a: Array, out: Array) -> None:
        simd.store(out, 0, simd.minimum(simd.load(a, 0), simd.load(a, 16)))
        simd.store(out, 16, simd.maximum(simd.load(a, 0), simd.load(a, 16)))

    values[3] = np.nan
    out = run(kernel, values, outputs=2)
    np.testing.assert_array_equal(out, [np.fmin(values[:16], values[16:32]), np.fmax(values[:16], values[16:32])])


def test_exponential_and_logarithm() -> None:
    def kernel(a: Array, out: Array) -> None:
        simd.store(out, 0, simd.exp2(simd.load(a, 0)))
        simd.store(out, 16, simd.log2(simd.load(a, 16)))
        simd.store(out, 32, exp2_clamped(simd.load(a, 32)))

    for seed in range(20):
        rng = np.random.default_rng(seed)
        powers = rng.uniform(-100, 100, 16)
        numbers = np.concatenate([2.0 ** rng.uniform(-60, 60, 8), 1 + rng.uniform(-1e-3, 1e-3, 8)])
        extreme = np.concatenate([[-1e30, 1e30, -np.inf, np.inf, np.nan, 0], rng.uniform(-5, 5, 10)])
        out = run(kernel, np.concatenate([powers, numbers, extreme]).astype(np.float32), outputs=3)
        np.testing.assert_allclose(out[0], np.exp2(powers.astype(np.float32).astype(np.float64)), rtol=3e-7)
        expected = np.log2(numbers.astype(np.float32).astype(np.float64))
        np.testing.assert_allclose(out[1], expected, rtol=3e-7, atol=2e-8)
        assert np.isfinite(out[2]).all()
        np.testing.assert_allclose(out[2][:5], [2.0**-125, 2.0**125, 2.0**-125, 2.0**125, 2.0**-125], rtol=3e-7)


def test_masks() -> None:
    def kernel(a: Array, out: Array) -> None:
        low = simd.load(a, 0) < simd.load(a, 16)
        simd.store(out, 0, simd.where(low & (simd.load(a, 0) <= simd.load(a, 16)), simd.load(a, 0), simd.load(a, 16)))
        out[16] = simd.mask_bits(low)
        out[17] = simd.lowest_bit(simd.mask_bits(low))
        out[18] = simd.mask_bits(simd.load(a, 0) > simd.load(a, 0))

    rng = np.random.default_rng(1)
    a = rng.normal(size=32).astype(np.float32)
    out = run(kernel, a, outputs=2)
    low = a[:16] < a[16:]
    np.testing.assert_array_equal(out[0], np.where(low, a[:16], a[16:]))
    assert int(out[1][0]) == sum(int(bit) << lane for lane, bit in enumerate(low))
    assert int(out[1][1]) == int(np.argmax(low))
    assert out[1][2] == 0


@pytest.mark.parametrize("columns", [3, 4])
def test_rows_come_apart(values: Array, columns: int) -> None:
    loader = getattr(simd, f"load_rows{columns}")

    def kernel(a: Array, out: Array) -> None:
        rows = loader(a, 1)
        simd.store(out, 0, rows[0])
        simd.store(out, 16, rows[2])

    out = run(kernel, values, outputs=2)
    matrix = values[1 : 1 + 16 * columns].reshape(16, columns)
    np.testing.assert_array_equal(out, [matrix[:, 0], matrix[:, 2]])


def test_gather_and_scatter(values: Array) -> None:
    def kernel(a: Array, indices: Array, out: Array) -> None:
        columns = simd.gather_columns(a, indices, 0, 16, 1)
        simd.store(out, 0, columns[0])
        simd.store(out, 16, columns[15])
        simd.store(out, 32, simd.transpose(columns)[3])
        triple = simd.gather_rows3(a, indices, 0)
        simd.store(out, 48, triple[2])
        simd.scatter_rows3(out[64:], indices, 0, triple)

    indices = np.random.default_rng(2).permutation(16).astype(np.int32)
    out = run(kernel, values, indices, outputs=7)
    rows = np.stack([values[16 * i + 1 : 16 * i + 17] for i in indices])
    np.testing.assert_array_equal(out[:3], [rows[:, 0], rows[:, 15], rows[3]])
    np.testing.assert_array_equal(out[3], values[:48].reshape(16, 3)[indices, 2])
    np.testing.assert_array_equal(out[4:].ravel(), values[:48])


def test_sums(values: Array) -> None:
    def kernel(a: Array, out: Array) -> None:
        sums = simd.lane_sums((simd.load(a, 0), simd.load(a, 16), simd.load(a, 32)))
        simd.store(out, 0, sums)
        out[16] = simd.lane_sum(simd.load(a, 48))

    out = run(kernel, values, outputs=2)
    np.testing.assert_allclose(out[0][:3], values[:48].reshape(3, 16).sum(1), rtol=1e-6)
    np.testing.assert_array_equal(out[0][3:], 0)
    np.testing.assert_allclose(out[1][0], values[48:64].sum(), rtol=1e-6)


def test_image_blocks() -> None:
    def kernel(image: Array, plane: Array, out: Array) -> None:
        red, green, blue = simd.load_block3(image, 3 * (2 * 9 + 1), 27)
        simd.store(out, 0, red)
        simd.store(out, 16, green)
        simd.store(out, 32, blue)
        simd.store(out, 48, simd.load_block1(plane, 2 * 9 + 1, 9)[0])
        simd.store_block3(image, 3 * (1 * 9 + 4), 27, (red, green, blue))
        simd.store_block1(plane, 1 * 9 + 4, 9, (simd.load(out, 48),))

    rng = np.random.default_rng(3)
    image, plane = rng.normal(size=(8, 9, 3)).astype(np.float32), rng.normal(size=(8, 9)).astype(np.float32)
    before, plane_before = image.copy(), plane.copy()
    out = np.zeros(64, np.float32)
    numba.njit(kernel)(image.reshape(-1), plane.reshape(-1), out)
    block = before[2:6, 1:5]
    for channel in range(3):
        np.testing.assert_array_equal(out[16 * channel : 16 * channel + 16], block[..., channel].ravel())
    before[1:5, 4:8], plane_before[1:5, 4:8] = block.copy(), plane_before[2:6, 1:5].copy()
    np.testing.assert_array_equal(image, before)
    np.testing.assert_array_equal(plane, plane_before)


def test_column_bits() -> None:
    def kernel(masks: Array, found: Array) -> None:
        for bit in range(16):
            found[bit] = simd.column_bits(masks, 1, bit)

    masks = np.random.default_rng(4).integers(0, 1 << 16, 65).astype(np.uint16)
    found = np.zeros(16, np.int64)
    numba.njit(kernel)(masks, found)
    for bit in range(16):
        expected = sum(((int(mask) >> bit) & 1) << k for k, mask in enumerate(masks[1:]))
        assert int(found[bit]) & (2**64 - 1) == expected
