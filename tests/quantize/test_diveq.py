from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nsvq_lightning.quantize import DiVeQ, nearest
from nsvq_lightning.quantize.base import as_quantizer, is_refittable
from nsvq_lightning.quantize.nsvq import noise_substitution
from nsvq_lightning.random import generator

DIMS = [3, 45, *(pytest.param(dim, marks=pytest.mark.slow) for dim in (1, 4, 16))]


def problem(dim: int, dtype: torch.dtype = torch.float32, count: int = 523) -> tuple[Tensor, Tensor, Tensor]:
    draw = generator(dim)
    x = torch.randn(count, dim, generator=draw, dtype=torch.float64).to(dtype)
    codebook = torch.randn(40, dim, generator=draw, dtype=torch.float64).to(dtype)
    return x.requires_grad_(), codebook.requires_grad_(), nearest(x, codebook)


def diveq(x: Tensor, codebook: Tensor, codes: Tensor, sigma: float, rows: Tensor | None = None) -> Tensor:
    quantizer = DiVeQ(*codebook.shape, sigma=sigma)
    quantizer.codebook = torch.nn.Parameter(codebook.detach())
    result = quantizer.approximate(x, codes, generator(1), rows)
    quantizer.codebook.register_hook(lambda grad: setattr(codebook, "grad", grad))
    return result


def test_is_a_quantizer_that_gradients_train() -> None:
    assert as_quantizer(DiVeQ(4, 3))
    assert not is_refittable(DiVeQ(4, 3))


@pytest.mark.parametrize("sigma", [0.0, 0.1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dim", DIMS)
def test_gradients_equal_float64_autograd_of_the_formula(dim: int, dtype: torch.dtype, sigma: float) -> None:
    """The direction is recovered from the result; the rest is the formula as it stands in the paper."""
    x, codebook, codes = problem(dim, dtype)
    grad = torch.randn(x.shape, generator=generator(2), dtype=torch.float64)
    x_q = diveq(x, codebook, codes, sigma)
    x_q.backward(grad.to(dtype))
    x_wide, book_wide = (tensor.detach().double().requires_grad_() for tensor in (x, codebook))
    residual = book_wide[codes] - x_wide
    direction = (x_q - x).detach().double()
    direction = direction / direction.norm(dim=1, keepdim=True)
    if sigma == 0:  # then it is known without the result
        known = (residual / residual.norm(dim=1, keepdim=True)).detach()
        torch.testing.assert_close(direction, known, rtol=0, atol=1e-10 if dtype == torch.float64 else 1e-4)
        direction = known
    expected = x_wide + residual.norm(dim=1, keepdim=True) * direction
    torch.testing.assert_close(x_q.detach().double(), expected.detach(), rtol=1e-5, atol=1e-5)
    expected.backward(grad)
    tolerance = 1e-10 if dtype == torch.float64 else 2e-3 if dim == 1 else 2e-4
    for found, wide in ((x.grad, x_wide.grad), (codebook.grad, book_wide.grad)):
        assert found is not None
        torch.testing.assert_close(found.double(), wide, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dim", [3, 45])
def test_direction_is_the_error_plus_noise_of_sigma(dim: int) -> None:
    """Kernel and torch draw other numbers, so moments are compared: across the error, (d/‖d‖)·w ≈ σ v·w / ‖r‖."""
    sigma, count = 1e-3, 20_000
    x = torch.zeros(count, dim)
    code = torch.zeros(1, dim)
    code[0, 0] = 0.5
    codes = torch.zeros(count, dtype=torch.int64)
    for dtype in (torch.float32, torch.float64):
        x_q = diveq(x.to(dtype), code.to(dtype), codes, sigma)
        across = x_q.detach()[:, 1:].double() / sigma  # length 0.5 times direction σ v / 0.5
        assert abs(float(across.mean())) < 4 / across.numel() ** 0.5
        assert abs(float(across.square().mean()) - 1) < 6 * (2 / across.numel()) ** 0.5


@pytest.mark.parametrize("dim", [3, 45])
def test_without_noise_the_value_is_the_code_and_with_much_it_is_noise_substitution(dim: int) -> None:
    x, codebook, codes = problem(dim)
    hard = codebook.detach()[codes]
    torch.testing.assert_close(diveq(x, codebook, codes, 0.0).detach(), hard, rtol=1e-5, atol=1e-6)
    distances = [float((diveq(x, codebook, codes, s).detach() - hard).norm(dim=1).max()) for s in (1e-1, 1e-3, 1e-5)]
    assert distances[0] > 50 * distances[1] > 1000 * distances[2]
    substituted = noise_substitution(x, codebook, codes, generator(1))
    torch.testing.assert_close(diveq(x, codebook, codes, 1e6), substituted, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("dim", [3, 45])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_error_no_move_and_no_radial_gradient(dim: int, dtype: torch.dtype) -> None:
    _, codebook, codes = problem(dim, dtype)
    x = codebook.detach()[codes].clone().requires_grad_()
    for sigma in (0.0, 0.1):
        x.grad = None
        x_q = diveq(x, codebook, codes, sigma)
        assert torch.equal(x_q, x)
        grad = torch.randn(x.shape, generator=generator(2), dtype=torch.float64).to(dtype)
        x_q.backward(grad)
        assert torch.equal(x.grad, grad)
        assert torch.equal(codebook.grad, torch.zeros_like(codebook))


@pytest.mark.parametrize("chosen", [[0, 3, 4, 522], list(range(1, 500, 2)), []])
def test_rows_of_a_table_are_those_rows(chosen: list[int]) -> None:
    x, codebook, codes = problem(45)
    rows = torch.tensor(chosen, dtype=torch.int64)
    picked = x.detach()[rows].requires_grad_()
    x_q, expected = (diveq(t, codebook, codes[rows], 0.1, which) for t, which in ((x, rows), (picked, None)))
    assert torch.equal(x_q, expected)
    weight = torch.randn(len(chosen), 45, generator=generator(2))
    (x_q * weight).sum().backward()
    (expected * weight).sum().backward()
    assert torch.equal(x.grad, torch.zeros_like(x).index_copy_(0, rows, picked.grad))


def test_results_are_a_function_of_the_generator_whatever_the_threads() -> None:
    x, codebook, codes = problem(45)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            x_q = diveq(x, codebook, codes, 0.1)
            x_q.backward(torch.ones_like(x_q))
            results.append(torch.cat((x_q.detach(), codebook.grad)))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*results)
    again = noise_substitution(x, codebook, codes, generator(1, 1), aim=1.0, spread=0.1)
    assert not torch.equal(again, x_q)


def test_gradient_descent_moves_the_codes_to_what_is_wanted() -> None:
    """Rows stand still, the loss wants the codes elsewhere; the gradient of each row is only that along its error."""
    x = torch.randn(400, 3, generator=generator(0))
    quantizer = DiVeQ(8, 3)
    quantizer.fit(x, generator=generator(1))
    codes = quantizer.encode(x)
    wanted = quantizer.decode(codes).detach() + torch.tensor([0.3, -0.2, 0.1])
    losses = []
    for step in range(100):
        loss = (quantizer.approximate(x, codes, generator(2, step), None) - wanted).square().mean()
        (grad,) = torch.autograd.grad(loss, quantizer.codebook)
        with torch.no_grad():
            quantizer.codebook -= 2.0 * grad
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.01 * losses[0]


def test_module_in_its_three_states() -> None:
    x, _, _ = problem(3)
    quantizer = DiVeQ(64, 3)
    quantizer.fit(x, generator=generator(0))
    x_q, codes = quantizer(x, generator(1))
    hard = quantizer.codebook[codes]
    torch.testing.assert_close(x_q, hard, rtol=0, atol=0.02)
    assert not torch.equal(x_q, hard)
    quantizer.eval()
    assert torch.equal(quantizer(x)[0], hard)
    quantizer.train()
    quantizer.freeze(codes.flip(0))
    assert torch.equal(quantizer(x)[0], quantizer.codebook[codes.flip(0)])


@pytest.mark.parametrize("sigma", [-1.0, float("nan"), float("inf")])
def test_impossible_sigma_is_refused(sigma: float) -> None:
    with pytest.raises(ValueError, match="sigma must be finite"):
        DiVeQ(4, 3, sigma=sigma)
