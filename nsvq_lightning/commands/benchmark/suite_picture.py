"""Pictures of the results: error against run time, a value over the course of a run, and shares of a step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.suite_list import Suite
from nsvq_lightning.commands.panels import panels
from nsvq_lightning.report.figures import colours_of, draw_keys, markers_of, write_figure

__all__ = ["draw_suite"]

PANEL_HEIGHT = 4.2
"""Inches."""


def draw_suite(path: Path, rows: Sequence[Measurement], suite: Suite) -> None:
    """Draw the rows of one suite.

    ``errors``: a panel for each operation and value, a colour for each method, a marker for each workload. The time is
    logarithmic; so is the value, with a linear strip at the bottom where one is 0. Whiskers are the quartiles of the
    time. Markers are filled for the largest number of threads. Rows with a course are lines over seconds instead.

    ``shares``: a panel for each operation, a bar for each method.

    ``growth``: for each operation a panel of milliseconds and one of memory against the first value, all logarithmic. A
    dashed line through the last point is what is proportional to it.

    ``curves``: a panel for each workload, the first value against megabytes, a line for each
    curve, the name of a method up to the colon.

    Args:
        path: PNG file, replaced atomically.
        rows: Those of one suite; at least one has a value.
        suite: How it is drawn.

    Raises:
        ValueError: There is no row with a value.
    """
    rows = [row for row in rows if row.values]
    if not rows:
        raise ValueError(f"cannot draw {path}: no row has a value to draw against the time")
    if suite.picture == "shares":
        operations = _distinct(rows, "operation")
        figure, axes = panels(len(operations), PANEL_HEIGHT)
        for axis, operation in zip(axes, operations, strict=True):
            _draw_bars(axis, [row for row in rows if row.operation == operation])
    elif suite.picture == "growth":
        operations = _distinct(rows, "operation")
        figure, axes = panels(2 * len(operations), PANEL_HEIGHT)
        for place, operation in enumerate(operations):
            _draw_growth(axes[2 * place : 2 * place + 2], [row for row in rows if row.operation == operation])
    elif suite.picture == "curves":
        figure = _draw_curves(rows)
    else:
        figure = _draw_values(rows, suite.drawn)
    write_figure(path, figure)


def _draw_values(rows: Sequence[Measurement], drawn: Sequence[str]) -> Any:
    """A figure with a panel for each operation and value."""
    shown = _values(rows, drawn)
    rows = [row for row in rows if row.operation in dict(shown)]
    styles = colours_of(_distinct(rows, "method")), markers_of(_distinct(rows, "workload"))
    figure, axes = panels(len(shown), PANEL_HEIGHT, max(map(len, styles)))
    for axis, (operation, value) in zip(axes, shown, strict=True):
        chosen = [row for row in rows if row.operation == operation and value in row.values]
        draw = _draw_courses if any(row.course for row in chosen) else _draw_points
        draw(axis, chosen, value, styles)
        axis.set_title(f"{rows[0].suite}: {operation}", fontsize="medium")
        axis.grid(alpha=0.3, which="major")
    threads = sorted({row.threads for row in rows})
    hollow = f"hollow: {', '.join(map(str, threads[:-1]))} instead of {threads[-1]} threads"
    draw_keys(figure, *styles, hollow if len(threads) > 1 else None)
    return figure


def _values(rows: Sequence[Measurement], drawn: Sequence[str]) -> list[tuple[str, str]]:
    """Operations and their values: those that are to be drawn where the rows have them, else the first one."""
    shown: list[tuple[str, str]] = []
    for operation in _distinct(rows, "operation"):
        values = [row.values for row in rows if row.operation == operation]
        wanted = [name for name in drawn if any(name in row for row in values)]
        shown += [(operation, name) for name in (wanted if drawn else [next(iter(values[0]))])]
    return shown or [(rows[0].operation, next(iter(rows[0].values)))]


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


def _draw_bars(axis: Any, rows: Sequence[Measurement]) -> None:
    """One bar a row below the first, which is the whole of them."""
    whole, *parts = rows
    axis.set_title(f"{whole.suite}: {whole.operation}, {whole.timing.median:.3g} ms", fontsize="medium")
    names = [row.method for row in parts]
    shares = [row.values["share %"] for row in parts]
    axis.barh(names, shares, color="C0")
    axis.invert_yaxis()
    for place, (share, row) in enumerate(zip(shares, parts, strict=True)):
        axis.text(share, place, f" {share:.1f} %, {row.timing.median:.2g} ms", va="center", fontsize=8)
    axis.set_xlim(0, 1.35 * max(shares, default=1.0))
    axis.tick_params(axis="y", labelsize=8)
    axis.set(xlabel="share of the step, %")


def _draw_growth(axes: Sequence[Any], rows: Sequence[Measurement]) -> None:
    """Time and memory against the first value, each in a panel."""
    grows = next(iter(rows[0].values))
    sizes = [row.values[grows] for row in rows]
    for axis, name, values in (
        (axes[0], "ms", [row.timing.median for row in rows]),
        (axes[1], "peak MB", [row.values["peak MB"] for row in rows]),
    ):
        axis.plot(sizes, [values[-1] * size / sizes[-1] for size in sizes], "--", color="0.6", label="proportional")
        axis.plot(sizes, values, "o-", color="C0", label="measured")
        axis.set(xscale="log", yscale="log", xlabel=grows, ylabel=name)
        axis.set_ylim(*_decades(values))
        axis.set_title(f"{rows[0].suite}: {rows[0].operation}, {rows[0].workload}", fontsize="medium")
        axis.grid(alpha=0.3, which="major")
        axis.legend(fontsize=8)


def _draw_curves(rows: Sequence[Measurement]) -> Any:
    """A figure with a panel for each workload; the curve is the name of a method up to the colon."""
    curves = list(dict.fromkeys(row.method.partition(":")[0] for row in rows))
    scenes, colours = _distinct(rows, "workload"), colours_of(curves)
    figure, axes = panels(len(scenes), PANEL_HEIGHT, len(colours))
    for axis, scene in zip(axes, scenes, strict=True):
        for curve, colour in colours.items():
            shown = [row.values for row in rows if row.workload == scene and row.method.startswith(f"{curve}:")]
            axis.plot([v["bytes"] / 1e6 for v in shown], [next(iter(v.values())) for v in shown], "o-", color=colour)
        axis.set(xscale="log", xlabel="MB", ylabel=next(iter(rows[0].values)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("{x:g}")
        axis.tick_params(axis="x", which="minor", labelsize=7)
        axis.set_title(scene, fontsize="medium")
        axis.grid(alpha=0.3, which="both")
    draw_keys(figure, colours, {})
    return figure


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Limits at whole powers of ten, so that a logarithmic axis has two numbers at least."""
    low, high = (math.log10(max(value, 1e-30)) for value in (min(values), max(values)))
    bottom = math.floor(low - 0.05)
    return 10.0**bottom, 10.0 ** max(math.ceil(high + 0.05), bottom + 1)


def _distinct(rows: Sequence[Measurement], field: str) -> list[str]:
    return list(dict.fromkeys(str(getattr(row, field)) for row in rows))
