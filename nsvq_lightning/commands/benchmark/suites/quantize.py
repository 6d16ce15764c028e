"""A quantize step of training on all four attributes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from nsvq_lightning.commands.benchmark.error_measures import relative_l2
from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.commands.benchmark.workloads import single_workload
from nsvq_lightning.quantize import NSVQ, QUANTIZED, CodebookQuantizer, nearest_reference
from nsvq_lightning.quantize.attributes import build_quantizers
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.optim import LearningRates

__all__ = ["Attribute", "plain_step", "prepare", "run", "step", "step_errors"]

VISIBLE = 0.8
"""Share of the splats that a camera sees."""
CHUNK = 1 << 22
CHECKED_ROWS = 4_000
"""Rows an attribute whose codes are checked."""


class Attribute(NamedTuple):
    """One quantized attribute in the middle of training.

    Attributes:
        quantizer: Fitted and in training mode.
        x: Rows of all splats ``[N, D]``, which move from step to step.
        rows: The visible ones ``[V]``.
        upstream: Gradient of the quantized rows ``[V, D]``.
        rate: Learning rate: how far Adam moves a number in a step.
    """

    quantizer: CodebookQuantizer
    x: Tensor
    rows: Tensor
    upstream: Tensor
    rate: float


Results = dict[str, tuple[Tensor, Tensor, Tensor]]
"""Quantized rows ``[V, D]``, their gradient by the rows ``[N, D]``, and codes ``[V]`` by attribute."""


def run(scope: Scope) -> list[Measurement]:
    """Time the step with every number of threads."""
    source = single_workload(scope, "B100k")
    with use_threads(max(scope.threads)):
        attributes = prepare(source.splats, scope.codebooks)
        errors = {"NSVQ": step_errors(attributes, step(attributes, 0))}
        errors["plain torch"] = step_errors(attributes, plain_step(attributes, 0))
    seen = max((len(attribute.rows) for attribute in attributes.values()), default=0)
    workload = f"{source.name}, {seen} visible splats, {scope.codebooks} codebooks"
    note = f"codes checked on at most {CHECKED_ROWS} rows an attribute"
    clock = iter(range(1, 1 << 62))

    def move() -> None:
        advance(attributes, next(clock))

    cases = [
        Case("NSVQ", lambda: step(attributes, next(clock)), move),
        Case("plain torch", lambda: plain_step(attributes, next(clock)), move),
    ]
    rows = []
    for threads in scope.threads:
        timings = measure(cases, scope, threads)
        rows += [
            Measurement("quantize", workload, n, "forward + backward", threads, timings[n], errors[n], note)
            for n in timings
        ]
    return rows


def prepare(splats: RawSplats, codebooks: str) -> dict[str, Attribute]:
    """Quantizers with the paper's codebook sizes, fitted by one step of k-means, with the rows of a training view."""
    scene = Splats.from_tensors(*splats)
    count = int(VISIBLE * len(scene))
    chosen = torch.randperm(len(scene), generator=generator(0, 0, "visible"))[:count].sort().values
    prepared = {}
    for name, module in build_quantizers(lambda k, d: NSVQ(k, d, kmeans_steps=1), codebooks, scene).items():
        quantizer = cast(CodebookQuantizer, module)
        every = QUANTIZED[name].rows(getattr(scene, name).detach())
        quantizer.fit(every, generator=generator(0, 0, "fit", name))
        x = every.clone().requires_grad_()
        upstream = 1e-6 * torch.randn(count, x.shape[1], generator=generator(0, 0, "upstream", name))
        prepared[name] = Attribute(quantizer.train(), x, chosen, upstream, getattr(LearningRates(), name))
    return prepared


@torch.no_grad()
def advance(attributes: Mapping[str, Attribute], iteration: int) -> None:
    """Move rows and codes about as far as a step of Adam does, or a search that remembers would have nothing to do."""
    for name, attribute in attributes.items():
        for what, values in (("rows", attribute.x), ("codes", attribute.quantizer.codebook)):
            draw = generator(0, iteration, what, name)
            values += attribute.rate * (2 * torch.rand(values.shape, generator=draw) - 1)


def step(attributes: Mapping[str, Attribute], iteration: int) -> Results:
    """One forward and backward pass of the quantizers of the package."""
    results: Results = {}
    for name, (quantizer, x, rows, upstream, _) in attributes.items():
        quantized, codes = quantizer(x, generator(0, iteration, "noise", name), rows)
        gradient, _ = torch.autograd.grad(quantized, (x, quantizer.codebook), upstream)
        results[name] = quantized.detach(), gradient, codes
    return results


def plain_step(attributes: Mapping[str, Attribute], iteration: int) -> Results:
    """The same in a few lines of torch: all distances, noise by ``randn``, gradients by autograd."""
    results: Results = {}
    for name, (quantizer, table, rows, upstream, _) in attributes.items():
        x = table[rows]
        codebook: nn.Parameter = quantizer.codebook
        with torch.no_grad():
            parts = torch.split(x, max(1, CHUNK // len(codebook)))
            codes = torch.cat([torch.cdist(part, codebook).argmin(1) for part in parts])
        noise = torch.randn(x.shape, generator=generator(0, iteration, "noise", name))
        length = torch.linalg.vector_norm(x - codebook[codes], dim=1, keepdim=True)
        quantized = x + length * noise / noise.norm(dim=1, keepdim=True)
        gradient, _ = torch.autograd.grad(quantized, (table, codebook), upstream)
        results[name] = quantized.detach(), gradient, codes
    return results


def step_errors(attributes: Mapping[str, Attribute], results: Results) -> dict[str, float]:
    """Worst errors over the attributes against the closed forms in float64.

    With c the code that was chosen, r = x − c, and v̂ the direction of x̃ − x: ‖x̃ − x‖ = ‖r‖, and the gradient by x is
    g + (g·v̂) r/‖r‖.
    """
    lengths, gradients, wrong = [], [], 0
    for name, (quantized, gradient, codes) in results.items():
        quantizer, table, rows, upstream, _ = attributes[name]
        x, upstream, gradient = table.detach()[rows].double(), upstream.double(), gradient[rows]
        codebook = quantizer.codebook.detach().double()
        residual, offset = x - codebook[codes], quantized.double() - x
        away, moved = residual.norm(dim=1, keepdim=True), offset.norm(dim=1, keepdim=True)
        along = (upstream * offset).sum(1, keepdim=True) / moved.where(moved > 0, torch.inf)
        expected = upstream + along * residual / away.where(away > 0, torch.inf)
        # A row on its code has no direction of its own.
        clear = (away > 1e-6 * x.norm(dim=1, keepdim=True).clamp_min(1e-12))[:, 0]
        lengths.append(relative_l2(moved, away))
        gradients.append(relative_l2(gradient[clear], expected[clear]))
        some = slice(None, None, -(-len(x) // CHECKED_ROWS))
        least = (x[some] - codebook[nearest_reference(x[some], codebook)]).norm(dim=1)
        wrong += int((away[some, 0] > least).sum())
    return {
        "gradient error": max(gradients),
        "length error": max(lengths),
        "wrong codes": float(wrong),
    }
