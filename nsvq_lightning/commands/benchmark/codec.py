"""Suite ``codec``: writing and reading scene files, and what a scene loses when it is made small without its photos."""

import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from math import isfinite
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import Scope, quantize, timing
from nsvq_lightning.commands.benchmark.workloads import Workload, workloads
from nsvq_lightning.commands.compress import DEFAULT_TUNING, VIEWS
from nsvq_lightning.compression import ladder
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

log = logging.getLogger(__name__)

SMALL = "made small"


def run(scope: Scope) -> Iterator[timing.Measurement]:
    """Time writing and reading with every number of threads, and each way to a small file once."""
    with tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
        for workload in workloads(scope):
            yield from _file_rows(workload, scope, Path(folder))
            if scope.photos is not None and scope.init_from is None:
                log.warning("codec: nothing made small: that takes a trained scene, --init-from scene.ply")
                continue
            with timing.use_threads(max(scope.threads)):
                yield from _small_rows(workload, scope, Path(folder))


def _file_rows(workload: Workload, scope: Scope, folder: Path) -> Iterator[timing.Measurement]:
    values: dict[str, Mapping[str, float]] = {}
    paths: dict[str, Path] = {}
    with timing.use_threads(max(scope.threads)):
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


def _small_rows(workload: Workload, scope: Scope, folder: Path) -> Iterator[timing.Measurement]:
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

    original, product = psnr(workload.splats), timing.sgemm()
    for method, (suffix, write) in _ways(plain, scope).items():
        path = folder / f"small{suffix}"
        took = timing.Timing((timing.milliseconds(partial(write, path)),), (timing.milliseconds(product),))
        size = path.stat().st_size
        values = {"PSNR dB": psnr(load(path)), "bytes": float(size), "bits a splat": 8 * size / len(plain)}
        if isfinite(original):
            values["dB lost"] = original - values["PSNR dB"]
        described = f"{workload.name}, {len(plain):,} splats"
        yield timing.Measurement(SMALL, described, method, max(scope.threads), took, values)


def _ways(plain: CompressedScene, scope: Scope) -> dict[str, tuple[str, Callable[[Path], object]]]:
    """Ways to a file: its suffix, and what writes it; from the most exact to the smallest in each curve."""
    sizes, palettes = ["64k", "32k", "16k", "8k", "4k", "2k", "1k"], [65536, 16384, 4096]
    if scope.quick:
        del sizes[:-1], palettes[:-1]
    views, tuning = (2, 2) if scope.quick else (VIEWS, DEFAULT_TUNING)

    def compressed(rung: ladder.Rung, path: Path) -> None:
        """What ``nsvq compress`` does without photos, the search for views included."""
        cameras = views_of(plain.decode(), None, views)
        put(ladder.Compressor(plain, cameras, Storage(), tuning=tuning).at(rung).data, path)

    def put(data: bytes, path: Path) -> None:
        with atomic_write(path) as file:
            file.write(data)

    ways: dict[str, tuple[str, Callable[[Path], object]]] = {}
    for rung in (ladder.PLAIN, *(rung for rung in ladder.LADDER if rung.name in sizes)):
        ways[f"nsvq compress: {rung.name}"] = ".nsvq", partial(compressed, rung)
    for rows in palettes:
        ways[f".sog: palette {rows}"] = ".sog", partial(save, plain, palette=rows)
    ways[".spz: version 3"] = ".spz", partial(save, plain)
    for path in scope.beside:
        ways[f"{path.suffix} of another program: {path.name}"] = path.suffix, partial(put, path.read_bytes())
    return ways
