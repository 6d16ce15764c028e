"""Estimate of the memory and time that a run will take here."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import torch
from torch import Tensor

from nsvq_lightning.commands.doctor.finding import Finding, good, note
from nsvq_lightning.commands.doctor.machine import available_memory, readable_bytes
from nsvq_lightning.data.scene import Scene
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import Splats

__all__ = ["check_budget", "grown"]

SPLATS = 150_000
"""Number of splats that scenes of some tens of photos grow to in a run of a tenth of the paper's length."""
RENDERS_A_STEP = 2.0
"""Ratio of a training step's time to that of rendering forward and backward; the rest is loss, optimiser, codebooks."""
SHORT, FULL = 4500, 45_000
"""Iterations of a tenth of the paper's run, and of the whole run."""
BYTES_A_SPLAT = 59 * 4 * 6
"""Bytes per splat: 59 float32, each with gradient, two moments, and copies while quantizing or editing."""
BYTES_A_PIXEL = 100
"""Bytes per pixel: buffers of the renderer, the loss and the picture itself."""
BASE = 1.2e9
"""Bytes for Python, torch, Lightning and compiled kernels."""
CACHE = 4 << 30
"""Default of ``--data.cache_bytes``."""
REPEATS = 3


def check_budget(scene: Scene) -> Iterator[Finding]:
    """Memory against what is available; time from a measured render of the scene grown to a usual size."""
    pixels = max(camera.width * camera.height for camera in scene.cameras)
    photos = sum(source.nbytes for source in scene.images.sources)
    needed = BASE + min(photos, CACHE) + BYTES_A_SPLAT * SPLATS + BYTES_A_PIXEL * pixels
    free = available_memory()
    text = f"about {readable_bytes(needed)} with {SPLATS:,} splats and {readable_bytes(min(photos, CACHE))} of photos"
    if photos > CACHE:
        text += f" (all would take {readable_bytes(photos)}; the others are decoded each time)"
    if free is not None and needed > free:
        help_ = "lower --data.max_width or --data.cache_bytes"
        yield note("run memory", f"{text}, {readable_bytes(free)} are available: {help_}", bytes=needed)
    else:
        yield good("run memory", text, bytes=needed)
    step = RENDERS_A_STEP * _render_seconds(scene)
    text = f"about {_duration(SHORT * step)} for {SHORT:,} steps, {_duration(FULL * step)} for the paper's {FULL:,}"
    yield good("run time", f"{text}, with {SPLATS:,} splats and the machine as busy as now", step_seconds=step)


def grown(scene: Scene, count: int) -> Splats:
    """The scene's points as splats, repeated with small shifts until there are ``count``, and shrunk to match."""
    start = Splats.from_points(scene.points, scene.colors)
    copies = -(-count // len(start))
    draw = generator(0, 0, "doctor")
    rows = torch.arange(len(start)).repeat(copies)[: max(count, len(start))]
    tensors: dict[str, Tensor] = {name: value.detach()[rows] for name, value in start.attributes().items()}
    tensors["means"] = tensors["means"] + tensors["scales"].exp() * torch.randn(len(rows), 3, generator=draw)
    # More splats cover the surfaces with smaller ones, and trained splats are smaller than the gaps between points.
    tensors["scales"] = tensors["scales"] - math.log(copies) / 2 - 1
    tensors["opacities"] = torch.randn(len(rows), generator=draw)
    return Splats.from_tensors(**tensors)


def _render_seconds(scene: Scene) -> float:
    """Median over views of the shortest time to render forward and backward."""
    splats = grown(scene, SPLATS)
    chosen = [scene.train[i * len(scene.train) // REPEATS] for i in range(REPEATS)]
    times = [min(_seconds(splats, scene, view) for _ in range(REPEATS)) for view in chosen]
    return sorted(times)[len(times) // 2]


def _seconds(splats: Splats, scene: Scene, view: int) -> float:
    began = time.perf_counter()
    render(splats, scene.cameras[view]).image.mean().backward()  # type: ignore[no-untyped-call]
    return time.perf_counter() - began


def _duration(seconds: float) -> str:
    if seconds < 3600:
        return f"{max(1, round(seconds / 60))} min"
    return f"{seconds / 3600:.1f} h"
