"""Test each fast back-end against the float64 oracle, on a scene that takes seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.workloads import Workload, relative_l2, synthetic_workload
from nsvq_lightning.commands.doctor.backends import usable_backends
from nsvq_lightning.commands.doctor.finding import Finding, good, problem
from nsvq_lightning.compute.kernel_cache import kernel_folder
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import ATTRIBUTES, RawSplats

__all__ = ["check_rendering", "rendering_errors"]

SPLATS, WIDTH, HEIGHT = 4000, 96, 72
LARGEST_ERROR = 1e-3
"""Largest relative error that passes: rounding stays below 1e-4, but a splat that crosses α = 1/255 costs more."""
REPEATS = 5


def check_rendering() -> Iterator[Finding]:
    """Check image and gradients of every usable back-end."""
    workload = _small(synthetic_workload("A20k"))
    truth = _render(workload, "reference", torch.float64, "cpu")
    for backend, device in usable_backends().items():
        began = time.perf_counter()
        results = _render(workload, backend, torch.float32, device)
        first = time.perf_counter() - began
        times = [_seconds(workload, backend, device) for _ in range(REPEATS)]
        yield _judge(backend, rendering_errors(results, truth), 1000 * min(times), first)


def rendering_errors(results: dict[str, Tensor], truth: dict[str, Tensor]) -> dict[str, float]:
    """Relative error of the image and of the gradient of each attribute; NaN where a value is not finite."""
    return {name: relative_l2(results[name].cpu(), value) for name, value in truth.items()}


def _judge(backend: str, errors: dict[str, float], ms: float, first: float) -> Finding:
    # "not <" rather than ">=", so that NaN fails.
    wrong = [name for name, error in errors.items() if not error < LARGEST_ERROR]
    worst = max((error for name, error in errors.items() if name != "image"), default=0.0)
    values = {"backend": backend, "errors": errors, "ms": ms, "first_seconds": first}
    if wrong:
        listed = ", ".join(f"{name} {errors[name]:.1e}" for name in wrong)
        help_ = (
            f"do not trust a run; remove {kernel_folder()}, and if that does not help report it with nsvq doctor --json"
        )
        return problem(
            "self-test", f"{backend}: relative error against the float64 oracle: {listed}; {help_}", **values
        )
    compiled = f", {first:.0f} s at the first call (kernels were compiled)" if first > 3 else ""
    return good(
        "self-test",
        f"{backend}: image to {errors['image']:.1e}, gradients to {worst:.1e} of the float64 oracle; "
        f"{ms:.1f} ms for {SPLATS:,} splats at {WIDTH}x{HEIGHT}{compiled}",
        **values,
    )


def _small(workload: Workload) -> Workload:
    crop = workload.crop(WIDTH, HEIGHT)
    splats = RawSplats(*(tensor[:SPLATS].clone() for tensor in crop.splats))  # in random order, so any part will do
    return Workload("self-test", splats, crop.camera, crop.background, crop.image_gradient)


def _render(workload: Workload, backend: str, dtype: torch.dtype, device: str) -> dict[str, Tensor]:
    """Image, and the gradient of each attribute for the workload's gradient of the image."""
    splats = RawSplats(*(tensor.to(device, dtype).clone().requires_grad_() for tensor in workload.splats))
    camera = workload.camera.to(device, dtype)
    with torch.enable_grad():
        image = render(splats, camera, background=workload.background.to(device, dtype), backend=backend).image
    gradients = torch.autograd.grad(image, splats, workload.image_gradient.to(device, dtype))
    return {"image": image.detach(), **dict(zip(ATTRIBUTES, gradients, strict=True))}


def _seconds(workload: Workload, backend: str, device: str) -> float:
    began = time.perf_counter()
    _render(workload, backend, torch.float32, device)
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began
