"""Pictures of the results: error against run time, a value over the course of a run, and shares of a step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.suite_list import Suite
from nsvq_lightning.report.figures import colours_of, draw_keys, markers_of, new_figure, write_figure

__all__ = ["draw_suite"]

COLUMNS = 2
PANEL = (6.4, 4.2)
"""Inches across and down."""
LEGEND_LINE = 0.19
SHARE = "share %"


def draw_suite(path: Path, rows: Sequence[Measurement], suite: Suite) -> None:
    """Draw the rows of one suite.

    ``errors``: a panel for each operation and value, a colour for each method, a marker for each workload. The time is
    logarithmic; so is the value, with a linear strip at the bottom where one is 0. Whiskers are the quartiles of the
    time. Markers are filled for the largest number of threads. Rows with a course are lines over seconds instead.

    ``shares``: a panel for each operation, a bar for each method.

    Args:
        path: PNG file, replaced atomically.
        rows: Rows of one suite, of which one has a value at least.
        suite: How it is drawn.

    Raises:
        ValueError: There is no row with a value.
    """
    rows = [row for row in rows if row.values]
    if not rows:
        raise ValueError(f"cannot draw {path}: no row has a value to draw against the time")
    if suite.picture == "shares":
        figure = _figure([(rows, operation, SHARE) for operation in _distinct(rows, "operation")], _draw_bars)
    else:
        panels = _values(rows, suite.drawn)
        operations = {operation for _, operation, _ in panels}
        rows = [row for row in rows if row.operation in operations]
        figure = _figure([(rows, *panel[1:]) for panel in panels], _draw_values)
        _draw_keys(figure, rows)
    write_figure(path, figure)


Panel = tuple[Sequence[Measurement], str, str]
"""All rows, the operation that is drawn, and the value."""


def _values(rows: Sequence[Measurement], drawn: Sequence[str]) -> list[Panel]:
    """The panels: what is to be drawn where the rows of an operation have it, else their first value."""
    panels: list[Panel] = []
    for operation in _distinct(rows, "operation"):
        values = [row.values for row in rows if row.operation == operation]
        wanted = [name for name in drawn if any(name in row for row in values)]
        panels += [(rows, operation, name) for name in (wanted if drawn else [next(iter(values[0]))])]
    return panels or [(rows, rows[0].operation, next(iter(rows[0].values)))]


def _figure(panels: Sequence[Panel], draw: Callable[[Any, Sequence[Measurement], Panel], None]) -> Any:
    across = min(COLUMNS, len(panels))
    down = -(-len(panels) // across)
    rows = panels[0][0]
    keys = max(len(_distinct(rows, "method")), len(_distinct(rows, "workload"))) if draw is _draw_values else 0
    figure = new_figure(PANEL[0] * across, PANEL[1] * down + LEGEND_LINE * keys)
    axes = figure.subplots(down, across, squeeze=False).ravel()
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    for axis, panel in zip(axes, panels, strict=False):
        axis.set_title(f"{rows[0].suite}: {panel[1]}", fontsize="medium")
        draw(axis, [row for row in rows if row.operation == panel[1]], panel)
    return figure


def _styles(rows: Sequence[Measurement]) -> tuple[dict[str, Any], dict[str, str]]:
    """Colour of each method and marker of each workload, the same in all panels."""
    return colours_of(_distinct(rows, "method")), markers_of(_distinct(rows, "workload"))


def _draw_values(axis: Any, rows: Sequence[Measurement], panel: Panel) -> None:
    everything, _, value = panel
    styles = _styles(everything)
    rows = [row for row in rows if value in row.values]
    if any(row.course for row in rows):
        _draw_courses(axis, rows, value, styles)
    else:
        _draw_points(axis, rows, value, styles)
    axis.grid(alpha=0.3, which="major")


def _draw_courses(
    axis: Any, rows: Sequence[Measurement], value: str, styles: tuple[dict[str, Any], dict[str, str]]
) -> None:
    colours, markers = styles
    for row in rows:
        seconds, values = zip(*row.course, strict=True)
        axis.plot(seconds, values, f"{markers[row.workload]}-", color=colours[row.method], markersize=4, linewidth=1)
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.set(xlabel="seconds", ylabel=value)


def _draw_points(
    axis: Any, rows: Sequence[Measurement], value: str, styles: tuple[dict[str, Any], dict[str, str]]
) -> None:
    colours, markers = styles
    most = max(row.threads for row in rows)
    for row in rows:
        median, (first, third) = row.timing.median, row.timing.quartiles
        colour = colours[row.method]
        # The median lies between the quartiles up to rounding; a whisker must not be negative.
        whiskers = [[max(0.0, median - first)], [max(0.0, third - median)]]
        face = colour if row.threads == most else "none"
        style = {"fmt": markers[row.workload], "color": colour, "markerfacecolor": face, "elinewidth": 0.8}
        axis.errorbar([median], [row.values[value]], xerr=whiskers, **style)
    values = [row.values[value] for row in rows]
    low, high = _decades([number for number in values if number > 0] or [1.0])
    axis.set_xscale("log")
    axis.set_xlim(*_decades([time for row in rows for time in row.timing.quartiles]))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter("")
    if min(values) > 0:
        axis.set_yscale("log")
        axis.set_ylim(low, high)
    else:
        axis.set_yscale("symlog", linthresh=low, linscale=0.5)
        axis.set_ylim(-low / 3, high)
    axis.set(xlabel="ms", ylabel=value)


def _draw_keys(figure: Any, rows: Sequence[Measurement]) -> None:
    """What colours, markers and hollow markers mean, below the panels."""
    threads = sorted({row.threads for row in rows})
    hollow = f"hollow: {', '.join(map(str, threads[:-1]))} instead of {threads[-1]} threads"
    draw_keys(figure, *_styles(rows), hollow if len(threads) > 1 else None)


def _draw_bars(axis: Any, rows: Sequence[Measurement], panel: Panel) -> None:
    """One bar a row below the first, which is the whole of them."""
    whole, *parts = rows
    axis.set_title(f"{whole.suite}: {panel[1]}, {whole.timing.median:.3g} ms", fontsize="medium")
    names = [row.method for row in parts]
    shares = [row.values[SHARE] for row in parts]
    axis.barh(names, shares, color="C0")
    axis.invert_yaxis()
    for place, (share, row) in enumerate(zip(shares, parts, strict=True)):
        axis.text(share, place, f" {share:.1f} %, {row.timing.median:.2g} ms", va="center", fontsize=8)
    axis.set_xlim(0, 1.35 * max(shares, default=1.0))
    axis.tick_params(axis="y", labelsize=8)
    axis.set(xlabel="share of the step, %")


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Limits at whole powers of ten, so that a logarithmic axis has two numbers at least."""
    low, high = (math.log10(max(value, 1e-30)) for value in (min(values), max(values)))
    bottom = math.floor(low - 0.05)
    return 10.0**bottom, 10.0 ** max(math.ceil(high + 0.05), bottom + 1)


def _distinct(rows: Sequence[Measurement], field: str) -> list[str]:
    return list(dict.fromkeys(str(getattr(row, field)) for row in rows))
