"""Suite ``quantize``: a step of NSVQ, and the search for the nearest code in it."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import count
from typing import NamedTuple, cast

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.timing import Measurement, Scope, compare
from nsvq_lightning.commands.benchmark.workloads import workloads
from nsvq_lightning.quantize import NSVQ, CodebookQuantizer, nearest, nearest_reference
from nsvq_lightning.quantize.attributes import attribute_rows, build_quantizers
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.optim import LearningRates
from nsvq_lightning.training.self_check import relative_l2

STEP = "step, forward + backward"
SEARCH = "search"

# Quantized rows ``[V, D]``, their gradient by the rows ``[N, D]``, and codes ``[V]`` by attribute.
Results = dict[str, tuple[Tensor, Tensor, Tensor]]


class Attribute(NamedTuple):
    """One quantized attribute in the middle of training.

    Attributes:
        quantizer: Fitted and in training mode.
        x: Rows of all splats ``[N, D]``, which move from step to step.
        rows: The visible ones ``[V]``.
        upstream: Gradient of the quantized rows ``[V, D]``.
    """

    quantizer: CodebookQuantizer
    x: Tensor
    rows: Tensor
    upstream: Tensor


def run(scope: Scope) -> Iterator[Measurement]:
    """Time every operation."""
    if scope.scene is None:
        scope = replace(scope, workloads=("A20k" if scope.quick else "B100k",))
    (workload,) = workloads(scope)
    attributes = prepare(workload.splats, scope.codebooks)
    for name, attribute in attributes.items():
        rows = attribute.x.detach()[attribute.rows]
        codebook = attribute.quantizer.codebook.detach()
        cases = {
            "nsvq_lightning": partial(nearest, rows, codebook),
            "cdist + argmin": partial(_by_distances, rows, codebook),
        }
        errors = {method: code_errors(rows, codebook, call()) for method, call in cases.items()}
        described = f"{name}: {len(rows)} rows, D {rows.shape[1]}, K {len(codebook)}"
        yield from compare(SEARCH, described, cases, errors, scope)
    # The step comes last: it moves rows and codes, and the search measures them as they are fitted.
    clock = count(1)
    methods: dict[str, Callable[..., Results]] = {"NSVQ": step, "plain torch": partial(step, quantize=plain_nsvq)}
    errors = {method: step_errors(attributes, call(attributes, 0)) for method, call in methods.items()}
    steps = {method: lambda call=call: call(attributes, next(clock)) for method, call in methods.items()}
    described = f"{workload.name}, {scope.codebooks} codebooks"
    yield from compare(STEP, described, steps, errors, scope, prepare=lambda: _advance(attributes, next(clock)))


def prepare(splats: RawSplats, codebooks: str) -> dict[str, Attribute]:
    """Quantizers with the paper's codebook sizes, fitted by one step of k-means, with the rows of a training view."""
    scene = Splats.from_tensors(*splats)
    shuffled = torch.randperm(len(scene), generator=generator(0, 0, "visible"))
    chosen = shuffled[: int(0.8 * len(scene))].sort().values  # about as many as a camera sees
    prepared = {}
    for name, module in build_quantizers(partial(NSVQ, kmeans_steps=1), codebooks, scene).items():
        quantizer = cast(CodebookQuantizer, module)
        x = attribute_rows(scene.raw(), name).clone()
        quantizer.fit(x, generator=generator(0, 0, "fit", name))
        upstream = 1e-6 * torch.randn(len(chosen), x.shape[1], generator=generator(0, 0, "upstream", name))
        prepared[name] = Attribute(quantizer.train(), x.requires_grad_(), chosen, upstream)
    return prepared


@torch.no_grad()
def _advance(attributes: Mapping[str, Attribute], iteration: int) -> None:
    """Move rows and codes about as far as a step of Adam does, or a search that remembers would have nothing to do."""
    for name, attribute in attributes.items():
        rate = getattr(LearningRates(), name)  # how far Adam moves a number
        for what, values in (("rows", attribute.x), ("codes", attribute.quantizer.codebook)):
            draw = generator(0, iteration, what, name)
            values += rate * (2 * torch.rand(values.shape, generator=draw) - 1)


# Quantized rows ``[V, D]`` and their codes ``[V]``, given quantizer, rows of all splats, noise and visible rows.
Quantize = Callable[[CodebookQuantizer, Tensor, torch.Generator, Tensor], tuple[Tensor, Tensor]]


def step(attributes: Mapping[str, Attribute], turn: int, quantize: Quantize = CodebookQuantizer.__call__) -> Results:
    """One forward and backward pass, by default of the quantizers of the package."""
    results = {}
    for name, (quantizer, x, rows, upstream) in attributes.items():
        quantized, codes = quantize(quantizer, x, generator(0, turn, "noise", name), rows)
        gradient, _ = torch.autograd.grad(quantized, (x, quantizer.codebook), upstream)
        results[name] = quantized.detach(), gradient, codes
    return results


def plain_nsvq(quantizer: CodebookQuantizer, raw: Tensor, draw: torch.Generator, rows: Tensor) -> tuple[Tensor, Tensor]:
    """NSVQ in a few lines of torch: all distances, noise by ``randn``, gradients by autograd."""
    x, codebook = raw[rows], quantizer.codebook
    codes = _by_distances(x.detach(), codebook.detach())
    noise = torch.randn(x.shape, generator=draw)
    length = torch.linalg.vector_norm(x - codebook[codes], dim=1, keepdim=True)
    return x + length * noise / noise.norm(dim=1, keepdim=True), codes


def step_errors(attributes: Mapping[str, Attribute], results: Results) -> dict[str, float]:
    """Worst errors over the attributes against the closed forms in float64.

    With c the code that was chosen, r = x − c, and v̂ the direction of x̃ − x: ‖x̃ − x‖ = ‖r‖, and the gradient by x is
    g + (g·v̂) r/‖r‖.
    """
    lengths, gradients, wrong = [], [], 0.0
    for name, (quantized, gradient, codes) in results.items():
        attribute = attributes[name]
        x = attribute.x.detach()[attribute.rows].double()
        codebook = attribute.quantizer.codebook.detach()
        upstream = attribute.upstream.double()
        residual = x - codebook.double()[codes]
        offset = quantized.double() - x
        away = residual.norm(dim=1, keepdim=True)
        moved = offset.norm(dim=1, keepdim=True)
        along = (upstream * offset).sum(1, keepdim=True) / moved.where(moved > 0, torch.inf)
        expected = upstream + along * residual / away.where(away > 0, torch.inf)
        # A row on its code has no direction of its own.
        clear = (away > 1e-6 * x.norm(dim=1, keepdim=True).clamp_min(1e-12))[:, 0]
        lengths.append(relative_l2(moved, away))
        gradients.append(relative_l2(gradient[attribute.rows][clear], expected[clear]))
        wrong += code_errors(x, codebook, codes)["wrong codes"]
    return {"gradient error": max(gradients), "length error": max(lengths), "wrong codes": wrong}


# Rows an attribute whose codes are checked: the float64 oracle is slow.
CHECKED_ROWS = 4_000


def code_errors(x: Tensor, codebook: Tensor, codes: Tensor) -> dict[str, float]:
    """How many codes ``[N]`` are farther than the nearest one, and by how much of the distance; at most CHECKED_ROWS.

    Args:
        x: Rows ``[N, D]``.
        codebook: ``[K, D]``.
        codes: What was found for them.
    """
    every = math.ceil(len(x) / CHECKED_ROWS)
    x, codebook, codes = x[::every].double(), codebook.double(), codes[::every]
    least = (x - codebook[nearest_reference(x, codebook)]).norm(dim=1)
    distance = (x - codebook[codes]).norm(dim=1)
    added = float((distance - least).clamp_min(0).sum())
    total = float(least.sum())
    return {"wrong codes": float((distance > least).sum()), "added distance": added / total if total > 0 else added}


def _by_distances(x: Tensor, codebook: Tensor) -> Tensor:
    parts = torch.split(x, max(1, (1 << 22) // len(codebook)))  # all distances at once would fill the memory
    return torch.cat([torch.cdist(part, codebook).argmin(1) for part in parts])
