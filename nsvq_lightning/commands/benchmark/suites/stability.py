"""What happens at the limits of float32: scenes of extreme numbers, and quantizers with nothing to do.

Errors are those of :mod:`~nsvq_lightning.commands.benchmark.suites.render` and
:mod:`~nsvq_lightning.commands.benchmark.suites.quantize`; besides, numbers that are not finite are counted. Where image
or gradient have one, the training step must refuse the update; and in any case the splats that brought it must be
named, and no other be lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.extremes import Extreme, extremes
from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.suites import quantize, render
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.commands.benchmark.workloads import Workload
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import fast_backends
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.edit import trainable_rows
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups

__all__ = ["Beside", "Outcome", "cases", "errors", "quantizer_errors", "quantizers", "run", "step"]

SIZES = {True: (60, 1000), False: (200, 10_000)}
"""Splats of a scene, and of the one that has all on one pixel, quick and full."""
OPERATION = "forward + backward + step"
NOT_FINITE, REFUSED, NAMED, LOST = "not finite", "step refused", "rows named", "other rows lost"
QUANTIZE_STEPS = {"NSVQ": quantize.step, "plain torch": quantize.plain_step}


class Beside(NamedTuple):
    """A back-end that renders splats and, beside them, others that nobody differentiates."""

    backend: str
    planted: RawSplats

    def picture(self, splats: RawSplats, workload: Workload) -> Tensor:
        """Image ``[H, W, 3]`` of the workload's view."""
        every = (torch.cat([added.to(own.dtype), own]) for added, own in zip(self.planted, splats, strict=True))
        return render.Method(self.backend).picture(RawSplats(*every), workload)


class Outcome(NamedTuple):
    """How a training step ended.

    Attributes:
        refused: The loss was not finite, so there was no update.
        named: Rows with a number that is not finite, by attribute, as density control names them.
        lost: How many of them were finite before.
    """

    refused: bool
    named: Mapping[str, int]
    lost: int


def run(scope: Scope) -> list[Measurement]:
    """Time every scene with every number of threads; errors once a scene."""
    scenes = cases(scope)
    methods = {str(render.Method(name)): name for name in (*fast_backends(torch.zeros(1)), render.REFERENCE)}
    with use_threads(max(scope.threads)):
        values = {(scene.name, m): errors(scene, backend) for scene in scenes for m, backend in methods.items()}
        prepared = quantizers()
        for name, attribute in prepared.items():
            values |= {(name, m): quantizer_errors({name: attribute}, m) for m in QUANTIZE_STEPS}
    kinds = {scene.name: scene.kind for scene in scenes} | dict.fromkeys(prepared, "quantizers")
    timed = [_case(scene, m, backend) for scene in scenes for m, backend in methods.items()]
    timed += [_quantizer_case(name, prepared[name], m) for name in prepared for m in QUANTIZE_STEPS]
    rows = []
    for threads in scope.threads:
        timings = measure(timed, scope, threads)
        for (name, method), found in values.items():
            timing = timings[_key(name, method)]
            rows.append(Measurement("stability", name, method, f"{OPERATION}, {kinds[name]}", threads, timing, found))
    return rows


def cases(scope: Scope) -> list[Extreme]:
    """The scenes of a quick or a full run."""
    return extremes(*SIZES[scope.quick])


def errors(scene: Extreme, backend: str) -> dict[str, float]:
    """Errors of image and gradient in float32, and how the step of a training ends.

    Where a number of image or gradient is not finite, there are no errors, but the count of such numbers.
    """
    method = Beside(backend, scene.planted)
    traced = render.trace(scene.workload, method, torch.float32)
    gradients = render.gradients_of(traced, scene.workload.image_gradient)
    broken = _not_finite((traced.image, *gradients.values()))
    values: dict[str, float] = {}
    if not broken:
        oracle = Beside(render.REFERENCE, scene.planted)
        by_operation = render.method_errors(scene.workload, [method], oracle)
        values = by_operation[method, render.FORWARD] | by_operation[method, render.BOTH]
        values["largest value"] = float(traced.image.detach().abs().max())
    outcome = step(scene, backend)
    ends = {NOT_FINITE: broken, REFUSED: outcome.refused, NAMED: max(outcome.named.values(), default=0)}
    return {**values, **{name: float(value) for name, value in ends.items()}, LOST: float(outcome.lost)}


def step(scene: Extreme, backend: str) -> Outcome:
    """One training step on a random photo: forward, backward and Adam, or a refusal where the loss is not finite."""
    splats = Splats.from_tensors(*map(torch.cat, zip(scene.planted, scene.workload.splats, strict=True)))
    optimizer = build_adam(param_groups(splats, {}, LearningRates(), extent=1.0))
    before, _ = trainable_rows(splats)
    photo = torch.rand(scene.workload.image_gradient.shape, generator=generator(0, 0, "photo"))
    loss = photometric_loss(render.Method(backend).picture(splats.raw(), scene.workload), photo)
    refused = not bool(loss.isfinite())
    if not refused:
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    after, named = trainable_rows(splats)
    return Outcome(refused, named, int((before & ~after).sum()))


def quantizers() -> dict[str, quantize.Attribute]:
    """Quantizers that have nothing to do, or nothing to choose from, by what is special about them."""
    draw = generator(0, 0, "rows")
    different, few = torch.randn(200, 3, generator=draw), torch.randn(5, 3, generator=draw)
    return {
        "every row on a code": _attribute(few[torch.arange(200) % 5], 5),
        "more codes than rows": _attribute(different, 1000),
        "all rows equal": _attribute(different[:1].repeat(200, 1), 16),
        "one code": _attribute(different, 1),
        "rows of 1e-20": _attribute(1e-20 * different, 16),
        "rows of 1e15": _attribute(1e15 * different, 16),
    }


def _attribute(x: Tensor, codes: int) -> quantize.Attribute:
    quantizer = NSVQ(codes, x.shape[1])
    quantizer.fit(x, generator=generator(0, 0, "fit"))
    upstream = 1e-6 * torch.randn(x.shape, generator=generator(0, 0, "upstream"))
    return quantize.Attribute(quantizer.train(), x.clone().requires_grad_(), torch.arange(len(x)), upstream, 5e-3)


def quantizer_errors(attributes: Mapping[str, quantize.Attribute], method: str) -> dict[str, float]:
    """Errors of a step of some quantizers by one of :data:`QUANTIZE_STEPS`."""
    results = QUANTIZE_STEPS[method](attributes, 0)
    broken = _not_finite(tensor for result in results.values() for tensor in result[:2])
    values = {} if broken else quantize.step_errors(attributes, results)
    return {**values, NOT_FINITE: float(broken)}


def _not_finite(tensors: Iterable[Tensor]) -> int:
    return sum(int((~tensor.isfinite()).sum()) for tensor in tensors)


def _key(name: str, method: str) -> str:
    return f"{name}: {method}"


def _case(scene: Extreme, method: str, backend: str) -> Case:
    return Case(_key(scene.name, method), lambda: step(scene, backend))


def _quantizer_case(name: str, attribute: quantize.Attribute, method: str) -> Case:
    return Case(_key(name, method), lambda: QUANTIZE_STEPS[method]({name: attribute}, 0))
