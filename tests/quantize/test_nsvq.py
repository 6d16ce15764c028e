"""Noise substitution, as NSVQ and DiVeQ use it: values, gradients in closed form, and the noise itself."""

from typing import Any

import numba
import numpy as np
import pytest
import torch
from threads import use_threads
from torch import Tensor

from nsvq_lightning.quantize import NSVQ, CodebookQuantizer, DiVeQ, nearest, substitution
from nsvq_lightning.quantize.nsvq import noise_substitution
from nsvq_lightning.quantize.substitution import fill_normal
from nsvq_lightning.random import generator

DIMS = [4, 9, 45, *(pytest.param(dim, marks=pytest.mark.slow) for dim in (1, 16))]
KINDS = pytest.mark.parametrize(("aim", "spread"), [(0.0, 1.0), (1.0, 0.1), (1.0, 0.0)])
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def problem(dim: int, dtype: torch.dtype = torch.float32, count: int = 523) -> tuple[Tensor, Tensor, Tensor]:
    draw = generator(dim)
    x = torch.randn(count, dim, generator=draw, dtype=torch.float64).to(dtype)
    codebook = torch.randn(40, dim, generator=draw, dtype=torch.float64).to(dtype)
    return x.requires_grad_(), codebook.requires_grad_(), nearest(x, codebook)


@KINDS
@DTYPES
@pytest.mark.parametrize("dim", DIMS)
def test_values_and_gradients_equal_autograd_of_the_formula(
    dim: int, dtype: torch.dtype, aim: float, spread: float
) -> None:
    """The direction is recovered from the result, or known if there is no noise in it."""
    x, codebook, codes = problem(dim, dtype)
    grad = torch.randn(x.shape, generator=generator(2), dtype=torch.float64)
    x_q = noise_substitution(x, codebook, codes, generator(1), aim=aim, spread=spread)
    x_q.backward(grad.to(dtype))
    x_wide, book_wide = (tensor.detach().double().requires_grad_() for tensor in (x, codebook))
    residual = book_wide[codes] - x_wide
    length = residual.norm(dim=1, keepdim=True)
    moved = residual.detach() if spread == 0 else (x_q - x).detach().double()
    expected = x_wide + length * moved / moved.norm(dim=1, keepdim=True)
    rounding = 20 * torch.finfo(dtype).eps
    torch.testing.assert_close(x_q.detach().double(), expected.detach(), rtol=rounding, atol=rounding)
    expected.backward(grad)
    # Rounding spoils the direction where x is near its code.
    tolerance = 1e-10 if dtype == torch.float64 else 2e-3 if dim == 1 else 2e-4
    for found, wide in ((x.grad, x_wide.grad), (codebook.grad, book_wide.grad)):
        assert found is not None
        torch.testing.assert_close(found.double(), wide, rtol=tolerance, atol=tolerance)


@KINDS
@DTYPES
@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("chosen", [[0, 3, 4, 522], [7], list(range(523)), list(range(1, 500, 2)), []])
def test_rows_of_a_table_are_those_rows_and_the_others_get_no_gradient(
    dim: int, dtype: torch.dtype, chosen: list[int], aim: float, spread: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(substitution, "recycled", lambda shape: torch.full(shape, torch.nan))
    x, codebook, codes = problem(dim, dtype)
    rows = torch.tensor(chosen, dtype=torch.int64)
    weight = torch.randn(len(chosen), dim, generator=generator(2), dtype=dtype)
    results = []
    for table, which in ((x, rows), (x.detach()[rows].requires_grad_(), None)):
        codebook.grad = None
        x_q = noise_substitution(table, codebook, codes[rows], generator(1), which, aim=aim, spread=spread)
        x_q.backward(weight)
        results.append((x_q.detach(), table.grad, codebook.grad))
    (x_q, grad, book), (expected_q, expected_grad, expected_book) = results
    assert torch.equal(x_q, expected_q)
    assert torch.equal(grad, torch.zeros_like(x).index_copy_(0, rows, expected_grad))
    assert torch.equal(book, expected_book)


@KINDS
@DTYPES
@pytest.mark.parametrize("dim", [3, 45])
def test_no_error_no_move_and_no_radial_gradient(dim: int, dtype: torch.dtype, aim: float, spread: float) -> None:
    x, codebook, codes = problem(dim, dtype)
    x = codebook.detach()[codes].clone().requires_grad_()
    x_q = noise_substitution(x, codebook, codes, generator(1), aim=aim, spread=spread)
    assert torch.equal(x_q, x)
    grad = torch.randn(x.shape, generator=generator(2), dtype=torch.float64).to(dtype)
    x_q.backward(grad)
    assert torch.equal(x.grad, grad)
    assert torch.equal(codebook.grad, torch.zeros_like(codebook))


@KINDS
def test_results_are_a_function_of_the_generator_whatever_the_threads(aim: float, spread: float) -> None:
    x, codebook, codes = problem(45)
    results = []
    for threads in (1, 2):
        with use_threads(threads):
            codebook.grad = None
            x_q = noise_substitution(x, codebook, codes, generator(1), aim=aim, spread=spread)
            x_q.backward(torch.ones_like(x_q))
            results.append(torch.cat((x_q.detach(), codebook.grad)))
    assert torch.equal(*results)
    other = noise_substitution(x, codebook, codes, generator(1, 1), aim=aim, spread=spread)
    assert torch.equal(other, x_q) == (spread == 0)
    first_rows = noise_substitution(x[:300], codebook, codes[:300], generator(1), aim=aim, spread=spread)
    assert torch.equal(first_rows, x_q[:300])


def normal_values(seed: int, vectors: int) -> np.ndarray[Any, Any]:
    """The first values of a seed, as the kernels draw them."""
    out = np.empty(16 * vectors, np.float32)
    numba.njit(lambda out: fill_normal(seed, 0, vectors, out))(out)
    return out


def test_noise_is_normal() -> None:
    """Moments, and Kolmogorov's distance to scipy's normal distribution, at about four standard errors."""
    from scipy import stats

    draws = normal_values(20240521, 2 * 8000)
    count = draws.size
    assert abs(draws.mean()) < 4 / count**0.5
    assert abs(draws.var() - 1) < 4 * (2 / count) ** 0.5
    assert abs(stats.skew(draws)) < 4 * (6 / count) ** 0.5
    assert abs(stats.kurtosis(draws)) < 4 * (24 / count) ** 0.5
    assert stats.kstest(draws, "norm").statistic < 2.0 / count**0.5
    for lag in (1, 2, 15, 16, 17, 32, 45, 1024):
        assert abs((draws[lag:] * draws[:-lag]).mean()) < 4 / (count - lag) ** 0.5
    other = normal_values(20240522, 2 * 8000)
    for lag in (0, 16, 32):
        assert abs((draws[lag:] * other[: count - lag]).mean()) < 4 / count**0.5


def test_direction_is_uniform_on_the_sphere() -> None:
    """A unit vector has mean 0 and covariance I/D."""
    for dim in (3, 4, 45):
        x, codebook = torch.zeros(20000, dim), torch.ones(1, dim) / dim**0.5
        unit = noise_substitution(x, codebook, torch.zeros(20000, dtype=torch.int64), generator(dim))
        assert float(unit.mean(0).abs().max()) < 5 / (20000 * dim) ** 0.5
        covariance = unit.T @ unit / 20000 - torch.eye(dim) / dim
        assert float(covariance.abs().max()) < 6 * 2**0.5 / (dim * 20000**0.5)


@DTYPES
@pytest.mark.parametrize("dim", [3, 45])
def test_direction_is_the_error_plus_noise_of_sigma(dim: int, dtype: torch.dtype) -> None:
    """Kernel and torch draw other numbers, so moments are compared: across the error, (d/‖d‖)·w ≈ σ v·w / ‖r‖."""
    sigma, count = 1e-3, 20_000
    x, code = torch.zeros(count, dim, dtype=dtype), torch.zeros(1, dim, dtype=dtype)
    code[0, 0] = 0.5
    codes = torch.zeros(count, dtype=torch.int64)
    x_q = noise_substitution(x, code, codes, generator(1), aim=1.0, spread=sigma)
    across = x_q[:, 1:].double() / sigma  # length 0.5 times direction σ v / 0.5
    assert abs(float(across.mean())) < 4 / across.numel() ** 0.5
    assert abs(float(across.square().mean()) - 1) < 6 * (2 / across.numel()) ** 0.5


@pytest.mark.parametrize("dim", [3, 45])
def test_with_less_noise_the_value_comes_nearer_to_the_code_and_with_much_it_is_nsvq(dim: int) -> None:
    x, codebook, codes = (tensor.detach() for tensor in problem(dim))
    results = [
        noise_substitution(x, codebook, codes, generator(1), aim=1.0, spread=sigma) for sigma in (1e-1, 1e-3, 1e-5, 1e6)
    ]
    distances = [float((x_q - codebook[codes]).norm(dim=1).max()) for x_q in results]
    assert distances[0] > 50 * distances[1] > 1000 * distances[2]
    torch.testing.assert_close(results[3], noise_substitution(x, codebook, codes, generator(1)), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("kind", [NSVQ, DiVeQ])
def test_module_in_its_three_states(kind: type[CodebookQuantizer]) -> None:
    x = problem(3)[0].detach()
    quantizer = kind(64, 3)
    quantizer.fit(x, generator=generator(0))
    x_q, codes = quantizer(x, generator(1))
    hard = quantizer.codebook[codes]
    torch.testing.assert_close((x_q - x).norm(dim=1), (hard - x).norm(dim=1), rtol=1e-4, atol=1e-6)
    assert not torch.equal(x_q, hard)
    assert ((x_q - hard).abs().max() < 0.02) == (kind is DiVeQ)
    quantizer.eval()
    assert torch.equal(quantizer(x)[0], hard)
    quantizer.train()
    quantizer.freeze(codes.flip(0))
    rows = torch.tensor([4, 2, 500])
    x_q, frozen = quantizer(x, rows=rows)
    assert torch.equal(frozen, codes.flip(0)[rows])
    assert torch.equal(x_q, quantizer.codebook[frozen])
    with pytest.raises(ValueError, match="rows"):
        quantizer(x[:5])


def test_refusals() -> None:
    with pytest.raises(ValueError, match="generator"):
        NSVQ(4, 3)(torch.zeros(2, 3))
    for sigma in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="sigma must be finite"):
            DiVeQ(4, 3, sigma=sigma)
