"""PSNR by hand and by scikit-image; what LPIPS says where it is not there."""

import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio
from torch import Tensor

from nsvq_lightning.quality.loss import ssim
from nsvq_lightning.quality.metrics import build_lpips, eight_bit, psnr


def picture(seed: int, height: int = 40, width: int = 52) -> Tensor:
    """A smooth random image, 8-bit values in [0, 1]."""
    noise = torch.rand(1, 3, 6, 7, generator=torch.Generator().manual_seed(seed))
    smooth = torch.nn.functional.interpolate(noise, (height, width), mode="bicubic")[0].permute(1, 2, 0)
    return eight_bit(smooth)


def test_psnr_is_scikit_images_and_knows_eight_bits() -> None:
    one, target = picture(0), picture(2)
    oracle = peak_signal_noise_ratio(target.double().numpy(), one.double().numpy(), data_range=1.0)
    assert float(psnr(one, target)) == pytest.approx(oracle, abs=1e-4)
    by_hand = psnr(torch.full((4, 4, 3), 102 / 255), torch.zeros(4, 4, 3))
    assert float(by_hand) == pytest.approx(-20 * math.log10(102 / 255), abs=1e-4)
    almost, photo = torch.full((2, 2, 3), 128.4 / 255), torch.full((2, 2, 3), 128, dtype=torch.uint8)
    assert psnr(eight_bit(almost), eight_bit(photo)).isinf()
    assert psnr(eight_bit(almost), photo).isinf()
    for measure in (psnr, ssim):
        with pytest.raises(ValueError, match="the image must be of floats"):
            measure(photo, photo)
    assert torch.equal(eight_bit(torch.tensor([-0.5, 1.7])), torch.tensor([0.0, 1.0]))
    with pytest.raises(ValueError, match=r"must both be \[H, W, 3\]"):
        psnr(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))


def test_missing_lpips_is_a_reason_and_no_traceback() -> None:
    metric, reason = build_lpips()
    assert (metric is None) == (reason is not None)
    if reason is not None:
        assert reason.startswith("LPIPS")
        assert "\n" not in reason


def test_excluded_pixels_do_not_enter_psnr() -> None:
    image, photo = picture(1), picture(2)
    mask = torch.zeros(image.shape[:2], dtype=torch.bool)
    mask[10:30, 5:40] = True
    found = float(psnr(image, photo, mask))
    assert found == pytest.approx(float(psnr(image[10:30, 5:40], photo[10:30, 5:40])), abs=1e-5)
    others = torch.where(mask[..., None], image, 1 - image), photo.where(mask[..., None], 1 - photo)
    assert float(psnr(*others, mask)) == found
