"""Implementations of Adam on all attributes of a scene, against Adam in float64."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.error_measures import relative_l2, worst_first
from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.random import generator
from nsvq_lightning.skips import switched
from nsvq_lightning.splats.sh_degree import sh_coefficients
from nsvq_lightning.splats.splats import ATTRIBUTES, Splats
from nsvq_lightning.training.optim import EPS, LearningRates, build_adam, param_groups, set_columns

__all__ = ["METHODS", "SCENARIOS", "AdamVariant", "Scenario", "errors_after", "run"]

Groups = list[dict[str, Any]]

SPLATS = {True: (100_000,), False: (100_000, 500_000)}
CHECKED_SPLATS, CHECKED_STEPS = 5_000, 10


class Scenario(NamedTuple):
    """Which gradients there are.

    Attributes:
        operation: Name in the tables.
        visible: Share of the splats that have one, others in every step.
        sh_degree: SH bands above have none, and never had.
    """

    operation: str
    visible: float = 1.0
    sh_degree: int = 3


class AdamVariant(NamedTuple):
    """An optimiser, and switches that are set while it steps."""

    build: Callable[[Groups], torch.optim.Optimizer]
    switches: Mapping[str, bool] = MappingProxyType({})


SCENARIOS = (
    Scenario("step"),
    Scenario("step, a fifth out of view", visible=0.8),
    Scenario("step, SH degree 0", sh_degree=0),
)
METHODS = {
    "build_adam": AdamVariant(build_adam),
    "build_adam, skip adam_rows": AdamVariant(build_adam, {"adam_rows": True}),
    "build_adam, no skip of adam_bands": AdamVariant(build_adam, {"adam_bands": False}),
    "torch, fused": AdamVariant(lambda groups: torch.optim.Adam(groups, eps=EPS, fused=True)),
    "torch, foreach": AdamVariant(lambda groups: torch.optim.Adam(groups, eps=EPS, foreach=True)),
    "torch, for loop": AdamVariant(lambda groups: torch.optim.Adam(groups, eps=EPS, foreach=False)),
}
"""Optimisers by name; ``build_adam`` is what training uses."""
ORACLE = "torch, for loop"
COMPARED = (
    ("build_adam", "torch, fused", "torch, foreach", "torch, for loop"),
    ("build_adam", "build_adam, skip adam_rows"),
    ("build_adam", "build_adam, no skip of adam_bands"),
)
"""Methods of each scenario: where there is nothing to skip, the others say nothing new."""


def run(scope: Scope) -> list[Measurement]:
    """Time one step of every implementation at every size with every number of threads."""
    rows = []
    for scenario, names in zip(SCENARIOS, COMPARED, strict=True):
        with use_threads(max(scope.threads)):
            errors = {name: errors_after(CHECKED_STEPS, METHODS[name], scenario) for name in names}
        for count in SPLATS[scope.quick]:
            rows += _rows(scenario, names, count, errors, scope)
    return rows


def _rows(
    scenario: Scenario, names: Sequence[str], count: int, errors: Mapping[str, dict[str, float]], scope: Scope
) -> list[Measurement]:
    splats = random_splats(count)
    gradients = _gradients(splats, 0, scenario)
    cases = [_case(name, splats, gradients, scenario) for name in names]
    note = f"error of what {CHECKED_STEPS} steps add to {CHECKED_SPLATS} splats"
    rows = []
    for threads in scope.threads:
        timings, workload = measure(cases, scope, threads), f"{count // 1000}k splats, SH 3"
        rows += [
            Measurement("optimizer", workload, name, scenario.operation, threads, timings[name], errors[name], note)
            for name in names
        ]
    return rows


def random_splats(count: int, dtype: torch.dtype = torch.float32) -> Splats:
    """Splats with random attributes of degree 3; the same numbers in every type."""
    draw = generator(0, 0, "splats")
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 1, 3), (count, 15, 3))
    return Splats.from_tensors(*(torch.randn(shape, generator=draw).to(dtype) for shape in shapes))


def _gradients(splats: Splats, step: int, scenario: Scenario) -> dict[str, Tensor]:
    """Gradients by attribute, as small as those of a splat; the same numbers in every type."""
    draw = generator(0, step, "gradients")
    shapes = {name: parameter.shape for name, parameter in splats.attributes().items()}
    gradients = {name: 1e-6 * torch.randn(shape, generator=draw) for name, shape in shapes.items()}
    hidden = torch.rand(len(splats), generator=generator(0, step, "visible")) >= scenario.visible
    for gradient in gradients.values():
        gradient[hidden] = 0
    gradients["shN"][:, sh_coefficients(scenario.sh_degree) :] = 0
    return gradients


def _optimizer(method: AdamVariant, splats: Splats, scenario: Scenario) -> torch.optim.Optimizer:
    optimizer = method.build(param_groups(splats, {}, LearningRates(), extent=1.0))
    set_columns(optimizer, "shN", 3 * sh_coefficients(scenario.sh_degree))
    return optimizer


def _case(name: str, splats: Splats, gradients: dict[str, Tensor], scenario: Scenario) -> Case:
    own = Splats.from_tensors(*(tensor.detach() for tensor in splats.raw()))
    optimizer = _optimizer(METHODS[name], own, scenario)
    for attribute, parameter in own.attributes().items():
        parameter.grad = gradients[attribute]

    def step() -> None:
        with switched(**METHODS[name].switches):
            optimizer.step()

    return Case(name, step)


def errors_after(steps: int, method: AdamVariant, scenario: Scenario) -> dict[str, float]:
    """Relative error of the sum of some updates, the worst attribute first."""
    truth = _moved(steps, METHODS[ORACLE], scenario, torch.float64)
    moved = _moved(steps, method, scenario, torch.float32)
    return worst_first("update error", {name: relative_l2(moved[name], truth[name]) for name in ATTRIBUTES})


def _moved(steps: int, method: AdamVariant, scenario: Scenario, dtype: torch.dtype) -> dict[str, Tensor]:
    """How far some steps move each attribute, in float64."""
    splats = random_splats(CHECKED_SPLATS, dtype)
    before = {name: value.detach().double().clone() for name, value in splats.attributes().items()}
    optimizer = _optimizer(method, splats, scenario)
    with switched(**method.switches):
        for step in range(steps):
            for name, gradient in _gradients(splats, step, scenario).items():
                splats.attributes()[name].grad = gradient.to(dtype)
            optimizer.step()
    return {name: value.detach().double() - before[name] for name, value in splats.attributes().items()}
