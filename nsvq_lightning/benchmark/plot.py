"""Pictures of error against milliseconds."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.benchmark.row import Row
from nsvq_lightning.io.atomic import atomic_write

__all__ = ["draw_suite"]

MARKERS = "os^Dvph*X<>"


def draw_suite(path: Path, rows: Sequence[Row]) -> None:
    """Draw one suite: a panel for each operation, a colour for each method, a marker for each workload.

    The time is logarithmic; so is the error, with a linear strip at the bottom where one is 0. Whiskers are the
    quartiles of the time. Markers are filled for the largest number of threads.

    Args:
        path: PNG file, replaced atomically.
        rows: Rows of one suite, each with at least one value; the first is drawn.

    Raises:
        ValueError: There is no row with a value.
    """
    rows = [row for row in rows if row.values]
    if not rows:
        raise ValueError(f"cannot draw {path}: no row has a value to draw against the time")
    # Drawn without pyplot, which keeps global state and may look for a display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    operations = list(dict.fromkeys(row.operation for row in rows))
    lines = max(len(_distinct(rows, "method")), len(_distinct(rows, "workload")))
    figure = Figure(figsize=(1.0 + 6.0 * len(operations), 4.2 + 0.17 * lines), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(operations), squeeze=False)[0]
    for panel, operation in zip(panels, operations, strict=True):
        _draw_panel(panel, [row for row in rows if row.operation == operation])
        panel.set_title(f"{rows[0].suite}: {operation}", fontsize="medium")
    picture = io.BytesIO()
    canvas.print_figure(picture, format="png", bbox_inches="tight")
    with atomic_write(path) as file:
        file.write(picture.getvalue())


def _draw_panel(panel: Any, rows: Sequence[Row]) -> None:
    methods, workloads = _distinct(rows, "method"), _distinct(rows, "workload")
    colours = {method: f"C{index % 10}" for index, method in enumerate(methods)}
    markers = {workload: MARKERS[index % len(MARKERS)] for index, workload in enumerate(workloads)}
    most = max(row.threads for row in rows)
    for row in rows:
        median, (first, third) = row.timing.median, row.timing.quartiles
        colour = colours[row.method]
        # The median lies between the quartiles up to rounding; a whisker must not be negative.
        whiskers = [[max(0.0, median - first)], [max(0.0, third - median)]]
        face = colour if row.threads == most else "none"
        style = {"fmt": markers[row.workload], "color": colour, "markerfacecolor": face, "elinewidth": 0.8}
        panel.errorbar([median], [_drawn(row)], xerr=whiskers, **style)
    positive = [_drawn(row) for row in rows if _drawn(row) > 0]
    smallest, largest = min(positive, default=1.0) / 3, 3 * max(positive, default=1.0)
    panel.set_xscale("log")
    panel.set_xlim(*_decades([time for row in rows for time in row.timing.quartiles]))
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter("")
    if len(positive) == len(rows):
        panel.set_yscale("log")
        panel.set_ylim(smallest, largest)
    else:
        panel.set_yscale("symlog", linthresh=smallest, linscale=0.5)
        panel.set_ylim(-smallest / 3, largest)
    panel.set(xlabel="ms", ylabel=next(iter(rows[0].values)))
    panel.grid(alpha=0.3, which="major")
    keys = {"fontsize": 7, "frameon": False, "bbox_transform": panel.transAxes}
    by_colour = [panel.plot([], [], "s", color=colours[method], label=method)[0] for method in methods]
    by_marker = [panel.plot([], [], markers[name], color="0.4", label=name)[0] for name in workloads]
    first_key = panel.legend(handles=by_colour, loc="upper left", bbox_to_anchor=(0.0, -0.12), **keys)
    panel.add_artist(first_key).set_clip_on(False)  # or the picture would be cut off below the second one
    panel.legend(handles=by_marker, loc="upper left", bbox_to_anchor=(0.35, -0.12), **keys)


def _decades(times: Sequence[float]) -> tuple[float, float]:
    """Limits at whole powers of ten, so that a logarithmic axis has two numbers at least."""
    low, high = (math.log10(max(time, 1e-6)) for time in (min(times), max(times)))
    return 10.0 ** math.floor(low), 10.0 ** max(math.ceil(high), math.floor(low) + 1)


def _distinct(rows: Sequence[Row], field: str) -> list[str]:
    return list(dict.fromkeys(str(getattr(row, field)) for row in rows))


def _drawn(row: Row) -> float:
    return next(iter(row.values.values()))
