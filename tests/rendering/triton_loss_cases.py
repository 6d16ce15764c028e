"""The Triton kernels of the loss against float64, on a GPU or under Triton's interpreter.

See ``triton_cases.py`` on how this is run.
"""

import pytest
import torch

from nsvq_lightning.quality import loss as losses
from nsvq_lightning.quality.loss import photometric_loss, ssim

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture(autouse=True)
def kernels_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the interpreter float32 tensors on the CPU stand for those on a GPU."""
    monkeypatch.setattr(losses, "kernels_for", lambda x: "cuda" if x.dtype == torch.float32 else None)


def pair(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(height * 1000 + width)
    image = 1.5 * torch.rand(height, width, 3, generator=generator) - 0.25
    image[0, 0] = torch.tensor([0.0, 1.0, 0.5])  # at the limits there still is a gradient
    noise = 0.2 * torch.randn(height, width, 3, generator=generator)
    return image, (image + noise).clamp(0, 1)


@pytest.mark.parametrize(
    ("height", "width", "weight", "bytes_"),
    [(9, 43, 0.2, True), (1, 1, 1.0, False), (17, 5, 0.0, False)],
)
@pytest.mark.parametrize("psnr", [False, True])
def test_loss_and_gradient(height: int, width: int, weight: float, bytes_: bool, psnr: bool) -> None:
    image, target = pair(height, width)
    photo = (255 * target).round().to(torch.uint8) if bytes_ else target
    leaf, oracle = image.to(DEVICE).requires_grad_(), image.double().requires_grad_()
    loss = photometric_loss(leaf, photo.to(DEVICE), weight, psnr=psnr)
    expected = photometric_loss(oracle, photo.double() / 255 if bytes_ else photo.double(), weight, psnr=psnr)
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
    image, target = (x.clamp(0, 1) for x in pair(6, 7))
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


@pytest.mark.parametrize("psnr", [False, True])
def test_a_loss_that_is_no_number_stays_none(psnr: bool) -> None:
    image, target = pair(12, 12)
    image[3, 4, 1] = torch.nan
    assert photometric_loss(image.to(DEVICE), target.to(DEVICE), psnr=psnr).isnan()
