"""PSNR by hand, distributed state against one process."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio
from torch import Tensor

from nsvq_lightning.quality.metrics import PSNR, build_lpips, eight_bit, image_metrics, psnr


def picture(seed: int, height: int = 40, width: int = 52) -> Tensor:
    """A smooth random image, 8-bit values in [0, 1]."""
    noise = torch.rand(1, 3, 6, 7, generator=torch.Generator().manual_seed(seed))
    smooth = torch.nn.functional.interpolate(noise, (height, width), mode="bicubic")[0].permute(1, 2, 0)
    return eight_bit(smooth)


def test_psnr_by_hand() -> None:
    metric = PSNR()
    metric.update(torch.full((4, 4, 3), 102 / 255), torch.zeros(4, 4, 3, dtype=torch.uint8))
    assert metric.compute().item() == pytest.approx(-20 * math.log10(102 / 255), abs=1e-4)


def test_psnr_pools_rgb_and_averages_over_images() -> None:
    one, two, target = picture(0), picture(1), picture(2)
    metric = PSNR()
    metric.update(one, target)
    metric.update(two, target)
    oracle = [peak_signal_noise_ratio(target.double().numpy(), i.double().numpy(), data_range=1.0) for i in (one, two)]
    assert metric.compute().item() == pytest.approx(np.mean(oracle), abs=1e-4)


def test_renders_are_rounded_to_eight_bit_and_clamped() -> None:
    target = torch.full((2, 2, 3), 128, dtype=torch.uint8)
    almost = torch.full((2, 2, 3), 128.4 / 255)
    assert PSNR()(almost, target).isinf()
    assert torch.equal(eight_bit(torch.tensor([-0.5, 1.7])), torch.tensor([0.0, 1.0]))


def test_the_state_of_two_processes_adds_up_to_that_of_one() -> None:
    pairs = [(picture(i), picture(i + 10)) for i in range(3)]
    whole, first, second = PSNR(), PSNR(), PSNR()
    for pair in pairs:
        whole.update(*pair)
    first.update(*pairs[0])
    second.update(*pairs[1])
    second.update(*pairs[2])
    for state in ("total", "images"):
        assert first._reductions[state] is not None
        setattr(first, state, getattr(first, state) + getattr(second, state))
    assert first.compute().item() == pytest.approx(whole.compute().item(), abs=1e-6)


def test_the_collection_keeps_its_metrics_apart() -> None:
    metrics = image_metrics()
    for i in range(3):
        metrics(picture(i), picture(i + 10))
    mean = metrics.compute()
    assert mean["psnr"] > 1.0 > mean["ssim"]


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"must both be \[H, W, 3\]"):
        PSNR().update(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))


def test_missing_lpips_is_a_reason_and_no_traceback() -> None:
    metric, reason = build_lpips()
    assert (metric is None) == (reason is not None)
    if reason is not None:
        assert reason.startswith("LPIPS")
        assert "\n" not in reason


def test_excluded_pixels_do_not_enter_the_metrics() -> None:
    image, photo = picture(1), picture(2)
    mask = torch.zeros(image.shape[:2], dtype=torch.bool)
    mask[10:30, 5:40] = True
    inside = psnr(eight_bit(image)[10:30, 5:40], eight_bit(photo)[10:30, 5:40])
    collection = image_metrics()
    scores = collection(image, photo, mask=mask)
    assert float(scores["psnr"]) == pytest.approx(float(inside), abs=1e-5)
    others = image_metrics()(
        torch.where(mask[..., None], image, 1 - image), photo.where(mask[..., None], 1 - photo), mask
    )
    assert {name: float(value) for name, value in others.items()} == {name: float(v) for name, v in scores.items()}
