"""The photometric loss and its gradient, fused and in plain torch, against float64."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from nsvq_lightning.commands.benchmark.error_measures import relative_l2
from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quality.ssim import SSIM_C1, SSIM_C2, SSIM_RADIUS, ssim_window
from nsvq_lightning.random import generator

__all__ = ["run"]

SIZE = (533, 800)
METHODS = ("fused", "plain torch")
DSSIM_WEIGHT = 0.2


def run(scope: Scope) -> list[Measurement]:
    """Time loss and gradient of one image pair with every number of threads."""
    image, target = image_pair(*SIZE)
    with use_threads(max(scope.threads)):
        truth = loss_and_gradient("plain torch", image.double(), target)
        errors = {name: _errors(loss_and_gradient(name, image, target), truth) for name in METHODS}
    rows = []
    for threads in scope.threads:
        timings = measure([_case(name, image, target) for name in METHODS], scope, threads)
        workload = f"{SIZE[1]}x{SIZE[0]}"
        rows += [
            Measurement("loss", workload, n, "forward + backward", threads, timings[n], errors[n]) for n in METHODS
        ]
    return rows


def _case(method: str, image: Tensor, target: Tensor) -> Case:
    return Case(method, lambda: loss_and_gradient(method, image, target))


def image_pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    """A smooth random photo ``[H, W, 3]`` uint8, and before it the same with an error of 0.05, as in a training."""
    draw = generator(0, 0, "loss")
    coarse = torch.rand(1, 3, height // 16 + 1, width // 16 + 1, generator=draw)
    smooth = functional.interpolate(coarse, (height, width), mode="bilinear")[0].movedim(0, -1)
    target = (255 * smooth).round().byte().contiguous()
    noise = torch.randn(target.shape, generator=draw)
    # No value is almost right: the gradient of its absolute error would be the sign of a rounding.
    noise = noise.sign() * (0.05 * noise.abs()).clamp_min(1e-3)
    return (target / 255 + noise).clamp(0, 1), target


def loss_and_gradient(method: str, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Loss and its gradient by the image ``[H, W, 3]``."""
    image = image.detach().requires_grad_()
    loss = (photometric_loss if method == "fused" else plain_loss)(image, target, DSSIM_WEIGHT)
    (gradient,) = torch.autograd.grad(loss, image)
    return loss.detach(), gradient


def plain_loss(image: Tensor, target: Tensor, dssim_weight: float) -> Tensor:
    """(1 - λ)·L1 + λ·(1 - SSIM) with depthwise separable convolutions, the fastest that plain torch has for it."""
    taps, target = ssim_window().to(image), target.to(image.dtype) / 255
    x, y = image.movedim(-1, 0), target.movedim(-1, 0)
    planes = torch.cat([x, y, x * x, y * y, x * y])[None]
    count = planes.shape[1]
    down, across = taps.view(1, 1, -1, 1).repeat(count, 1, 1, 1), taps.view(1, 1, 1, -1).repeat(count, 1, 1, 1)
    planes = functional.conv2d(planes, down, padding=(SSIM_RADIUS, 0), groups=count)
    planes = functional.conv2d(planes, across, padding=(0, SSIM_RADIUS), groups=count)
    x, y, xx, yy, xy = planes[0].chunk(5)
    means = (2 * x * y + SSIM_C1) / (x * x + y * y + SSIM_C1)
    variances = (2 * (xy - x * y) + SSIM_C2) / (xx - x * x + yy - y * y + SSIM_C2)
    similarity = (means * variances).mean()
    return (1 - dssim_weight) * (image - target).abs().mean() + dssim_weight * (1 - similarity)


def _errors(result: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor]) -> dict[str, float]:
    return {"gradient error": relative_l2(result[1], truth[1]), "loss error": relative_l2(result[0], truth[0])}
