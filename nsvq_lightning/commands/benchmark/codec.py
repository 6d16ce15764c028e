"""Suite ``codec``: writing and reading scene files, and what a scene loses when it is made small without its photos."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from math import isfinite
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import Scope
from nsvq_lightning.commands.benchmark.quantize import prepare
from nsvq_lightning.commands.benchmark.report import Panel
from nsvq_lightning.commands.benchmark.timing import (
    Case,
    Measurement,
    Timing,
    measure,
    milliseconds,
    sgemm,
    use_threads,
)
from nsvq_lightning.commands.benchmark.workloads import Workload, workloads
from nsvq_lightning.commands.compress import DEFAULT_TUNING, VIEWS
from nsvq_lightning.compression.ladder import LADDER, PLAIN, Compressor, Rung
from nsvq_lightning.compression.stored import to_compressed
from nsvq_lightning.compression.viewpoints import decibels, pictures, views_of
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.io.nsvq.precision import LEVELS, Storage
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.quantize.base import as_quantizer
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import SplatTensors

__all__ = ["PANELS", "run"]

log = logging.getLogger(__name__)

SMALL = "made small"
PANELS = (Panel("write", "bytes a splat"), Panel("read", "image error"), Panel(SMALL, "PSNR dB", "bytes"))
RUNGS = ("64k", "32k", "16k", "8k", "4k", "2k", "1k")
"""Settings of ``nsvq compress`` with codebooks that are measured; in a quick run the last one."""
PALETTES = (65536, 16384, 4096)
"""Rows of the palette of our ``.sog``."""


def run(scope: Scope) -> Iterator[Measurement]:
    """Time writing and reading with every number of threads, and each way to a small file once."""
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
        for workload in workloads(scope):
            yield from _file_rows(workload, scope, Path(folder))
            if scope.photos is not None and scope.init_from is None:
                log.warning("codec: nothing made small: that takes a trained scene, --init-from scene.ply")
                continue
            with use_threads(max(scope.threads)):
                yield from _small_rows(workload, scope, Path(folder))


def _file_rows(workload: Workload, scope: Scope, folder: Path) -> Iterator[Measurement]:
    count, cases, values = len(workload.splats.means), list[Case](), dict[str, Mapping[str, float]]()
    with use_threads(max(scope.threads)):
        # Codebooks of one step of k-means: sizes and times do not depend on how good they are.
        quantizers = {name: as_quantizer(a.quantizer) for name, a in prepare(workload.splats, scope.codebooks).items()}
        scene = to_compressed(workload.splats, quantizers)
        writers: dict[str, Callable[[Path], int]] = {".ply": partial(save, workload.splats)}
        writers |= {f".nsvq {level}": partial(save, scene, storage=Storage(level)) for level in LEVELS}
        images = {".ply": _image(workload, workload.splats), ".nsvq": _image(workload, scene.decode())}
        for name, write in writers.items():
            suffix = name.partition(" ")[0]
            path = folder / f"scene{len(cases)}{suffix}"
            size = write(path)
            error = float((_image(workload, load(path)) - images[suffix]).abs().mean())
            values[name] = {"bytes a splat": size / count, "bytes": float(size), "image error": error}
            cases += [Case(f"{name} write", partial(write, path)), Case(f"{name} read", partial(load, path))]
    for threads in scope.threads:
        for key, timing in measure(cases, scope, threads).items():
            name, _, operation = key.rpartition(" ")
            found = {**values[name], "splats a second": 1000 * count / timing.median}
            described = f"{workload.name}, {scope.codebooks} codebooks"
            yield Measurement("codec", described, name, operation, threads, timing, found)


@torch.no_grad()
def _image(workload: Workload, splats: SplatTensors) -> Tensor:
    """The workload's view of some splats ``[H, W, 3]``."""
    return render(splats, workload.camera, background=workload.background).image


def _small_rows(workload: Workload, scope: Scope, folder: Path) -> Iterator[Measurement]:
    plain, cameras = CompressedScene.from_splats(workload.splats), [workload.camera]
    images = pictures(workload.splats, cameras)
    if scope.photos is not None:
        scene = load_scene(scope.photos, masks=None)
        cameras = [scene.cameras[index] for index in scene.test]
        images = [eight_bit(scene.view(index).image) for index in scene.test]

    @torch.no_grad()
    def psnr(found: SplatTensors) -> float:
        pairs = zip(pictures(found, cameras), images, strict=True)
        return fmean(decibels(float((a - b).double().square().mean().sqrt())) for a, b in pairs)

    original, product = psnr(workload.splats), sgemm()
    for method, (suffix, write) in _ways(plain, scope).items():
        path = folder / f"small{suffix}"
        timing = Timing((milliseconds(Case(method, partial(write, path))),), (milliseconds(product),))
        size = path.stat().st_size
        values = {"PSNR dB": psnr(load(path)), "bytes": float(size), "bits a splat": 8 * size / len(plain)}
        if isfinite(original):
            values["dB lost"] = original - values["PSNR dB"]
        described = f"{workload.name}, {len(plain):,} splats"
        yield Measurement("codec", described, method, SMALL, max(scope.threads), timing, values)


def _ways(plain: CompressedScene, scope: Scope) -> dict[str, tuple[str, Callable[[Path], object]]]:
    """Ways to a file: its suffix, and what writes it; from the most exact to the smallest in each curve."""
    views, tuning = (2, 2) if scope.quick else (VIEWS, DEFAULT_TUNING)
    rungs = [PLAIN, *(rung for rung in LADDER if rung.name in (RUNGS[-1:] if scope.quick else RUNGS))]
    palettes = PALETTES[-1:] if scope.quick else PALETTES
    others = {f"{path.suffix} of another program: {path.name}": path for path in scope.beside}
    return {
        **{f"nsvq compress: {r.name}": (".nsvq", partial(_compress, plain, r, views, tuning)) for r in rungs},
        **{f".sog: palette {rows}": (".sog", partial(save, plain, palette=rows)) for rows in palettes},
        ".spz: version 3": (".spz", partial(save, plain)),
        **{name: (path.suffix, partial(_put, path.read_bytes())) for name, path in others.items()},
    }


def _compress(plain: CompressedScene, rung: Rung, views: int, tuning: int, path: Path) -> None:
    """What ``nsvq compress`` does without photos, the search for views included."""
    cameras = views_of(plain.decode(), None, views)
    _put(Compressor(plain, cameras, Storage(), tuning=tuning).at(rung).data, path)


def _put(data: bytes, path: Path) -> None:
    with atomic_write(path) as file:
        file.write(data)
