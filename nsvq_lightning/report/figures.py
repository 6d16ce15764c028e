"""Matplotlib figures without pyplot, and legends for plots with a colour and a marker for each point."""

import csv
import io
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nsvq_lightning.io.atomic import atomic_write, write_text


def new_figure(width: float, height: float) -> Any:
    """An empty figure, size in inches; pyplot is not used, as it keeps global state and may look for a display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def figure_png(figure: Any) -> bytes:
    """A figure as a PNG file, cropped to its content."""
    data = io.BytesIO()
    figure.savefig(data, format="png", bbox_inches="tight")
    return data.getvalue()


def write_figure(path: Path, figure: Any) -> None:
    """Write a figure as PNG, atomically."""
    with atomic_write(path) as file:
        file.write(figure_png(figure))


def colours_of(names: Sequence[str]) -> dict[str, Any]:
    """A colour for each name."""
    from matplotlib import colormaps

    palette = colormaps["tab10" if len(names) <= 10 else "tab20"]
    return {name: palette(index % palette.N) for index, name in enumerate(names)}


def markers_of(names: Sequence[str]) -> dict[str, str]:
    """A marker for each name."""
    return dict(zip(names, itertools.cycle("os^Dvph*X<>"), strict=False))  # distinguishable in print


def draw_keys(figure: Any, colours: Mapping[str, Any], markers: Mapping[str, str], hollow: str | None = None) -> None:
    """Draw legends below a figure for its colours, markers and, if any, hollow markers."""
    from matplotlib.lines import Line2D

    def handle(marker: str, colour: Any, label: str, face: Any = None) -> Any:
        return Line2D([], [], marker=marker, linestyle="", color=colour, markerfacecolor=face, label=label)

    by_colour = [handle("s", colour, name) for name, colour in colours.items()]
    by_marker = [handle(marker, "0.4", name) for name, marker in markers.items()]
    if hollow is not None:
        by_marker.append(handle("o", "0.4", hollow, "none"))
    figure.legend(handles=by_colour, loc="outside lower left", fontsize=8, frameon=False)
    figure.legend(handles=by_marker, loc="outside lower right", fontsize=8, frameon=False)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the same keys as CSV, atomically; the keys of the first row, in order, are the header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[str]) -> str:
    """A Markdown table that also reads well as plain text; columns named in ``words`` align left, numbers right."""
    lines = [list(head), *map(list, rows)]
    widths = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    left = [name in words for name in head]
    rule = ["-" * width if word else "-" * (width - 1) + ":" for word, width in zip(left, widths, strict=True)]
    padded = [
        [cell.ljust(width) if word else cell.rjust(width) for word, cell, width in zip(left, line, widths, strict=True)]
        for line in lines
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in [padded[0], rule, *padded[1:]])


def panels(count: int, height: float, keys: int = 0) -> tuple[Any, list[Any]]:
    """A figure and its axes.

    Args:
        count: Number of panels, at least 1.
        height: Of a panel, inches.
        keys: Lines of the keys that :func:`~nsvq_lightning.report.figures.draw_keys` will draw below.
    """
    across = min(2, count)
    down = -(-count // across)
    figure = new_figure(6.4 * across, height * down + 0.19 * keys)  # inches of a panel, and of a line of the keys
    axes = list(figure.subplots(down, across, squeeze=False).ravel())
    for axis in axes[count:]:
        axis.set_axis_off()
    return figure, axes[:count]
