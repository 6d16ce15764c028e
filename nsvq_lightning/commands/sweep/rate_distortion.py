"""The picture of a sweep: quality over the size of the file, and over the time of training."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.sweep.results import Group, RunResult, grouped, series_of
from nsvq_lightning.report.figures import colours_of, draw_keys, markers_of, panels, write_figure

__all__ = ["draw_sweep"]

PANEL_HEIGHT = 4.6
"""Inches."""
BELOW = 2.0
"""The picture over the time starts this many dB below the worst run: what comes before is steep and the same for
all."""
WIDE = 4.0
"""Ratio of the longest to the shortest training from which on the time is drawn in logarithms."""


def draw_sweep(path: Path, rows: Sequence[RunResult]) -> None:
    """Draw PSNR over file size, and beside it over training time: a row and a marker for each scene.

    The colour tells quantizers or configurations apart. Over the size, a point is the mean over the seeds, its whiskers
    the standard deviation; lines join the codebook sizes. Runs without codebooks, whose files are many times as large,
    are dashed lines that say their size. Over the time, a line is the test PSNR of a run while it trains, and the point
    at its end that of the decoded file.

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
    figure, axes = panels(2 * len(markers), PANEL_HEIGHT, max(len(colours), len(markers)))
    for (scene, marker), over_size, over_time in zip(markers.items(), axes[::2], axes[1::2], strict=True):
        shown = [row for row in rows if row.scene == scene]
        curves: dict[str, list[Group]] = {}
        for group in grouped(shown):
            curves.setdefault(series(group.rows[0]), []).append(group)
        _draw_scene(over_size, {name: (groups, colours[name]) for name, groups in curves.items()}, marker)
        over_size.set_title(scene, fontsize="medium")
        _draw_times(over_time, [(row, colours[series(row)]) for row in shown], marker)
    draw_keys(figure, colours, markers)
    write_figure(path, figure)


def _draw_scene(axis: Any, curves: dict[str, tuple[list[Group], Any]], marker: str) -> None:
    """The curves of one scene, each with its colour."""
    are_points = not any(group.rows[0].codebooks for groups, _ in curves.values() for group in groups)
    labelled: set[tuple[str, ...]] = set()
    for groups, colour in curves.values():
        points = [group for group in groups if group.rows[0].codebooks or are_points]
        _draw_curve(axis, points, colour, marker)
        sizes = tuple(group.rows[0].codebooks for group in points)
        if sizes not in labelled:
            _label_sizes(axis, points, colour)
            labelled.add(sizes)
        for group in groups:
            if group not in points:
                _draw_level(axis, group, colour)
    axis.margins(0.08)
    axis.grid(alpha=0.3)
    axis.set(xlabel="size of the file, MB", ylabel="test PSNR of the decoded file, dB")


def _draw_curve(axis: Any, groups: Sequence[Group], colour: Any, marker: str) -> None:
    groups = sorted(groups, key=lambda group: group.mean("bytes") or 0.0)
    x, y = [group.mean("bytes", 1e-6) for group in groups], [group.mean("psnr") for group in groups]
    x_spread, y_spread = [group.spread("bytes", 1e-6) for group in groups], [group.spread("psnr") for group in groups]
    style = {"color": colour, "linewidth": 1, "elinewidth": 0.8, "capsize": 2, "markersize": 5}
    axis.errorbar(x, y, xerr=x_spread, yerr=y_spread, fmt=f"{marker}-", **style)


def _label_sizes(axis: Any, groups: Sequence[Group], colour: Any) -> None:
    for group in groups:
        place = group.mean("bytes", 1e-6), group.mean("psnr")
        text = group.rows[0].codebooks
        axis.annotate(text, place, (4, 5), textcoords="offset points", fontsize=7, color=colour)


def _draw_level(axis: Any, group: Group, colour: Any) -> None:
    """A line at the PSNR of runs that would be far outside the picture, with their size."""
    psnr = group.mean("psnr")
    axis.axhline(psnr, color=colour, linestyle="--", linewidth=1)
    text = f"{group.mean('bytes', 1e-6):.3g} MB"
    place = {"xy": (0, psnr), "xycoords": ("axes fraction", "data"), "xytext": (3, 3), "textcoords": "offset points"}
    axis.annotate(text, **place, fontsize=7, color=colour)


def _draw_times(axis: Any, rows: Sequence[tuple[RunResult, Any]], marker: str) -> None:
    """Test PSNR over the minutes of training, a line for each run."""
    times = [row.seconds / 60 for row, _ in rows if row.seconds]
    for row, colour in rows:
        points = _curve(row.folder / "curve.csv")
        axis.plot(*points, color=colour, linewidth=1)
        if row.seconds:
            axis.plot([row.seconds / 60], [row.psnr], marker, color=colour, markersize=5)
    axis.set_ylim(bottom=min(row.psnr or 0.0 for row, _ in rows) - BELOW)
    axis.grid(alpha=0.3)
    axis.set(xlabel="training, minutes", ylabel="test PSNR, dB")
    if times and max(times) > WIDE * min(times):
        axis.set_xscale("log")
        axis.set_xlim(left=0.2 * min(times))
        axis.xaxis.set_major_formatter("{x:g}")


def _curve(path: Path) -> tuple[list[float], list[float]]:
    """Minutes and test PSNR of a run's evaluations; none where the run left no curve."""
    if not path.is_file():
        return [], []
    with path.open(encoding="utf-8", newline="") as file:
        points = [(float(row["seconds"]) / 60, float(row["psnr"])) for row in csv.DictReader(file)]
    return [minutes for minutes, _ in points], [psnr for _, psnr in points]
