"""Rows as whole multiples of a basis."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nsvq_lightning.compression.components import components
from nsvq_lightning.random import generator


def rows(count: int = 2000, rank: int = 4) -> torch.Tensor:
    draws = generator(0)
    return torch.randn(count, rank, generator=draws) @ torch.randn(rank, 24, generator=draws)


def error(x: torch.Tensor, found: tuple[np.ndarray, np.ndarray]) -> torch.Tensor:
    coefficients, basis = found
    return (x.double() - torch.from_numpy(coefficients.astype(np.float64) @ basis.astype(np.float64))).square().sum(1)


def test_rows_of_low_rank_take_few_components() -> None:
    x = rows()
    coefficients, basis = found = components(x, torch.ones(len(x)), 0.01)
    assert basis.shape[0] <= 6
    np.testing.assert_array_equal(coefficients, np.rint(coefficients))
    # Uniform rounding: a twelfth of a squared step for each component.
    step = float(np.linalg.norm(basis[0]))
    assert float(error(x, found).mean()) < 6 * step**2 / 6


def test_dear_bits_make_fewer_and_smaller_coefficients() -> None:
    x = rows()
    found = [components(x, torch.ones(len(x)), price) for price in (0.01, 0.3, 3.0)]
    sizes, errors = [np.abs(each[0]).sum() for each in found], [float(error(x, each).mean()) for each in found]
    assert sizes == sorted(sizes, reverse=True)
    assert errors == sorted(errors)


def test_rows_that_hardly_show_have_fewer() -> None:
    x, weights = rows(), torch.cat([torch.full((1000,), 0.01), torch.ones(1000)])
    coefficients, _ = found = components(x, weights, 0.3)
    assert np.abs(coefficients[:1000]).sum() < 0.5 * np.abs(coefficients[1000:]).sum()
    assert float(error(x, found)[1000:].mean()) < float(error(x, found)[:1000].mean())


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_equal_rows_have_one_component(value: float) -> None:
    coefficients, basis = components(torch.full((50, 9), value), torch.ones(50), 0.1)
    assert basis.shape == (1, 9)
    torch.testing.assert_close(torch.from_numpy(coefficients @ basis), torch.full((50, 9), value), rtol=0.5, atol=1e-6)
