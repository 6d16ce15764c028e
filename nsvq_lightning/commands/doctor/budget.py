"""Estimate of the memory and time that a run will take here."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import torch
from torch import Tensor

from nsvq_lightning.commands.doctor.finding import Finding, good, note
from nsvq_lightning.compression.budget import splats_for_photos
from nsvq_lightning.data.edges import detailed_pixels
from nsvq_lightning.data.scene import Scene
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.memory_estimate import CACHE_BYTES, available_memory, readable_bytes, run_bytes

__all__ = ["check_budget", "grown"]

FAST, FAST_SPLATS = 4000, 1.3
"""Iterations of ``fast.yaml``, and splats over its iterations, on average, as a multiple of the default for the
photos."""
PAPER, PAPER_SPLATS = 45_000, 4.0
"""The same for the paper's run."""
RENDERS_A_STEP = 2.0
"""Ratio of a training step's time to that of rendering forward and backward; the rest is loss, optimiser, codebooks."""
REPEATS = 3


def check_budget(scene: Scene) -> Iterator[Finding]:
    """Memory against what is available; time from renders of the scene grown as two recipes grow it."""
    default = splats_for_photos(len(scene.train), detailed_pixels(scene))
    fast, paper = (round(factor * default) for factor in (FAST_SPLATS, PAPER_SPLATS))
    photos, needed = scene.images.nbytes, run_bytes(scene, paper)
    free = available_memory()
    text = (
        f"about {readable_bytes(needed)} with {paper:,} splats and {readable_bytes(min(photos, CACHE_BYTES))} of photos"
    )
    if photos > CACHE_BYTES:
        text += f" (all would take {readable_bytes(photos)}; the others are decoded each time)"
    if free is not None and needed > free:
        help_ = "lower --data.max_width or --data.cache_bytes"
        yield note("run memory", f"{text}, {readable_bytes(free)} are available: {help_}", bytes=needed)
    else:
        yield good("run memory", text, bytes=needed)
    step, paper_step = (RENDERS_A_STEP * _render_seconds(scene, count) for count in (fast, paper))
    text = (
        f"about {_duration(FAST * step)} for fast.yaml ({FAST:,} steps, {fast:,} splats on average), "
        f"{_duration(PAPER * paper_step)} for the paper's run ({PAPER:,}, {paper:,}), with the machine as busy as now"
    )
    yield good("run time", text, step_seconds=step, paper_step_seconds=paper_step)


def grown(scene: Scene, count: int) -> Splats:
    """The scene's points as splats, repeated with small shifts until there are ``count``, and shrunk to match."""
    start = Splats.from_points(scene.points, scene.colors)
    copies = -(-count // len(start))
    draw = generator(0, 0, "doctor")
    rows = torch.arange(len(start)).repeat(copies)[: max(count, len(start))]
    tensors: dict[str, Tensor] = {name: value.detach()[rows] for name, value in start.attributes().items()}
    tensors["means"] = tensors["means"] + tensors["scales"].exp() * torch.randn(len(rows), 3, generator=draw)
    # More splats cover the surfaces with smaller ones, and trained ones overlap in many layers. With these two numbers,
    # renders of fox, bonsai and photos of two megapixels take about as long as those of the trained scenes.
    tensors["scales"] = tensors["scales"] - math.log(copies) / 2 + 0.5
    tensors["opacities"] = torch.randn(len(rows), generator=draw) - 0.5
    return Splats.from_tensors(**tensors)


def _render_seconds(scene: Scene, count: int) -> float:
    """Median over views of the shortest time to render ``count`` splats forward and backward."""
    splats = grown(scene, count)
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
