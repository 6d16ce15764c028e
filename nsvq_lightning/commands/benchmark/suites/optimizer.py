"""Implementations of Adam on all attributes of a scene, against Adam in float64."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.error_measures import relative_l2, worst_first
from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import ATTRIBUTES, Splats
from nsvq_lightning.training.optim import EPS, LearningRates, build_adam, param_groups

__all__ = ["METHODS", "Method", "errors_after", "run"]

Groups = list[dict[str, Any]]

SPLATS = {True: (100_000,), False: (100_000, 500_000)}
CHECKED_SPLATS, CHECKED_STEPS = 5_000, 10


Method = Callable[[Groups], torch.optim.Optimizer]

METHODS: dict[str, Method] = {
    "build_adam": build_adam,
    "torch, foreach": lambda groups: torch.optim.Adam(groups, eps=EPS, foreach=True),
    "torch, for loop": lambda groups: torch.optim.Adam(groups, eps=EPS, foreach=False),
}
"""Optimisers by name; ``build_adam`` is what training uses: torch's fused one where there is such."""
ORACLE = "torch, for loop"


def run(scope: Scope) -> list[Measurement]:
    """Time one step of every implementation at every size with every number of threads."""
    with use_threads(max(scope.threads)):
        errors = {name: errors_after(CHECKED_STEPS, method) for name, method in METHODS.items()}
    note = f"error of what {CHECKED_STEPS} steps add to {CHECKED_SPLATS} splats"
    rows = []
    for count in SPLATS[scope.quick]:
        splats = random_splats(count)
        gradients = _gradients(splats, 0)
        cases = [_case(name, splats, gradients) for name in METHODS]
        for threads in scope.threads:
            timings, workload = measure(cases, scope, threads), f"{count // 1000}k splats, SH 3"
            rows += [
                Measurement("optimizer", workload, name, "step", threads, timings[name], errors[name], note)
                for name in METHODS
            ]
    return rows


def random_splats(count: int, dtype: torch.dtype = torch.float32) -> Splats:
    """Splats with random attributes of degree 3; the same numbers in every type."""
    draw = generator(0, 0, "splats")
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 1, 3), (count, 15, 3))
    return Splats.from_tensors(*(torch.randn(shape, generator=draw).to(dtype) for shape in shapes))


def _gradients(splats: Splats, step: int) -> dict[str, Tensor]:
    """Gradients by attribute, as small as those of a splat; the same numbers in every type."""
    draw = generator(0, step, "gradients")
    return {
        name: 1e-6 * torch.randn(parameter.shape, generator=draw) for name, parameter in splats.attributes().items()
    }


def _optimizer(method: Method, splats: Splats) -> torch.optim.Optimizer:
    return method(param_groups(splats, {}, LearningRates(), extent=1.0))


def _case(name: str, splats: Splats, gradients: dict[str, Tensor]) -> Case:
    own = Splats.from_tensors(*(tensor.detach() for tensor in splats.raw()))
    optimizer = _optimizer(METHODS[name], own)
    for attribute, parameter in own.attributes().items():
        parameter.grad = gradients[attribute]
    return Case(name, optimizer.step)


def errors_after(steps: int, method: Method) -> dict[str, float]:
    """Relative error of the sum of some updates, the worst attribute first."""
    truth, moved = _moved(steps, METHODS[ORACLE], torch.float64), _moved(steps, method, torch.float32)
    return worst_first("update error", {name: relative_l2(moved[name], truth[name]) for name in ATTRIBUTES})


def _moved(steps: int, method: Method, dtype: torch.dtype) -> dict[str, Tensor]:
    """How far some steps move each attribute, in float64."""
    splats = random_splats(CHECKED_SPLATS, dtype)
    before = {name: value.detach().double().clone() for name, value in splats.attributes().items()}
    optimizer = _optimizer(method, splats)
    for step in range(steps):
        for name, gradient in _gradients(splats, step).items():
            splats.attributes()[name].grad = gradient.to(dtype)
        optimizer.step()
    return {name: value.detach().double() - before[name] for name, value in splats.attributes().items()}
