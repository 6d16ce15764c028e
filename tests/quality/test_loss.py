"""The photometric loss against scikit-image and against plain torch in float64."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from nsvq_lightning.quality.loss import photometric_loss, ssim


def pair(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(height * 1000 + width)
    image = torch.rand(height, width, 3, generator=generator)
    return image, (image + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)


def plain_loss(image: torch.Tensor, target: torch.Tensor, weight: float, *, psnr: bool) -> torch.Tensor:
    inside = (image >= 0) & (image <= 1)
    image = torch.where(inside, image, image.detach().clamp(0, 1))
    error = (image - target).abs().mean()
    if psnr:
        error = 0.016 * torch.log((image - target).square().mean() + 1e-5)
    return (1 - weight) * error + weight * (1 - ssim(image, target))


def test_ssim_is_scikit_images_on_a_zero_padded_image() -> None:
    image, target = pair(40, 50)
    padded = [np.pad(x.double().numpy(), ((5, 5), (5, 5), (0, 0))) for x in (image, target)]
    _, full = structural_similarity(
        *padded,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    expected = full[5:-5, 5:-5].mean()
    assert float(ssim(image.double(), target.double())) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixels_at_the_limits_have_a_gradient(dtype: torch.dtype) -> None:
    """With kernels and in plain torch, whose clamp gives them none from 2.14 on."""
    image = torch.tensor([0.0, 1.0, 0.5], dtype=dtype).expand(6, 6, 3).clone().requires_grad_()
    photometric_loss(image, torch.full_like(image, 0.4), 0.0).backward()
    assert image.grad is not None
    assert image.grad.ne(0).all()


@pytest.mark.parametrize(("height", "width"), [(64, 70), (1, 6), (3, 20), (12, 33), (30, 6), (200, 7), (9, 5)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("psnr", [False, True])
@pytest.mark.parametrize("kind", ["float", "bytes", "beyond"])
def test_fused_loss_and_gradient(height: int, width: int, weight: float, kind: str, psnr: bool) -> None:
    image, target = pair(height, width)
    if kind == "beyond":
        image = 1.5 * image - 0.25
        image[0, 0] = torch.tensor([0.0, 1.0, 0.5])  # at the limits there still is a gradient
    if kind == "bytes":
        target = (255 * target).round().to(torch.uint8)
    fused, oracle = image.clone().requires_grad_(), image.double().requires_grad_()
    loss = photometric_loss(fused, target, weight, psnr=psnr)
    expected = plain_loss(oracle, target.double() / (255 if kind == "bytes" else 1), weight, psnr=psnr)
    (3 * loss).backward()
    (3 * expected).backward()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-6, abs=2e-7)
    assert fused.grad is not None
    assert oracle.grad is not None
    assert float((fused.grad - oracle.grad).norm() / oracle.grad.norm()) < 1e-6


@pytest.mark.parametrize("psnr", [False, True])
def test_bits_do_not_depend_on_the_number_of_threads(psnr: bool) -> None:
    image, target = pair(100, 64)
    results = []
    before = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        leaf = image.clone().requires_grad_()
        loss = photometric_loss(leaf, target, psnr=psnr)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    torch.set_num_threads(before)
    assert torch.equal(results[0][0], results[1][0])
    assert results[0][1] is not None
    assert results[1][1] is not None
    assert torch.equal(results[0][1], results[1][1])


@pytest.mark.parametrize("psnr", [False, True])
def test_a_loss_that_is_no_number_stays_none(psnr: bool) -> None:
    image, target = pair(20, 20)
    image[3, 4, 1] = torch.nan
    assert not torch.isfinite(photometric_loss(image, target, psnr=psnr))


def test_a_perfect_picture_has_the_least_loss_and_no_slope() -> None:
    photo, _ = pair(20, 20)
    leaf = photo.clone().requires_grad_()
    loss = photometric_loss(leaf, photo, 0.0, psnr=True)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.016 * math.log(1e-5))
    assert leaf.grad is not None
    assert leaf.grad.eq(0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bytes_are_the_same_photo(dtype: torch.dtype) -> None:
    image, target = pair(20, 20)
    photo = (255 * target).round().to(torch.uint8)
    image = image.to(dtype)
    assert torch.equal(photometric_loss(image, photo), photometric_loss(image, photo.to(dtype) / 255))


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"\[H, W, 3\]"):
        photometric_loss(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3))
    for image, target in ((torch.rand(64, 64, 3), torch.zeros(4, 4, 3)), (torch.rand(64, 64), torch.rand(64, 64))):
        with pytest.raises(ValueError, match=r"\[H, W, 3\]"):
            ssim(image, target)


def test_ssim_does_not_depend_on_who_computes_it() -> None:
    image, target = pair(20, 20)
    image = 1.5 * image - 0.2
    photo = (255 * target).round().to(torch.uint8)
    for other in (target, photo):
        values = [ssim(tensor, other) for tensor in (image, image.clone().requires_grad_(), image.double())]
        torch.testing.assert_close(values[1].detach(), values[0], atol=1e-5, rtol=0)
        torch.testing.assert_close(values[2].float(), values[0], atol=1e-5, rtol=0)


@pytest.mark.parametrize("psnr", [False, True])
def test_a_mask_takes_pixels_out_of_loss_gradient_and_similarity(psnr: bool) -> None:
    """Whatever the excluded pixels show, in either picture; the rest is as if it were the picture's own border."""
    image, photo = pair(20, 24)
    mask = torch.ones(image.shape[:2], dtype=torch.bool)
    mask[:, 9:] = False
    cut = image[:, :9].contiguous(), photo[:, :9].contiguous()
    for weight in (0.0, 0.2, 1.0):
        leaf, part = image.clone().requires_grad_(), cut[0].clone().requires_grad_()
        loss = photometric_loss(leaf, photo, weight, mask, psnr=psnr)
        expected = photometric_loss(part, cut[1], weight, psnr=psnr)
        loss.backward()
        expected.backward()
        assert (leaf.grad[:, 9:] == 0).all()
        if weight == 0:
            if not psnr:  # whose logarithm has another constant
                torch.testing.assert_close(loss, expected)
            # In the part, so little more is added to the mean squared error.
            tolerance = {"rtol": 1e-3, "atol": 1e-9} if psnr else {}
            torch.testing.assert_close(leaf.grad[:, :9], part.grad, **tolerance)
        other = torch.where(mask[..., None], image, torch.rand_like(image))
        torch.testing.assert_close(
            photometric_loss(other, torch.where(mask[..., None], photo, 1 - photo), weight, mask, psnr=psnr), loss
        )
    unknown = photo.where(mask[..., None], torch.nan)
    losses = [photometric_loss(image, target, 0.2, mask, psnr=psnr) for target in (unknown, photo)]
    assert torch.equal(*losses)
    same = torch.where(mask[..., None], photo, torch.rand_like(photo))
    assert float(ssim(same, photo, mask)) == pytest.approx(1, abs=1e-6)
    assert float(ssim(image, photo, mask)) < 0.99
    with pytest.raises(ValueError, match=r"must be \[H, W\], got"):
        ssim(image, photo, mask[1:])


def test_photos_of_another_precision_are_those_of_the_image() -> None:
    image, photo = pair(20, 20)
    torch.testing.assert_close(photometric_loss(image, photo.double()), photometric_loss(image, photo))


@pytest.mark.parametrize("kind", [torch.int32, torch.uint16])
def test_photos_of_other_integers_are_refused(kind: torch.dtype) -> None:
    image, photo = pair(20, 20)
    with pytest.raises(ValueError, match=rf"only the target may be of bytes, got {kind}"):
        ssim(image, (255 * photo).to(kind))


@pytest.mark.parametrize("kind", [torch.uint8, torch.float32])
def test_masks_of_other_numbers_are_refused(kind: torch.dtype) -> None:
    with pytest.raises(ValueError, match=rf"and bool: {kind}"):
        photometric_loss(*pair(20, 20), mask=torch.ones(20, 20, dtype=kind))
