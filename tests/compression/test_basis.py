"""Rows as whole multiples of a basis."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nsvq_lightning.compression.basis import components
from nsvq_lightning.random import generator


def rows(count: int = 2000, rank: int = 4) -> torch.Tensor:
    draws = generator(0)
    return torch.randn(count, rank, generator=draws) @ torch.randn(rank, 24, generator=draws)


def error(x: torch.Tensor, found: tuple[np.ndarray, np.ndarray]) -> torch.Tensor:
    coefficients, basis = found
    return (x.double() - torch.from_numpy(coefficients.astype(np.float64) @ basis.astype(np.float64))).square().sum(1)


def test_rows_of_low_rank_take_few_components() -> None:
    x = rows()
    coefficients, basis = found = components(x, torch.ones(len(x)), 0.1)
    assert basis.shape[0] <= 6
    np.testing.assert_array_equal(coefficients, np.rint(coefficients))
    # Uniform rounding: a twelfth of a squared step for each component.
    step = float(np.linalg.norm(basis[0]))
    assert float(error(x, found).mean()) < 6 * step**2 / 6


def test_long_steps_make_fewer_and_smaller_coefficients() -> None:
    x = rows()
    found = [components(x, torch.ones(len(x)), step) for step in (0.1, 0.5, 1.5)]
    sizes, errors = [np.abs(each[0]).sum() for each in found], [float(error(x, each).mean()) for each in found]
    assert sizes == sorted(sizes, reverse=True)
    assert errors == sorted(errors)


def test_rows_that_hardly_show_have_fewer() -> None:
    x, weights = rows(), torch.cat([torch.full((1000,), 0.01), torch.ones(1000)])
    coefficients, _ = found = components(x, weights, 0.8)
    assert np.abs(coefficients[:1000]).sum() < 0.8 * np.abs(coefficients[1000:]).sum()
    assert float(error(x, found)[1000:].mean()) < float(error(x, found)[:1000].mean())


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_equal_rows_have_one_component(value: float) -> None:
    coefficients, basis = components(torch.full((50, 9), value), torch.ones(50), 0.5)
    assert basis.shape == (1, 9)
    torch.testing.assert_close(torch.from_numpy(coefficients @ basis), torch.full((50, 9), value), rtol=0.5, atol=1e-6)


def test_one_huge_row_does_not_make_others_coarse() -> None:
    x, weights = rows(), torch.ones(2000)
    x[7], weights[7] = 1e6, 1e-12
    coefficients, _ = found = components(x, weights, 0.2)
    assert np.abs(coefficients).max() <= 4095
    kept = torch.arange(2000) != 7
    assert float(error(x, found)[kept].mean()) < 0.05 * float(x[kept].square().sum(1).mean())
