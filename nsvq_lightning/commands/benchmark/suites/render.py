"""Back-ends of :func:`nsvq_lightning.render`, and what can be saved by asking for less, against its float64 oracle.

The oracle has everything: all SH bands, every pixel. So the error of a lower SH degree is that of the colours it leaves
out, and the error of a smaller picture, blown up to the full size, that of the detail it does not have. What an
observed backward pass costs is a multiple of the same pass that nobody observes.

Where the oracle would take minutes for the whole view, errors are measured on a crop in its middle, whose pixels see
the same splats. Where two splats are equally deep, or α is 1/255, to rounding, float32 decides
by chance and the pixel's error jumps by orders of magnitude. Such pixels are counted, and left out of the other
errors: they say nothing about the quality of the arithmetic.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from nsvq_lightning.commands.benchmark.error_measures import relative_l2, worst_first
from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.commands.benchmark.workloads import Workload, workloads
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import fast_backends, render
from nsvq_lightning.rendering.reference import TILE
from nsvq_lightning.splats.splats import RawSplats, sh_degree_of

__all__ = [
    "BOTH",
    "FORWARD",
    "REFERENCE",
    "Accuracy",
    "Method",
    "Painter",
    "accuracies",
    "case_of",
    "crop_for_oracle",
    "crop_note",
    "gradients_of",
    "image_errors",
    "leaves_of",
    "method_errors",
    "run",
    "trace",
]

REFERENCE = "reference"
FORWARD, BOTH = "forward", "forward + backward"
ORACLE_PAIRS = {True: 4e6, False: 8e7}
"""Pairs of a splat and a pixel of the tiles it touches that the oracle is given, quick and full: half a minute on one
core at most."""
CROP_STEP = 8
"""Pixels by which the height of a crop grows."""
REFERENCE_SPLATS = 20_000
"""Plain torch is timed up to this many splats; beyond, one image takes it most of a minute."""
FLIPPED = 1e-3
OUTLIER = 10.0
"""A pixel is left out if its error is this many times the median of the errors that are not 0."""


class Accuracy(NamedTuple):
    """What is asked of a back-end.

    Attributes:
        label: Name in the tables, behind that of the back-end.
        sh_degree: Highest SH degree; None for all.
        shrink: The picture is rendered this many times smaller, and blown up.
        observe: The backward pass is observed, see :func:`nsvq_lightning.render`.
    """

    label: str = ""
    sh_degree: int | None = None
    shrink: int = 1
    observe: bool = False


FULL, OBSERVED = Accuracy(), Accuracy(", observed", observe=True)


class Method(NamedTuple):
    """A back-end and what is asked of it."""

    backend: str
    accuracy: Accuracy = FULL

    def __str__(self) -> str:
        return ("plain torch" if self.backend == REFERENCE else self.backend) + self.accuracy.label

    def picture(self, splats: RawSplats, workload: Workload) -> Tensor:
        """Image ``[H, W, 3]`` of the workload's view."""
        camera, background = workload.camera, workload.background.to(splats.means)
        view = _smaller(camera, self.accuracy.shrink)
        observe = splats.means.new_ones(view.height, view.width) if self.accuracy.observe else None
        image = render(
            splats,
            view,
            sh_degree=self.accuracy.sh_degree,
            background=background,
            observe=observe,
            backend=self.backend,
        ).image
        if self.accuracy.shrink == 1:
            return image
        size = camera.height, camera.width
        return functional.interpolate(image.movedim(-1, 0)[None], size, mode="bilinear")[0].movedim(0, -1)


class Painter(Protocol):
    """What renders a workload with one of the back-ends, as :class:`Method` does."""

    @property
    def backend(self) -> str:
        """Name of the back-end."""

    def picture(self, splats: RawSplats, workload: Workload) -> Tensor:
        """Image ``[H, W, 3]`` of the workload's view."""


AnyPainter = TypeVar("AnyPainter", bound=Painter)


class Traced(NamedTuple):
    """A crop rendered with a graph behind it."""

    splats: RawSplats
    image: Tensor


def run(scope: Scope) -> list[Measurement]:
    """Time every method on every workload with every number of threads; errors once a workload."""
    return [row for workload in workloads(scope) for row in _rows(workload, scope)]


def accuracies(stored_degree: int) -> list[Accuracy]:
    """What can be asked for: everything first, then each lower SH degree, then smaller pictures."""
    lower = [Accuracy(f", SH {degree}", degree) for degree in reversed(range(stored_degree))]
    return [FULL, *lower, Accuracy(", half size", shrink=2), Accuracy(", quarter size", shrink=4)]


def _smaller(camera: Camera, shrink: int) -> Camera:
    """The same view with fewer pixels."""
    if shrink == 1:
        return camera
    width, height = (max(1, round(side / shrink)) for side in (camera.width, camera.height))
    scale = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=camera.K.dtype)
    return Camera(camera.K * scale, camera.viewmat, width, height)


def _rows(workload: Workload, scope: Scope) -> list[Measurement]:
    small = len(workload.splats.means) <= REFERENCE_SPLATS
    crop = crop_for_oracle(workload, ORACLE_PAIRS[scope.quick])
    asked = accuracies(sh_degree_of(workload.splats.shN))
    names = fast_backends(workload.splats.means)
    fast = [Method(name, accuracy) for name in names for accuracy in asked]
    fast += [Method(name, OBSERVED) for name in names]
    plain = Method(REFERENCE)
    # In a quick run even 20k splats are too much for plain torch: it is compared on the crop.
    jobs = [(workload, [*fast, plain] if small and not scope.quick else fast)]
    if small and scope.quick:
        jobs.append((crop, [fast[0], plain]))
    with use_threads(max(scope.threads)):
        errors = method_errors(crop, list(dict.fromkeys(method for _, methods in jobs for method in methods)))
    note = crop_note(crop, workload)
    rows = []
    for threads in scope.threads:
        for where, methods in jobs:
            keys = [(method, operation) for method in methods for operation in _operations(method)]
            leaves = leaves_of(where)
            cases = [case_of(where, leaves, *key) for key in keys]
            timings = dict(zip(keys, measure(cases, scope, threads).values(), strict=True))
            for (method, operation), timing in timings.items():
                values = errors[method, operation]
                if method.accuracy.observe:
                    alone = timings[Method(method.backend), operation]
                    values = values | {"times unobserved": timing.median / alone.median}
                rows.append(Measurement("render", str(where), str(method), operation, threads, timing, values, note))
    return rows


def _operations(method: Method) -> tuple[str, ...]:
    """What is timed of a method: only backward passes are observed."""
    return (BOTH,) if method.accuracy.observe else (FORWARD, BOTH)


def leaves_of(workload: Workload) -> RawSplats:
    """Copies of the splats, to be differentiated."""
    return RawSplats(*(tensor.clone().requires_grad_() for tensor in workload.splats))


def case_of(workload: Workload, leaves: RawSplats, method: Method, operation: str) -> Case:
    """One of the two operations on splats that cases may share."""

    def forward() -> None:
        with torch.no_grad():
            method.picture(leaves, workload)

    def both() -> None:
        torch.autograd.grad(method.picture(leaves, workload), leaves, workload.image_gradient)

    return Case(f"{method} {operation}", forward if operation == FORWARD else both)


def crop_for_oracle(workload: Workload, most_pairs: float) -> Workload:
    """The largest middle of the view, 3:2 or all of it, that is not too much for the oracle (``ORACLE_PAIRS``)."""
    tallest = -(-workload.camera.height // CROP_STEP)

    def of(steps: int) -> Workload:
        height = min(CROP_STEP * steps, workload.camera.height)
        whole = height == workload.camera.height
        return workload.crop(workload.camera.width if whole else min(3 * height // 2, workload.camera.width), height)

    too_tall = bisect_right(range(2, tallest + 1), most_pairs, key=lambda steps: _pairs(of(steps)))
    return of(min(2, tallest) if too_tall == 0 else 1 + too_tall)


def crop_note(crop: Workload, workload: Workload) -> str:
    """Where the errors of a workload were measured."""
    if crop.camera.height == workload.camera.height:
        return "errors on all pixels"
    return f"errors on the middle {crop.camera.width}x{crop.camera.height} pixels"


@torch.no_grad()
def _pairs(workload: Workload) -> float:
    """About how many pairs of a splat and a pixel the oracle blends: the pixels of all tiles a splat touches."""
    # Without Triton `auto` would be plain torch on a GPU.
    backend = next(iter(fast_backends(workload.splats.means)), "auto")
    seen = render(workload.splats, workload.camera, backend=backend)
    centres, radii = seen.means2d[seen.radii > 0], seen.radii[seen.radii > 0, None]
    last = torch.tensor([workload.camera.width, workload.camera.height]).to(radii) - 1
    first_tile = ((centres - radii).clamp_min(0) / TILE).floor()
    tiles = (torch.minimum(centres + radii, last) / TILE).floor() - first_tile + 1
    return float(tiles.clamp_min(0).prod(1).sum()) * TILE**2


def method_errors(
    crop: Workload, methods: Sequence[AnyPainter], oracle: Painter | None = None
) -> dict[tuple[AnyPainter, str], dict[str, float]]:
    """Errors by method and operation; pixels are left out by what the first method of a back-end does.

    Args:
        crop: What is rendered.
        methods: In float32; the first one of each back-end should have everything asked for.
        oracle: In float64; the oracle of the package by default.
    """
    truth = trace(crop, oracle or Method(REFERENCE), torch.float64)
    usual: dict[str, Tensor] = {}
    expected: dict[str, dict[str, Tensor]] = {}
    errors = {}
    for method in methods:
        name, result = method.backend, trace(crop, method, torch.float32)
        if name not in usual:
            usual[name] = _usual(result.image, truth.image)
            expected[name] = gradients_of(truth, crop.image_gradient.double() * usual[name][..., None])
        errors[method, FORWARD] = image_errors(result.image, truth.image, usual[name])
        gradients = gradients_of(result, crop.image_gradient * usual[name][..., None])
        by_name = {key: relative_l2(gradients[key], gradient) for key, gradient in expected[name].items()}
        errors[method, BOTH] = worst_first("gradient error", by_name)
    return errors


def _pixel_errors(image: Tensor, truth: Tensor) -> Tensor:
    return (image.detach().double() - truth.detach()).abs().amax(-1)


def _usual(image: Tensor, truth: Tensor) -> Tensor:
    """Pixels ``[H, W]`` bool without those that jumped."""
    error = _pixel_errors(image, truth)
    typical = error[error > 0].median() if bool((error > 0).any()) else error.new_zeros(())
    return error <= OUTLIER * typical


def image_errors(image: Tensor, truth: Tensor, usual: Tensor | None = None) -> dict[str, float]:
    """Errors of an image ``[H, W, 3]``, largest over the channels.

    Args:
        image: What is judged.
        truth: What it should be.
        usual: Pixels ``[H, W]`` bool that enter; by default those without a jump.
    """
    error = _pixel_errors(image, truth)
    usual = _usual(image, truth) if usual is None else usual
    return {
        "max error": float(error[usual].max()),
        "mean error": float(error[usual].mean()),
        "pixels left out": float((~usual).sum()),
        "pixels above 1e-3": float((error > FLIPPED).sum()),
    }


def trace(crop: Workload, method: Painter, dtype: torch.dtype) -> Traced:
    """Render copies of the splats in a type, to be differentiated."""
    splats = RawSplats(*(tensor.to(dtype, copy=True).requires_grad_() for tensor in crop.splats))
    return Traced(splats, method.picture(splats, crop))


def gradients_of(traced: Traced, weights: Tensor) -> dict[str, Tensor]:
    """Gradient by attribute of Σ weights · image."""
    gradients = torch.autograd.grad(traced.image, traced.splats, weights, retain_graph=True)
    return dict(zip(RawSplats._fields, gradients, strict=True))
