"""Back-ends of :func:`nsvq_lightning.render` against its float64 oracle.

Errors are measured on a crop in the middle of the view, whose pixels see the same splats as in the whole view: the
oracle would take minutes for the whole. Where two splats are equally deep, or α is 1/255, to rounding, float32 decides
by chance and the pixel's error jumps by orders of magnitude. Such pixels are counted, and left out of the other
errors: they say nothing about the quality of the arithmetic.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.benchmark.errors import relative_l2, worst_first
from nsvq_lightning.benchmark.row import Row
from nsvq_lightning.benchmark.settings import Settings
from nsvq_lightning.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.benchmark.workloads import Workload, workloads
from nsvq_lightning.rendering.rasterize import BACKENDS, render, resolve_backend
from nsvq_lightning.splats import RawSplats

__all__ = ["image_errors", "run"]

REFERENCE = "reference"
FORWARD, BOTH = "forward", "forward + backward"
ORACLE_WORK = {True: 1.2e8, False: 6e8}
"""Splats times pixels that the oracle is given, quick and full: a second, and up to half a minute on one core."""
REFERENCE_SPLATS = 20_000
"""Plain torch is timed up to this many splats; beyond, one image takes it most of a minute."""
FLIPPED = 1e-3
OUTLIER = 10.0
"""A pixel is left out if its error is this many times the median of the errors that are not 0."""


class _Traced(NamedTuple):
    """A crop rendered with a graph behind it."""

    splats: RawSplats
    image: Tensor


def run(settings: Settings) -> list[Row]:
    """Time every back-end on every workload with every number of threads; errors once a workload."""
    return [row for workload in workloads(settings) for row in _rows(workload, settings)]


def _rows(workload: Workload, settings: Settings) -> list[Row]:
    small = len(workload.splats.means) <= REFERENCE_SPLATS
    crop = workload.crop(*_crop_size(workload, settings.quick))
    fast = _fast_backends(workload.splats.means)
    # In a quick run even 20k splats are too much for plain torch: it is compared on the crop.
    jobs = [(workload, [*fast, REFERENCE] if small and not settings.quick else fast)]
    if small and settings.quick:
        jobs.append((crop, [*fast, REFERENCE]))
    with use_threads(max(settings.threads)):
        errors = _errors(crop, sorted({name for _, names in jobs for name in names}))
    note = f"errors on the middle {crop.camera.width}x{crop.camera.height} pixels"
    rows = []
    for threads in settings.threads:
        for where, names in jobs:
            cases = [case for name in names for case in _cases(where, name)]
            for (name, operation), timing in zip(
                ((name, operation) for name in names for operation in (FORWARD, BOTH)),
                measure(cases, settings, threads).values(),
                strict=True,
            ):
                values = errors[name, operation]
                rows.append(Row("render", str(where), _label(name), operation, threads, timing, values, note))
    return rows


def _fast_backends(like: Tensor) -> list[str]:
    """Back-ends other than the oracle that take tensors such as ``like``."""
    usable = []
    for name in BACKENDS:
        with suppress(ValueError):
            usable.append(resolve_backend(name, like))
    return [name for name in dict.fromkeys(usable) if name != REFERENCE]


def _label(backend: str) -> str:
    return "plain torch" if backend == REFERENCE else backend


def _cases(workload: Workload, backend: str) -> list[Case]:
    leaves = RawSplats(*(tensor.clone().requires_grad_() for tensor in workload.splats))

    def forward() -> None:
        with torch.no_grad():
            render(leaves, workload.camera, background=workload.background, backend=backend)

    def both() -> None:
        image = render(leaves, workload.camera, background=workload.background, backend=backend).image
        torch.autograd.grad(image, leaves, workload.image_gradient)

    return [Case(f"{backend} {FORWARD}", forward), Case(f"{backend} {BOTH}", both)]


def _crop_size(workload: Workload, quick: bool) -> tuple[int, int]:
    """Width and height in pixels, 3:2, that keep the oracle within its work."""
    pixels = ORACLE_WORK[quick] / len(workload.splats.means)
    height = max(16, 8 * int(math.sqrt(pixels / 1.5) / 8))
    return min(3 * height // 2, workload.camera.width), min(height, workload.camera.height)


def _errors(crop: Workload, backends: list[str]) -> dict[tuple[str, str], dict[str, float]]:
    """Errors by back-end and operation."""
    truth = _trace(crop, REFERENCE, torch.float64)
    errors = {}
    for backend in backends:
        result = _trace(crop, backend, torch.float32)
        errors[backend, FORWARD], usual = image_errors(result.image, truth.image)
        weights = crop.image_gradient * usual[..., None]
        gradients = _gradients(result, weights)
        expected = _gradients(truth, weights.double())
        by_name = {name: relative_l2(gradients[name], expected[name]) for name in expected}
        errors[backend, BOTH] = worst_first("gradient error", by_name)
    return errors


def image_errors(image: Tensor, truth: Tensor) -> tuple[dict[str, float], Tensor]:
    """Errors of an image ``[H, W, 3]``, largest over the channels, and the pixels ``[H, W]`` bool that entered them."""
    error = (image.detach().double() - truth.detach()).abs().amax(-1)
    typical = error[error > 0].median() if bool((error > 0).any()) else error.new_zeros(())
    usual = error <= OUTLIER * typical
    values = {
        "max error": float(error[usual].max()),
        "mean error": float(error[usual].mean()),
        "pixels left out": float((~usual).sum()),
        "pixels above 1e-3": float((error > FLIPPED).sum()),
    }
    return values, usual


def _trace(crop: Workload, backend: str, dtype: torch.dtype) -> _Traced:
    splats = RawSplats(*(tensor.to(dtype, copy=True).requires_grad_() for tensor in crop.splats))
    return _Traced(splats, render(splats, crop.camera, background=crop.background.to(dtype), backend=backend).image)


def _gradients(traced: _Traced, weights: Tensor) -> dict[str, Tensor]:
    gradients = torch.autograd.grad(traced.image, traced.splats, weights, retain_graph=True)
    return dict(zip(RawSplats._fields, gradients, strict=True))
