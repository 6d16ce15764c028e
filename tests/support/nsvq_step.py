"""A step of NSVQ on rows that look like those of training, and its errors against the closed forms in float64."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, cast

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import quantize
from nsvq_lightning.quantize import CodebookQuantizer
from nsvq_lightning.quantize.attributes import attribute_rows
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.training.self_check import relative_l2

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


def prepare(splats: RawSplats, codebooks: str) -> dict[str, Attribute]:
    """Quantizers of the benchmark, in training, with the rows of a training view."""
    chosen = torch.arange(0, len(splats.means), 2)
    prepared = {}
    for name, fitted in quantize.prepare(splats, codebooks).items():
        x = attribute_rows(splats, name).clone()
        upstream = 1e-6 * torch.randn(len(chosen), x.shape[1], generator=generator(0, 0, "upstream", name))
        quantizer = cast(CodebookQuantizer, fitted).train()
        prepared[name] = Attribute(quantizer, x.requires_grad_(), chosen, upstream)
    return prepared


def step(attributes: Mapping[str, Attribute], turn: int) -> Results:
    """One forward and backward pass."""
    results = {}
    for name, (quantizer, x, rows, upstream) in attributes.items():
        quantized, codes = quantizer(x, generator(0, turn, "noise", name), rows)
        gradient, _ = torch.autograd.grad(quantized, (x, quantizer.codebook), upstream)
        results[name] = quantized.detach(), gradient, codes
    return results


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
        wrong += quantize.code_errors(x, codebook, codes)["wrong codes"]
    return {"gradient error": max(gradients), "length error": max(lengths), "wrong codes": wrong}
