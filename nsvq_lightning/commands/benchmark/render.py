"""Suite ``render``: back-ends of :func:`nsvq_lightning.render` and of the loss against plain torch in float64.

The oracle would take minutes for a large view of many splats. Errors are then measured on a crop in its middle, whose
pixels see the same splats, and so is the time of plain torch. Where two splats are equally deep, or α is 1/255, to
rounding, float32 decides by chance and the pixel's error jumps by orders of magnitude. Such pixels are counted, and
left out of the other errors: they say nothing about the quality of the arithmetic.
"""

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.timing import Measurement, Scope, compare
from nsvq_lightning.commands.benchmark.workloads import Workload, workloads
from nsvq_lightning.compute.devices import devices_with_kernels, fast_backends
from nsvq_lightning.quality.loss import photometric_loss, plain_loss
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.rendering.sampling import Sampling, focal_of
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.self_check import relative_l2

FORWARD = "forward"
BOTH = "forward + backward"
LOSS = "L1 + D-SSIM, forward + backward"

BACKGROUND = 0.2, 0.3, 0.4  # RGB

# An image with a graph behind it, and the splats at its other end.
Traced = tuple[Tensor, RawSplats]
# Renders splats as the camera of a workload sees them: image ``[H, W, 3]``.
Painter = Callable[[RawSplats, Workload], Tensor]


def run(scope: Scope) -> Iterator[Measurement]:
    """Time every back-end of every device on every workload; errors once a workload."""
    for device in devices_with_kernels():
        for workload in workloads(scope):
            yield from _render_rows(workload.to(device), scope, device)
        yield from _loss_rows(scope, device)


def painted(backend: str, splats: RawSplats, workload: Workload, sampling: Sampling | None = None) -> Tensor:
    """Render with a back-end; without that argument, it is a :data:`Painter`."""
    return render(splats, workload.camera, background=BACKGROUND, backend=backend, sampling=sampling).image


# Splats times pixels that the oracle is given, quick and full: half a minute on one core at most.
ORACLE_WORK = {True: 1e8, False: 6e9}


def _render_rows(workload: Workload, scope: Scope, device: str) -> Iterator[Measurement]:
    fast: dict[str, Painter] = {name: partial(painted, name) for name in fast_backends(workload.splats.means)}
    away = (workload.splats.means - workload.camera.position.to(workload.splats.means)).norm(dim=1)
    as_trained = Sampling(torch.stack([0.99 * away, 1.01 * away]), [focal_of(workload.camera)])
    fast |= {f"{name}, blur kept": partial(painted, name, sampling=as_trained) for name in fast}
    every = fast | {"plain torch": partial(painted, "reference")}
    crop = workload
    while len(crop.splats.means) * crop.camera.width * crop.camera.height > ORACLE_WORK[scope.quick]:
        crop = workload.crop(crop.camera.width // 2, crop.camera.height // 2)
    truth = trace(crop, every["plain torch"], torch.float64)
    errors = {name: errors_of(crop, paint, truth) for name, paint in every.items()}

    def timed(where: Workload, painters: dict[str, Painter]) -> Iterator[Measurement]:
        leaves = RawSplats(*(tensor.clone().requires_grad_() for tensor in where.splats))
        for operation in (FORWARD, BOTH):
            cases = {name: partial(_run, paint, where, leaves, operation) for name, paint in painters.items()}
            values = {name: errors[name][operation] for name in painters}
            yield from compare(operation, str(where), cases, values, scope, device)

    if crop is not workload:
        yield from timed(workload, fast)
    yield from timed(crop, every)


def _run(paint: Painter, workload: Workload, leaves: RawSplats, operation: str) -> None:
    with torch.set_grad_enabled(operation == BOTH):
        image = paint(leaves, workload)
    if operation == BOTH:
        torch.autograd.grad(image, leaves, workload.image_gradient)


def errors_of(crop: Workload, paint: Painter, truth: Traced) -> dict[str, dict[str, float]]:
    """Errors of float32 by operation, and of how many pixels.

    Args:
        crop: What is rendered.
        paint: What is judged.
        truth: The same by the oracle.
    """
    found = trace(crop, paint, torch.float32)
    image, usual = image_errors(found[0], truth[0])
    weights = crop.image_gradient * usual[..., None]
    gradients = torch.autograd.grad(*found, weights)
    expected = torch.autograd.grad(*truth, weights.double(), retain_graph=True)
    by_name = dict(zip(RawSplats._fields, map(relative_l2, gradients, expected), strict=True))
    pixels = {"error pixels": crop.camera.width * crop.camera.height}
    return {FORWARD: {**pixels, **image}, BOTH: {**pixels, "gradient error": max(by_name.values()), **by_name}}


def trace(crop: Workload, paint: Painter, dtype: torch.dtype) -> Traced:
    """Render copies of the splats in a type, to be differentiated."""
    splats = RawSplats(*(tensor.to(dtype, copy=True).requires_grad_() for tensor in crop.splats))
    return paint(splats, crop), splats


def image_errors(image: Tensor, truth: Tensor) -> tuple[dict[str, float], Tensor]:
    """Errors of an image ``[H, W, 3]``, largest over the channels, where pixels did not jump; and which these are.

    Args:
        image: What is judged.
        truth: What it should be.

    Returns:
        Errors by name, and ``[H, W]`` bool: the pixels whose error is at most ten times the median of those above 0.
    """
    error = (image.detach().double() - truth.detach()).abs().amax(-1)
    some = error[error > 0]
    usual = error <= (10.0 * some.median() if len(some) else 0.0)
    errors = {
        "max error": float(error[usual].max()),
        "mean error": float(error[usual].mean()),
        "pixels left out": float((~usual).sum()),
        "pixels above 1e-3": float((error > 1e-3).sum()),
    }
    return errors, usual


PHOTO = (533, 800, 3)


def _loss_rows(scope: Scope, device: str) -> Iterator[Measurement]:
    draw = generator(0, 0, "loss")
    photo = torch.randint(0, 220, PHOTO, generator=draw, dtype=torch.uint8)
    # No value is almost right: the gradient of its absolute error would be the sign of a rounding.
    image = (photo / 255 + 0.01 + 0.1 * torch.rand(PHOTO, generator=draw)).to(device)
    photo = photo.to(device)

    def gradient(loss: Callable[[Tensor, Tensor, float], Tensor], image: Tensor) -> Tensor:
        image = image.detach().requires_grad_()
        return torch.autograd.grad(loss(image, photo, 0.2), image)[0]

    truth = gradient(plain_loss, image.double())
    cases = {
        f"fused, {device}": partial(gradient, photometric_loss, image),
        f"plain torch, {device}": partial(gradient, plain_loss, image),
    }
    errors = {method: {"gradient error": relative_l2(call(), truth)} for method, call in cases.items()}
    yield from compare(LOSS, f"{PHOTO[1]}x{PHOTO[0]}", cases, errors, scope, device)
