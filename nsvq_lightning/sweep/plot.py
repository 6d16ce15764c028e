"""The rate–distortion picture of a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.figures import colours_of, draw_keys, markers_of, new_figure, write_figure
from nsvq_lightning.sweep.results import Group, Row, grouped, series_of

__all__ = ["draw_sweep"]

SIZE = (8.0, 5.2)
"""Inches across and down, without the keys."""

LEGEND_LINE = 0.19
WIDE = 8.0
"""Ratio of the largest to the smallest file from which their axis is logarithmic."""


def draw_sweep(path: Path, rows: Sequence[Row]) -> None:
    """Draw PSNR over file size: a colour for each quantizer or configuration, a marker for each scene.

    A point is the mean over the seeds, its whiskers the standard deviation; lines join the codebook sizes of one scene.

    Args:
        path: PNG file, replaced atomically.
        rows: Runs; those that failed, or whose PSNR is not finite, are left out.

    Raises:
        ValueError: There is nothing to draw.
    """
    rows = [row for row in rows if row.psnr is not None and row.bytes is not None]
    if not rows:
        raise ValueError(f"cannot draw {path}: no run has a PSNR")
    series = series_of(rows)
    colours = colours_of(list(dict.fromkeys(map(series, rows))))
    markers = markers_of(list(dict.fromkeys(row.scene for row in rows)))
    figure = new_figure(SIZE[0], SIZE[1] + LEGEND_LINE * max(len(colours), len(markers)))
    axis = figure.add_subplot()
    curves: dict[tuple[str, str], list[Group]] = {}
    for group in grouped(rows):
        curves.setdefault((series(group.rows[0]), group.rows[0].scene), []).append(group)
    for (name, scene), groups in curves.items():
        _draw_curve(axis, groups, colours[name], markers[scene])
    sizes = [row.bytes for row in rows if row.bytes]
    if max(sizes) > WIDE * min(sizes):
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("")
    axis.margins(0.08)
    axis.grid(alpha=0.3)
    axis.set(xlabel="size of the file, MB", ylabel="test PSNR of the decoded file, dB")
    draw_keys(figure, colours, markers)
    write_figure(path, figure)


def _draw_curve(axis: Any, groups: Sequence[Group], colour: Any, marker: str) -> None:
    groups = sorted(groups, key=lambda group: group.mean("bytes") or 0.0)
    x, y = [group.mean("bytes", 1e-6) for group in groups], [group.mean("psnr") for group in groups]
    whiskers = {
        "xerr": [group.spread("bytes", 1e-6) for group in groups],
        "yerr": [group.spread("psnr") for group in groups],
    }
    axis.errorbar(x, y, **whiskers, fmt=f"{marker}-", color=colour, linewidth=1, elinewidth=0.8, capsize=2)
    for place, group in zip(zip(x, y, strict=True), groups, strict=True):
        label = group.rows[0].codebooks
        axis.annotate(label, place, (5, -9), textcoords="offset points", fontsize=7, color=colour)
