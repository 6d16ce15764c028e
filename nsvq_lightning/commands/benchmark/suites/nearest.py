"""Searches for the nearest code against the float64 definition, on the four attributes that are quantized."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.commands.benchmark.workloads import Workload, single_workload
from nsvq_lightning.quantize import QUANTIZED, codebook_sizes, kmeans, nearest, nearest_reference
from nsvq_lightning.random import generator

__all__ = ["METHODS", "Search", "code_errors", "run", "searches"]

ROWS = {True: 4_000, False: 80_000}
"""Rows that are searched, quick and full; 80 000 of 100 000 splats are in view of a typical camera."""
CHECKED_ROWS = 8_000
"""Rows whose codes are checked: the float64 oracle is slow."""
CHUNK = 1 << 22
"""Distances held at once by the plain methods."""


class Search(NamedTuple):
    """Rows ``[N, D]`` of one attribute, and the codebook ``[K, D]`` that is searched for them."""

    attribute: str
    x: Tensor
    codebook: Tensor

    def __str__(self) -> str:
        return f"{self.attribute}: {len(self.x)} rows, D {self.x.shape[1]}, K {len(self.codebook)}"


def run(scope: Scope) -> list[Measurement]:
    """Time every method on every attribute with every number of threads."""
    found = searches(single_workload(scope, "B100k"), ROWS[scope.quick], scope.codebooks)
    return [row for search in found for row in _rows(search, scope)]


def searches(source: Workload, rows: int, codebooks: str) -> list[Search]:
    """A search for each quantized attribute, with codebooks of two steps of k-means on all splats."""
    sizes = codebook_sizes(codebooks)
    found = []
    for name, attribute in QUANTIZED.items():
        every = attribute.rows(getattr(source.splats, name))
        if every.shape[1] == 0:
            continue
        codebook = kmeans(every, sizes[name], generator(0, 0, "nearest", name), steps=2)
        chosen = torch.randperm(len(every), generator=generator(0, 0, "rows", name))[:rows]
        found.append(Search(name, every[chosen], codebook))
    return found


def _rows(search: Search, scope: Scope) -> list[Measurement]:
    with use_threads(max(scope.threads)):
        some = search._replace(x=search.x[:CHECKED_ROWS])
        best = nearest_reference(some.x.double(), some.codebook.double())
        errors = {name: code_errors(some, method(some.x, some.codebook), best) for name, method in METHODS.items()}
    note = f"codes of {len(some.x)} rows checked"
    rows = []
    for threads in scope.threads:
        timings = measure([_case(name, search) for name in METHODS], scope, threads)
        rows += [
            Measurement("nearest", str(search), n, "search", threads, timings[n], errors[n], note) for n in METHODS
        ]
    return rows


def _case(name: str, search: Search) -> Case:
    return Case(name, lambda: METHODS[name](search.x, search.codebook))


def code_errors(search: Search, codes: Tensor, best: Tensor) -> dict[str, float]:
    """How many codes ``[N]`` are farther than the ``best`` ones, and by how much of the distance on average."""
    x, codebook = search.x.double(), search.codebook.double()
    least, distance = ((x - codebook[chosen]).norm(dim=1) for chosen in (best, codes))
    added = (distance - least).clamp_min(0)
    total = float(least.sum())
    return {
        "added distance": float(added.sum()) / total if total > 0 else float(added.sum()),
        "wrong codes": float((distance > least).sum()),
    }


def _by_distances(x: Tensor, codebook: Tensor) -> Tensor:
    rows = max(1, CHUNK // len(codebook))
    return torch.cat([torch.cdist(part, codebook).argmin(1) for part in torch.split(x, rows)])


def _by_product(x: Tensor, codebook: Tensor) -> Tensor:
    """‖x − c‖² without its constant: one matrix product, but cancellation where x and c are far from 0."""
    squares = codebook.square().sum(1)
    rows = max(1, CHUNK // len(codebook))
    return torch.cat([torch.addmm(squares, part, codebook.T, alpha=-2).argmin(1) for part in torch.split(x, rows)])


def _by_rounded_product(x: Tensor, codebook: Tensor) -> Tensor:
    return _by_product(x.bfloat16(), codebook.bfloat16())


METHODS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "nsvq_lightning": nearest,
    "cdist + argmin": _by_distances,
    "addmm + argmin": _by_product,
    "addmm + argmin, bfloat16": _by_rounded_product,
}
"""Searches by name: rows ``[N, D]`` and codebook ``[K, D]`` to codes ``[N]``."""
