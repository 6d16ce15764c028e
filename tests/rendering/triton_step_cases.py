"""The Triton kernels of the loss and of Adam against float64, on a GPU or under Triton's interpreter.

See ``triton_cases.py`` on how this is run.
"""

from __future__ import annotations

import math

import pytest
import torch

from nsvq_lightning.quality import loss as losses
from nsvq_lightning.quality.loss import photometric_loss, ssim
from nsvq_lightning.training import optim
from nsvq_lightning.training.adam_cpu import adam_update as adam_update_cpu
from nsvq_lightning.training.adam_cuda import adam_update

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture(autouse=True)
def kernels_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the interpreter float32 tensors on the CPU stand for those on a GPU."""
    for module in (losses, optim):
        monkeypatch.setattr(module, "kernels_for", lambda x: "cuda" if x.dtype == torch.float32 else None)


def pair(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(height * 1000 + width)
    image = 1.5 * torch.rand(height, width, 3, generator=generator) - 0.25
    image[0, 0] = torch.tensor([0.0, 1.0, 0.5])  # at the limits there still is a gradient
    noise = 0.2 * torch.randn(height, width, 3, generator=generator)
    return image, (image + noise).clamp(0, 1)


@pytest.mark.parametrize(
    ("height", "width", "weight", "bytes_"),
    [(9, 43, 0.2, False), (9, 20, 0.2, True), (1, 1, 1.0, False), (3, 2, 1.0, True), (17, 5, 0.0, False)],
)
def test_loss_and_gradient(height: int, width: int, weight: float, bytes_: bool) -> None:
    image, target = pair(height, width)
    photo = (255 * target).round().to(torch.uint8) if bytes_ else target
    leaf, oracle = image.to(DEVICE).requires_grad_(), image.double().requires_grad_()
    loss = photometric_loss(leaf, photo.to(DEVICE), weight)
    expected = photometric_loss(oracle, photo.double() / 255 if bytes_ else photo.double(), weight)
    (gradient,) = torch.autograd.grad(3 * loss, leaf, retain_graph=True)
    (expected_gradient,) = torch.autograd.grad(3 * expected, oracle)
    assert loss.dtype == torch.float32
    assert loss.item() == pytest.approx(expected.item(), rel=2e-6, abs=2e-7)
    difference = (gradient.cpu().double() - expected_gradient).norm()
    assert difference <= 2e-6 * expected_gradient.norm()
    assert not gradient.cpu()[(image < 0) | (image > 1)].any()
    (again,) = torch.autograd.grad(3 * loss, leaf)
    assert torch.equal(gradient, again)


def test_ssim_without_gradient() -> None:
    image, target = (x.clamp(0, 1) for x in pair(13, 17))
    expected = ssim(image.double(), target.double()).item()
    assert ssim(image.to(DEVICE), target.to(DEVICE)).item() == pytest.approx(expected, abs=1e-6)
    with torch.no_grad():
        loss = photometric_loss(image.to(DEVICE), target.to(DEVICE), 1.0)
    assert loss.item() == pytest.approx(1 - expected, abs=1e-6)


def test_strided_images() -> None:
    image, target = pair(12, 10)
    leaf = image.to(DEVICE).transpose(0, 1).requires_grad_()
    photometric_loss(leaf, target.to(DEVICE).transpose(0, 1)).backward()
    oracle = image.double().transpose(0, 1).requires_grad_()
    photometric_loss(oracle, target.double().transpose(0, 1)).backward()
    torch.testing.assert_close(leaf.grad.cpu().double(), oracle.grad, rtol=1e-4, atol=1e-8)


def test_a_loss_that_is_no_number_stays_none() -> None:
    image, target = pair(12, 12)
    image[3, 4, 1] = torch.nan
    assert photometric_loss(image.to(DEVICE), target.to(DEVICE)).isnan()


def moments(shape: tuple[int, ...], seed: int) -> list[torch.Tensor]:
    """Weights, gradients, and the two moments after some steps; a third of the rows has no gradient."""
    draw = torch.Generator().manual_seed(seed)
    weights, gradients, first, second = (torch.randn(shape, generator=draw) for _ in range(4))
    gradients[::3] = 0
    return [weights, 1e-4 * gradients, 1e-4 * first, 1e-8 * second.square()]


OPTIONS = {"step": 7, "lr": 2.5e-3, "betas": (0.9, 0.999), "eps": 1e-15}


@pytest.mark.parametrize("shape", [(1,), (1025,), (37, 3), (130, 4), (33, 1, 3), (50, 15, 3)])
@pytest.mark.parametrize("kind", ["all", "rows", "columns"])
def test_adam_is_the_one_of_the_cpu(shape: tuple[int, ...], kind: str) -> None:
    stride = math.prod(shape[1:])
    columns = {"rows_with_gradient": kind == "rows", "columns": stride - 1 if kind == "columns" else None}
    found = [tensor.to(DEVICE, copy=True) for tensor in moments(shape, 3)]
    expected = moments(shape, 3)
    if kind == "columns":  # the caller's promise
        for tensor in (*found[1:], *expected[1:]):
            tensor.view(shape[0], stride)[:, stride - 1 :] = 0
    adam_update(*found, **OPTIONS, **columns)()
    adam_update_cpu(*expected, **OPTIONS, **columns)()
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.cpu(), b, rtol=2e-6, atol=1e-12)
    start = moments(shape, 3)
    if kind == "rows":
        assert all(torch.equal(a.cpu()[::3], b[::3]) for a, b in zip(found, start, strict=True))


def test_a_row_with_nan_has_a_gradient_and_empty_tables_have_none() -> None:
    tables = [tensor.to(DEVICE) for tensor in moments((4, 3), 1)]
    tables[1][0] = torch.tensor([0.0, torch.nan, 0.0])
    adam_update(*tables, **OPTIONS, rows_with_gradient=True)()
    assert tables[0].isnan().nonzero().tolist() == [[0, 1]]
    empty = [torch.zeros(0, 15, 3, device=DEVICE) for _ in range(4)]
    adam_update(*empty, **OPTIONS)()
    none = [torch.zeros(5, 0, 3, device=DEVICE) for _ in range(4)]
    adam_update(*none, **OPTIONS)()
    before = tables[0].clone()
    adam_update(*tables, **OPTIONS, columns=0)()
    assert torch.equal(tables[0].nan_to_num(), before.nan_to_num())


def test_the_optimiser_is_the_textbook_one() -> None:
    parameters = [torch.nn.Parameter(tensor.to(DEVICE)) for tensor in moments((21, 5, 3), 0)[:2]]
    optimizer = optim.build_adam([{"params": [p], "lr": 1e-3} for p in parameters])
    assert isinstance(optimizer, optim.SplatAdam)
    oracle = [p.detach().double().cpu().requires_grad_() for p in parameters]
    slow = torch.optim.Adam(oracle, lr=1e-3, eps=1e-15, foreach=False)
    for step in range(3):
        for fast, other in zip(parameters, oracle, strict=True):
            gradient = torch.randn(fast.shape, generator=torch.Generator().manual_seed(step))
            fast.grad, other.grad = gradient.to(DEVICE), gradient.double()
        optimizer.step()
        slow.step()
    assert all(state["step"].device.type == "cpu" for state in optimizer.state.values())
    for fast, other in zip(parameters, oracle, strict=True):
        torch.testing.assert_close(fast.detach().cpu().double(), other.detach(), rtol=1e-6, atol=1e-6)
