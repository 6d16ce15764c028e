"""Scene files: bytes, seconds, and what is lost between writing and reading."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.timing import Case, measure, use_threads
from nsvq_lightning.commands.benchmark.workloads import Workload, workloads
from nsvq_lightning.compression.stored import compress
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.file import LEVELS, read_nsvq, write_nsvq
from nsvq_lightning.io.ply import read_ply, write_ply
from nsvq_lightning.quantize import NSVQ, QUANTIZED, Quantizer
from nsvq_lightning.quantize.attributes import build_quantizers
from nsvq_lightning.quantize.base import as_quantizer
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.arrays import SplatArrays
from nsvq_lightning.splats.splats import ATTRIBUTES, Splats, SplatTensors

__all__ = ["Codec", "codecs", "compressed", "read_errors", "run"]


_NEIGHBOURS = 12
"""Splats among which one is looked for after a file has changed their order: those nearest to its place."""


class Codec(NamedTuple):
    """One kind of file, bound to a scene.

    Attributes:
        name: Name in the tables.
        suffix: Of the file.
        stored: What the writer is given.
        write: Writes it to a path, returns the bytes of the file.
        read: Reads it from a path.
    """

    name: str
    suffix: str
    stored: SplatArrays
    write: Callable[[Path], int]
    read: Callable[[Path], SplatArrays]


def run(scope: Scope) -> list[Measurement]:
    """Time writing and reading every workload in every format with every number of threads."""
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
        return [row for workload in workloads(scope) for row in _rows(workload, scope, Path(folder))]


def _rows(workload: Workload, scope: Scope, folder: Path) -> list[Measurement]:
    with use_threads(max(scope.threads)):
        kinds = codecs(workload, scope.codebooks)
    count = len(workload.splats.means)
    name = f"{workload.name}, {scope.codebooks} codebooks"
    sizes, errors, cases = {}, {}, []
    with use_threads(max(scope.threads)):
        truth = _image(workload.splats, workload)
    for index, codec in enumerate(kinds):
        path = folder / f"{index}{codec.suffix}"
        sizes[codec.name] = codec.write(path)
        read = codec.read(path)
        with use_threads(max(scope.threads)):
            image = _image(read.to_splats(), workload)
            meant = _image(codec.stored.to_splats(), workload)
        errors[codec.name] = {
            "image error": float((image - meant).abs().mean()),
            "image error with codebooks": float((image - truth).abs().mean()),
            **read_errors(read, codec.stored, SplatArrays.from_splats(workload.splats)),
        }
        cases += [_write_case(codec, path), _read_case(codec, path)]
    rows = []
    for threads in scope.threads:
        timings = measure(cases, scope, threads)
        for codec in kinds:
            for operation in ("write", "read"):
                timing = timings[f"{codec.name} {operation}"]
                values = {
                    "bytes a splat": sizes[codec.name] / count,
                    "bytes": float(sizes[codec.name]),
                    "splats a second": 1000 * count / timing.median,
                    **errors[codec.name],
                }
                rows.append(Measurement("codec", name, codec.name, operation, threads, timing, values))
    return rows


@torch.no_grad()
def _image(splats: SplatTensors, workload: Workload) -> Tensor:
    """The workload's view of some splats ``[H, W, 3]``."""
    return render(splats, workload.camera, background=workload.background).image


def _write_case(codec: Codec, path: Path) -> Case:
    return Case(f"{codec.name} write", lambda: codec.write(path))


def _read_case(codec: Codec, path: Path) -> Case:
    return Case(f"{codec.name} read", lambda: codec.read(path))


def codecs(workload: Workload, codebooks: str) -> list[Codec]:
    """Every level of the compressed file, and the plain file."""
    scene = compressed(workload, codebooks)
    plain = SplatArrays.from_splats(workload.splats)
    kinds = [_nsvq(scene, level) for level in LEVELS]
    return [*kinds, Codec(".ply", ".ply", plain, lambda path: write_ply(path, plain), read_ply)]


def _nsvq(scene: CompressedScene, level: str) -> Codec:
    def write(path: Path) -> int:
        return write_nsvq(path, scene, level)

    return Codec(f".nsvq {level}", ".nsvq", scene.arrays(), write, lambda path: read_nsvq(path).arrays())


def compressed(workload: Workload, codebooks: str) -> CompressedScene:
    """The scene with codebooks of one step of k-means: sizes and times do not depend on how good they are."""
    splats = Splats.from_tensors(*workload.splats)
    quantizers: dict[str, Quantizer] = {}
    for name, module in build_quantizers(lambda k, d: NSVQ(k, d, kmeans_steps=1), codebooks, splats).items():
        rows = QUANTIZED[name].rows(getattr(workload.splats, name))
        quantizers[name] = as_quantizer(module)
        quantizers[name].fit(rows, generator=generator(0, 0, "codec", name))
    return compress(splats.raw(), quantizers)


def read_errors(read: SplatArrays, stored: SplatArrays, original: SplatArrays) -> dict[str, float]:
    """Largest difference of what was read to what was written, and to the scene before its quantization.

    A file may keep the splats in another order; each is then compared with that of the nearest ones in its place that
    has the most like attributes.
    """
    order = np.arange(len(stored))
    if not np.array_equal(read.means, stored.means):
        near = cKDTree(read.means).query(stored.means, k=min(_NEIGHBOURS, len(stored)))[1].reshape(len(stored), -1)
        rows, wanted = _numbers(read), _numbers(stored)
        distances = [np.square(rows[column] - wanted).sum(1) for column in near.T]
        order = near[order, np.argmin(distances, 0)]
    return {
        "max error of the file": _largest_difference(read, stored, order),
        "max error with codebooks": _largest_difference(read, original, order),
    }


def _numbers(arrays: SplatArrays) -> NDArray[np.float64]:
    """All attributes of a splat in a row."""
    return np.concatenate([getattr(arrays, name).reshape(len(arrays), -1) for name in ATTRIBUTES], 1).astype(np.float64)


def _largest_difference(found: SplatArrays, expected: SplatArrays, order: NDArray[np.intp]) -> float:
    pairs = [(getattr(found, name)[order], getattr(expected, name)) for name in ATTRIBUTES]
    return max(float(np.abs(a.astype(np.float64) - b).max()) if b.size else 0.0 for a, b in pairs)
