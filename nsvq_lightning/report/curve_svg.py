"""The curve of a run as an SVG drawing for a page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from nsvq_lightning.training.schedule import Phase, Schedule

from .files import PHASE_COLOURS

__all__ = ["curve_svg"]

WIDTH, HEIGHT = 800, 340
LEFT, RIGHT, TOP, BOTTOM = 48, 84, 28, 52
"""Pixels around the axes."""
TICKS = 5
"""About how many ticks an axis has."""


def curve_svg(history: Sequence[Mapping[str, Any]], schedule: Schedule) -> str:
    """PSNR and number of splats over the iterations, with phases shaded.

    Args:
        history: The evaluations, at least one.
        schedule: Phases of the run.
    """
    last = max(schedule.total, int(history[-1]["iteration"]))
    finite = [entry["psnr"] for entry in history if math.isfinite(entry["psnr"])] or [0.0]
    low, high = math.floor(min(finite)), math.ceil(max(finite) + 0.1)
    most = 1.05 * max(entry["splats"] for entry in history)

    def x(iteration: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * iteration / last

    def y(share: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * share

    def line(points: Sequence[tuple[float, float]], colour: str) -> str:
        listed = " ".join(f"{x(iteration):.1f},{y(share):.1f}" for iteration, share in points)
        return f'<polyline points="{listed}" fill="none" stroke="var(--{colour})" stroke-width="2"/>'

    def label(at: tuple[float, float], text: str, anchor: str, colour: str = "") -> str:
        style = f' style="fill:var(--{colour})"' if colour else ""
        return f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}"{style}>{text}</text>'

    parts, start = [], 0
    for phase, end in zip(Phase, schedule.ends, strict=True):
        if end > start:
            box = f'x="{x(start):.1f}" y="{TOP}" width="{x(end) - x(start):.1f}" height="{HEIGHT - TOP - BOTTOM}"'
            parts.append(f'<rect {box} fill="{PHASE_COLOURS[phase]}" fill-opacity="0.6"/>')
            parts.append(label(((x(start) + x(end)) / 2, TOP - 8), phase.name.lower(), "middle"))
        start = end
    for value in _ticks(0, last):
        parts.append(label((x(value), HEIGHT - BOTTOM + 20), f"{value:,.0f}", "middle"))
    for value in _ticks(low, high):
        at = y((value - low) / (high - low))
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}" stroke="#8884"/>')
        parts.append(label((LEFT - 6, at + 4), f"{value:g}", "end", "blue"))
    for value in _ticks(0, most):
        parts.append(label((WIDTH - RIGHT + 6, y(value / most) + 4), f"{value:,.0f}", "start", "brown"))
    parts.append(label((LEFT, HEIGHT - 4), "test PSNR, dB", "start", "blue"))
    parts.append(label((WIDTH / 2, HEIGHT - 4), "iteration", "middle"))
    parts.append(label((WIDTH - RIGHT, HEIGHT - 4), "splats", "end", "brown"))
    parts.append(line([(entry["iteration"], entry["splats"] / most) for entry in history], "brown"))
    quality = [(entry["iteration"], (entry["psnr"] - low) / (high - low)) for entry in history]
    quality = [(iteration, share) for iteration, share in quality if math.isfinite(share)]
    parts.append(line(quality, "blue"))
    parts += [f'<circle cx="{x(at):.1f}" cy="{y(share):.1f}" r="3" fill="var(--blue)"/>' for at, share in quality]
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join(parts)}</svg>'


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from ``low`` to ``high``, a step of 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough)
    return [index * step for index in range(math.ceil(low / step), math.floor(high / step) + 1)]
