"""Suite ``quantize``: a step of NSVQ, the search for the nearest code in it, and the k-means it starts from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from typing import NamedTuple, cast

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.commands.benchmark.report import Panel
from nsvq_lightning.commands.benchmark.timing import Case, Measurement, measure, use_threads
from nsvq_lightning.commands.benchmark.workloads import relative_l2, single_workload
from nsvq_lightning.quantize import NSVQ, QUANTIZED, CodebookQuantizer, kmeans, nearest, nearest_reference
from nsvq_lightning.quantize.attributes import build_quantizers
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.optim import LearningRates

__all__ = ["PANELS", "Attribute", "code_errors", "distortion", "plain_step", "prepare", "run", "step", "step_errors"]

STEP, SEARCH, KMEANS = "step, forward + backward", "search", "k-means"
PANELS = (Panel(STEP, "gradient error"), Panel(SEARCH, "wrong codes"), Panel(KMEANS, "distortion"))
VISIBLE = 0.8
"""Share of the splats that a camera sees."""
CHUNK = 1 << 22
"""Distances held at once by plain torch."""
CHECKED_ROWS = 4_000
"""Rows an attribute whose codes are checked: the float64 oracle is slow."""
LLOYD_STEPS = (1, 10)
"""Lloyd steps that are compared; training takes the last number."""


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


def run(scope: Scope) -> Iterator[Measurement]:
    """Time every operation with every number of threads."""
    source = single_workload(scope, "B100k")
    with use_threads(max(scope.threads)):
        attributes = prepare(source.splats, scope.codebooks)
    name = f"{source.name}, {scope.codebooks} codebooks"
    # The step comes last: it moves rows and codes, and the others measure them as they are fitted.
    yield from _search_rows(attributes, scope)
    yield from _kmeans_rows(attributes, scope)
    yield from _step_rows(attributes, name, scope)


def prepare(splats: RawSplats, codebooks: str) -> dict[str, Attribute]:
    """Quantizers with the paper's codebook sizes, fitted by one step of k-means, with the rows of a training view."""
    scene = Splats.from_tensors(*splats)
    chosen = torch.randperm(len(scene), generator=generator(0, 0, "visible"))[: int(VISIBLE * len(scene))].sort().values
    prepared = {}
    for name, module in build_quantizers(lambda k, d: NSVQ(k, d, kmeans_steps=1), codebooks, scene).items():
        quantizer = cast(CodebookQuantizer, module)
        every = QUANTIZED[name].rows(getattr(scene, name).detach())
        quantizer.fit(every, generator=generator(0, 0, "fit", name))
        x = every.clone().requires_grad_()
        upstream = 1e-6 * torch.randn(len(chosen), x.shape[1], generator=generator(0, 0, "upstream", name))
        prepared[name] = Attribute(quantizer.train(), x, chosen, upstream, getattr(LearningRates(), name))
    return prepared


def _step_rows(attributes: Mapping[str, Attribute], workload: str, scope: Scope) -> Iterator[Measurement]:
    methods = {"NSVQ": step, "plain torch": plain_step}
    with use_threads(max(scope.threads)):
        errors = {name: step_errors(attributes, method(attributes, 0)) for name, method in methods.items()}
    clock = count(1)
    cases = [
        Case(
            name,
            lambda method=method: method(attributes, next(clock)),  # type: ignore[misc]
            lambda: _advance(attributes, next(clock)),
        )
        for name, method in methods.items()
    ]
    note = f"codes checked on at most {CHECKED_ROWS} rows an attribute"
    for threads in scope.threads:
        for name, timing in measure(cases, scope, threads).items():
            yield Measurement("quantize", workload, name, STEP, threads, timing, errors[name], note)


@torch.no_grad()
def _advance(attributes: Mapping[str, Attribute], iteration: int) -> None:
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
        x, codebook = table[rows], quantizer.codebook
        codes = _by_distances(x.detach(), codebook.detach())
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
    lengths, gradients, wrong = [], [], 0.0
    for name, (quantized, gradient, codes) in results.items():
        quantizer, table, rows, upstream, _ = attributes[name]
        x, upstream, gradient = table.detach()[rows].double(), upstream.double(), gradient[rows]
        codebook = quantizer.codebook.detach()
        residual, offset = x - codebook.double()[codes], quantized.double() - x
        away, moved = residual.norm(dim=1, keepdim=True), offset.norm(dim=1, keepdim=True)
        along = (upstream * offset).sum(1, keepdim=True) / moved.where(moved > 0, torch.inf)
        expected = upstream + along * residual / away.where(away > 0, torch.inf)
        # A row on its code has no direction of its own.
        clear = (away > 1e-6 * x.norm(dim=1, keepdim=True).clamp_min(1e-12))[:, 0]
        lengths.append(relative_l2(moved, away))
        gradients.append(relative_l2(gradient[clear], expected[clear]))
        wrong += code_errors(x, codebook, codes)["wrong codes"]
    return {"gradient error": max(gradients), "length error": max(lengths), "wrong codes": wrong}


def code_errors(x: Tensor, codebook: Tensor, codes: Tensor) -> dict[str, float]:
    """How many codes ``[N]`` are farther than the nearest one, and by how much of the distance; at most CHECKED_ROWS.

    Args:
        x: Rows ``[N, D]``.
        codebook: ``[K, D]``.
        codes: What was found for them.
    """
    some = slice(None, None, -(-len(x) // CHECKED_ROWS))
    x, codebook = x[some].double(), codebook.double()
    chosen = (nearest_reference(x, codebook), codes[some])
    least, distance = ((x - codebook[each]).norm(dim=1) for each in chosen)
    added, total = float((distance - least).clamp_min(0).sum()), float(least.sum())
    return {"wrong codes": float((distance > least).sum()), "added distance": added / total if total > 0 else added}


def _by_distances(x: Tensor, codebook: Tensor) -> Tensor:
    parts = torch.split(x, max(1, CHUNK // len(codebook)))
    return torch.cat([torch.cdist(part, codebook).argmin(1) for part in parts])


SEARCHES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"nsvq_lightning": nearest, "cdist + argmin": _by_distances}
"""Searches by name: rows ``[N, D]`` and codebook ``[K, D]`` to codes ``[N]``."""


def _search_rows(attributes: Mapping[str, Attribute], scope: Scope) -> Iterator[Measurement]:
    for name, attribute in attributes.items():
        x, codebook = attribute.x.detach()[attribute.rows], attribute.quantizer.codebook.detach()
        workload = f"{name}: {len(x)} rows, D {x.shape[1]}, K {len(codebook)}"
        with use_threads(max(scope.threads)):
            errors = {method: code_errors(x, codebook, search(x, codebook)) for method, search in SEARCHES.items()}
        cases = [Case(method, partial(search, x, codebook)) for method, search in SEARCHES.items()]
        for threads in scope.threads:
            for method, timing in measure(cases, scope, threads).items():
                yield Measurement("quantize", workload, method, SEARCH, threads, timing, errors[method])


def _kmeans_rows(attributes: Mapping[str, Attribute], scope: Scope) -> Iterator[Measurement]:
    for name, attribute in attributes.items():
        x, codes = attribute.x.detach(), len(attribute.quantizer.codebook)

        def start(steps: int, x: Tensor = x, codes: int = codes, name: str = name) -> Tensor:
            return kmeans(x, codes, generator(0, 0, "start", name), steps=steps)

        cases = [Case(f"Lloyd: {steps} step{'s' * (steps > 1)}", partial(start, steps)) for steps in LLOYD_STEPS]
        with use_threads(max(scope.threads)):
            kept = {case.name: distortion(x, cast(Tensor, case.run())) for case in cases}
        workload = f"{name}: {len(x)} rows, D {x.shape[1]}, K {codes}"
        for threads in scope.threads:
            for method, timing in measure(cases, scope, threads).items():
                values = {"distortion": kept[method]}
                yield Measurement("quantize", workload, method, KMEANS, threads, timing, values)


def distortion(x: Tensor, codebook: Tensor) -> float:
    """Mean squared distance of the rows ``[N, D]`` to their nearest codes, as a share of their variance."""
    away = (x - codebook[nearest(x, codebook)]).double().square().sum(1).mean()
    spread = x.double().var(0, correction=0).sum()
    return float(away / spread) if spread > 0 else float(away)
