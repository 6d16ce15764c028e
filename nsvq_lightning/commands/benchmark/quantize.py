"""Suite ``quantize``: the search for the nearest code, of the rows that a training view sees."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.timing import Measurement, Scope, compare
from nsvq_lightning.commands.benchmark.workloads import workloads
from nsvq_lightning.data.scene import spread
from nsvq_lightning.quantize import NSVQ, nearest, nearest_reference
from nsvq_lightning.quantize.attributes import attribute_rows, build_quantizers
from nsvq_lightning.quantize.codebook import Quantizer, as_quantizer
from nsvq_lightning.random import generator
from nsvq_lightning.splats.splats import RawSplats, Splats


def run(scope: Scope) -> Iterator[Measurement]:
    """Time the search for each attribute."""
    if scope.scene is None:
        # One is enough: the middle one of all, or the one that is asked for.
        scope = replace(scope, workloads=scope.workloads[1:2] or scope.workloads)
    (workload,) = workloads(scope)
    shuffled = torch.randperm(len(workload.splats.means), generator=generator(0, 0, "visible"))
    chosen = shuffled[: int(0.8 * len(shuffled))].sort().values  # about as many as a camera sees
    for name, quantizer in prepare(workload.splats, scope.codebooks).items():
        rows = attribute_rows(workload.splats, name)[chosen]
        codebook = quantizer.codebook.detach()
        cases = {
            "nsvq_lightning": partial(nearest, rows, codebook),
            "cdist + argmin": partial(_by_distances, rows, codebook),
        }
        errors = {method: code_errors(rows, codebook, call()) for method, call in cases.items()}
        described = f"{name}: {len(rows)} rows, D {rows.shape[1]}, K {len(codebook)}"
        yield from compare("search", described, cases, errors, scope)


def prepare(splats: RawSplats, codebooks: str) -> dict[str, Quantizer]:
    """Quantizers with the paper's codebook sizes, fitted by one step of k-means."""
    scene = Splats.from_tensors(*splats)
    built = build_quantizers(partial(NSVQ, kmeans_steps=1), codebooks, scene)
    quantizers = {name: as_quantizer(module) for name, module in built.items()}
    for name, quantizer in quantizers.items():
        quantizer.fit(attribute_rows(scene.raw(), name), generator=generator(0, 0, "fit", name))
    return quantizers


# Rows an attribute whose codes are checked: the float64 oracle is slow.
CHECKED_ROWS = 4_000


def code_errors(x: Tensor, codebook: Tensor, codes: Tensor) -> dict[str, float]:
    """How many codes ``[N]`` are farther than the nearest one, and by how much of the distance; at most CHECKED_ROWS.

    Args:
        x: Rows ``[N, D]``.
        codebook: ``[K, D]``.
        codes: What was found for them.
    """
    x, codebook, codes = spread(x, CHECKED_ROWS).double(), codebook.double(), spread(codes, CHECKED_ROWS)
    least = (x - codebook[nearest_reference(x, codebook)]).norm(dim=1)
    distance = (x - codebook[codes]).norm(dim=1)
    added = float((distance - least).clamp_min(0).sum())
    total = float(least.sum())
    return {"wrong codes": float((distance > least).sum()), "added distance": added / total if total > 0 else added}


def _by_distances(x: Tensor, codebook: Tensor) -> Tensor:
    parts = torch.split(x, max(1, (1 << 22) // len(codebook)))  # all distances at once would fill the memory
    return torch.cat([torch.cdist(part, codebook).argmin(1) for part in parts])
