"""A trained scene made small without photos: bytes against quality, beside the formats of viewers and other files."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.measurement import Measurement, Timing
from nsvq_lightning.commands.benchmark.scope import Scope
from nsvq_lightning.commands.benchmark.suite_list import Unavailable
from nsvq_lightning.commands.benchmark.timing import Case, milliseconds, sgemm, use_threads
from nsvq_lightning.commands.benchmark.workloads import workloads
from nsvq_lightning.commands.compress import DEFAULT_TUNING, VIEWS
from nsvq_lightning.compression.ladder import LADDER, PLAIN, Compressor, Rung
from nsvq_lightning.compression.viewpoints import decibels, pictures, views_of
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io.atomic import atomic_write
from nsvq_lightning.io.formats import load, save
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.splats.arrays import SplatArrays
from nsvq_lightning.splats.splats import SplatTensors

__all__ = ["run"]

RUNGS = ("64k", "32k", "16k", "8k", "4k", "2k", "1k")
"""Settings with codebooks that are measured."""
PALETTES = (65536, 16384, 4096)
"""Rows of the palette of our ``.sog``."""


class Truth(NamedTuple):
    """What files are measured against.

    Attributes:
        name: Of the scene.
        splats: The trained scene.
        cameras: Views to measure in.
        images: What they should show ``[H, W, 3]``: test photos, or the pictures of the scene itself.
    """

    name: str
    splats: SplatArrays
    cameras: Sequence[Camera]
    images: Sequence[Tensor]


class Made(NamedTuple):
    """A way to a file.

    Attributes:
        curve: What files of its kind are called.
        setting: Which point of the curve it is.
        suffix: Of the file.
        write: Writes it to a path.
    """

    curve: str
    setting: str
    suffix: str
    write: Callable[[Path], object]


def run(scope: Scope) -> list[Measurement]:
    """Write the scene in every way, and measure bytes, seconds and quality.

    Raises:
        Unavailable: A COLMAP folder is given without a trained scene (``--init-from``).
    """
    if scope.photos is not None and scope.init_from is None:
        raise Unavailable("compress needs a trained scene for the photos: --init-from scene.ply")
    with use_threads(max(scope.threads)), tempfile.TemporaryDirectory(prefix="nsvq-benchmark-") as folder:
        return [row for truth in _truths(scope) for row in _rows(truth, scope, Path(folder))]


def _truths(scope: Scope) -> Iterator[Truth]:
    if scope.photos is not None and scope.init_from is not None:
        scene, splats = load_scene(scope.photos, masks=None), SplatArrays.from_splats(load(scope.init_from))
        images = [eight_bit(scene.view(index).image) for index in scene.test]
        yield Truth(scope.photos.name, splats, [scene.cameras[index] for index in scene.test], images)
        return
    for workload in workloads(scope):
        cameras = [workload.camera]
        yield Truth(
            workload.name, SplatArrays.from_splats(workload.splats), cameras, pictures(workload.splats, cameras)
        )


def _rows(truth: Truth, scope: Scope, folder: Path) -> Iterator[Measurement]:
    name = f"{truth.name}, {len(truth.splats):,} splats"
    original = _quality(truth, truth.splats.to_splats())
    product = sgemm("cpu")
    for made in (*_ours(truth, scope), *(_of_others(path) for path in scope.beside)):
        path = folder / f"scene{made.suffix}"
        timing = Timing((milliseconds(Case(made.setting, partial(made.write, path))),), (milliseconds(product),))
        size = path.stat().st_size
        values = {
            "PSNR dB": _quality(truth, load(path)),
            "bytes": float(size),
            "bits a splat": 8 * size / len(truth.splats),
        }
        if isfinite(original):
            values["dB lost"] = original - values["PSNR dB"]
        method = f"{made.curve}: {made.setting}"
        yield Measurement("compress", name, method, "bytes and quality", max(scope.threads), timing, values)


def _ours(truth: Truth, scope: Scope) -> Iterator[Made]:
    """Our files, from the most exact to the smallest in each curve."""
    plain = truth.splats.to_splats()
    rungs = [PLAIN, *(rung for rung in LADDER if rung.name in (RUNGS[-1:] if scope.quick else RUNGS))]
    count, steps = (2, 2) if scope.quick else (VIEWS, DEFAULT_TUNING)
    for curve, tuning in (("nsvq compress", steps), ("nsvq compress --tune 0", 0)):
        yield from (Made(curve, rung.name, ".nsvq", partial(_compress, truth, rung, count, tuning)) for rung in rungs)
    for rows in PALETTES[-1:] if scope.quick else PALETTES:
        yield Made("nsvq convert to .sog", f"palette {rows}", ".sog", partial(save, plain, palette=rows))
    yield Made("nsvq convert to .spz", "version 3", ".spz", partial(save, plain))


def _compress(truth: Truth, rung: Rung, count: int, tuning: int, path: Path) -> None:
    """What ``nsvq compress`` does without photos, the search for views included."""
    cameras = views_of(truth.splats.to_splats(), None, count)
    _put(Compressor(truth.splats, cameras, Storage(), tuning=tuning).at(rung).data, path)


def _of_others(path: Path) -> Made:
    return Made(f"{path.suffix} of another program", path.name, path.suffix, partial(_put, path.read_bytes()))


def _put(data: bytes, path: Path) -> None:
    with atomic_write(path) as file:
        file.write(data)


@torch.no_grad()
def _quality(truth: Truth, splats: SplatTensors) -> float:
    """Mean PSNR of the views, dB."""
    pairs = zip(pictures(splats, truth.cameras), truth.images, strict=True)
    return fmean(decibels(float((a - b).double().square().mean().sqrt())) for a, b in pairs)
