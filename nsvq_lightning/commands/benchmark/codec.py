"""Suite ``codec``: writing and reading scene files."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import Scope, quantize, timing
from nsvq_lightning.commands.benchmark.workloads import Workload, workloads
from nsvq_lightning.compression.stored import to_compressed
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.quantize.codebook import as_quantizer
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import SplatTensors


def run(scope: Scope) -> Iterator[timing.Measurement]:
    """Time writing and reading."""
    for workload in workloads(scope):
        with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
            yield from _file_rows(workload, scope, Path(folder))


def _file_rows(workload: Workload, scope: Scope, folder: Path) -> Iterator[timing.Measurement]:
    values: dict[str, Mapping[str, float]] = {}
    paths: dict[str, Path] = {}
    # Codebooks of one step of k-means: sizes and times do not depend on how good they are.
    fitted = quantize.prepare(workload.splats, scope.codebooks)
    scene = to_compressed(workload.splats, {name: as_quantizer(each.quantizer) for name, each in fitted.items()})
    writers: dict[str, Callable[[Path], int]] = {".ply": partial(save, workload.splats)}
    writers |= {f".nsvq {level}": partial(save, scene, storage=Storage(level)) for level in LEVELS}
    images = {".ply": _image(workload, workload.splats), ".nsvq": _image(workload, scene.decode())}
    for name, write in writers.items():
        suffix = name.partition(" ")[0]
        path = paths[name] = folder / f"scene{len(paths)}{suffix}"
        size = write(path)
        error = float((_image(workload, load(path)) - images[suffix]).abs().mean())
        each = size / len(workload.splats.means)
        values[name] = {"bytes a splat": each, "bytes": float(size), "image error": error}
    described = f"{workload.name}, {scope.codebooks} codebooks"
    writes = {name: partial(write, paths[name]) for name, write in writers.items()}
    reads = {name: partial(load, path) for name, path in paths.items()}
    yield from timing.compare("write", described, writes, values, scope)
    yield from timing.compare("read", described, reads, values, scope)


@torch.no_grad()
def _image(workload: Workload, splats: SplatTensors) -> Tensor:
    """The workload's view of some splats ``[H, W, 3]``."""
    return render(splats, workload.camera, background=workload.background).image
