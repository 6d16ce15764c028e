"""Suite ``codec``: writing and reading scene files."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from nsvq_lightning.commands.benchmark import quantize
from nsvq_lightning.commands.benchmark.render import painted
from nsvq_lightning.commands.benchmark.timing import Measurement, Scope, compare
from nsvq_lightning.commands.benchmark.workloads import Workload, workloads
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.io.nsvq.precision import LEVELS
from nsvq_lightning.training.splat_scene import to_compressed


def run(scope: Scope) -> Iterator[Measurement]:
    """Time writing and reading."""
    for workload in workloads(scope):
        with TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
            yield from _file_rows(workload, scope, Path(folder))


def _file_rows(workload: Workload, scope: Scope, folder: Path) -> Iterator[Measurement]:
    splats = workload.splats
    # Codebooks of one step of k-means: sizes and times do not depend on how good they are.
    scene = to_compressed(splats, quantize.prepare(splats, scope.codebooks))
    writers = {".ply": partial(save, splats)}
    writers |= {f".nsvq {level}": partial(save, scene, storage=level) for level in LEVELS}
    look = torch.no_grad()(partial(painted, "auto"))
    truths = {".ply": look(splats, workload), ".nsvq": look(scene.tensors(), workload)}
    writes = {}
    reads: dict[str, Callable[[], object]] = {}
    values = {}
    for name, write in writers.items():
        suffix = name.split()[0]
        path = folder / f"scene{len(reads)}{suffix}"
        writes[name] = partial(write, path)
        reads[name] = partial(load, path)
        size = write(path)
        error = look(load(path).raw(), workload) - truths[suffix]
        values[name] = {
            "bytes a splat": size / len(splats.means),
            "bytes": size,
            "image error": float(error.abs().mean()),
        }
    described = f"{workload.name}, {scope.codebooks} codebooks"
    yield from compare("write", described, writes, values, scope)
    yield from compare("read", described, reads, values, scope)
