"""Suite ``quantize``: a step of NSVQ, and the search for the nearest code in it."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from typing import NamedTuple, cast

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.commands.benchmark.timing import Measurement, compare
from nsvq_lightning.commands.benchmark.workloads import relative_l2, synthetic_workload, workloads
from nsvq_lightning.quantize import NSVQ, CodebookQuantizer, nearest, nearest_reference
from nsvq_lightning.quantize.attributes import attribute_rows, build_quantizers
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.optim import LearningRates

STEP, SEARCH = "step, forward + backward", "search"


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


# Quantized rows ``[V, D]``, their gradient by the rows ``[N, D]``, and codes ``[V]`` by attribute.
Results = dict[str, tuple[Tensor, Tensor, Tensor]]


def run(scope: Scope) -> Iterator[Measurement]:
    """Time every operation."""
    source = synthetic_workload("A20k" if scope.quick else "B100k") if scope.scene is None else workloads(scope)[0]
    attributes = prepare(source.splats, scope.codebooks)
    for name, attribute in attributes.items():
        x, codebook = attribute.x.detach(), attribute.quantizer.codebook.detach()
        seen, size = x[attribute.rows], f"D {x.shape[1]}, K {len(codebook)}"
        searches = {"nsvq_lightning": nearest, "cdist + argmin": _by_distances}
        cases = {method: partial(search, seen, codebook) for method, search in searches.items()}
        errors = {method: code_errors(seen, codebook, call()) for method, call in cases.items()}
        yield from compare(SEARCH, f"{name}: {len(seen)} rows, {size}", cases, errors, scope)
    # The step comes last: it moves rows and codes, and the search measures them as they are fitted.
    clock = count(1)
    methods: dict[str, Callable[..., Results]] = {"NSVQ": step, "plain torch": partial(step, quantize=plain_nsvq)}
    errors = {method: step_errors(attributes, call(attributes, 0)) for method, call in methods.items()}
    steps = {method: lambda call=call: call(attributes, next(clock)) for method, call in methods.items()}
    workload, move = f"{source.name}, {scope.codebooks} codebooks", lambda: _advance(attributes, next(clock))
    yield from compare(STEP, workload, steps, errors, scope, prepare=move)


def prepare(splats: RawSplats, codebooks: str) -> dict[str, Attribute]:
    """Quantizers with the paper's codebook sizes, fitted by one step of k-means, with the rows of a training view."""
    scene = Splats.from_tensors(*splats)
    shuffled = torch.randperm(len(scene), generator=generator(0, 0, "visible"))
    chosen = shuffled[: int(0.8 * len(scene))].sort().values  # about as many as a camera sees
    prepared = {}
    for name, module in build_quantizers(lambda k, d: NSVQ(k, d, kmeans_steps=1), codebooks, scene).items():
        quantizer = cast(CodebookQuantizer, module)
        every = attribute_rows(scene.raw(), name)
        quantizer.fit(every, generator=generator(0, 0, "fit", name))
        x = every.clone().requires_grad_()
        upstream = 1e-6 * torch.randn(len(chosen), x.shape[1], generator=generator(0, 0, "upstream", name))
        prepared[name] = Attribute(quantizer.train(), x, chosen, upstream, getattr(LearningRates(), name))
    return prepared


@torch.no_grad()
def _advance(attributes: Mapping[str, Attribute], iteration: int) -> None:
    """Move rows and codes about as far as a step of Adam does, or a search that remembers would have nothing to do."""
    for name, attribute in attributes.items():
        for what, values in (("rows", attribute.x), ("codes", attribute.quantizer.codebook)):
            draw = generator(0, iteration, what, name)
            values += attribute.rate * (2 * torch.rand(values.shape, generator=draw) - 1)


# Quantized rows ``[V, D]`` and their codes ``[V]``, given quantizer, rows of all splats, noise and visible rows.
Quantize = Callable[[CodebookQuantizer, Tensor, torch.Generator, Tensor], tuple[Tensor, Tensor]]


def step(attributes: Mapping[str, Attribute], turn: int, quantize: Quantize = CodebookQuantizer.__call__) -> Results:
    """One forward and backward pass, by default of the quantizers of the package."""
    results: Results = {}
    for name, (quantizer, x, rows, upstream, _) in attributes.items():
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


# Rows an attribute whose codes are checked: the float64 oracle is slow.
CHECKED_ROWS = 4_000


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
    parts = torch.split(x, max(1, (1 << 22) // len(codebook)))  # all distances at once would fill the memory
    return torch.cat([torch.cdist(part, codebook).argmin(1) for part in parts])
