"""Pictures of several panels, two beside each other."""

from __future__ import annotations

from typing import Any

from nsvq_lightning.report.figures import new_figure

__all__ = ["panels"]

COLUMNS = 2
WIDTH = 6.4
"""Inches of a panel."""
KEY_LINE = 0.19
"""Inches of a line of the keys below the panels."""


def panels(count: int, height: float, keys: int = 0) -> tuple[Any, list[Any]]:
    """A figure and its axes.

    Args:
        count: Number of panels, at least 1.
        height: Of a panel, inches.
        keys: Lines of the keys that :func:`~nsvq_lightning.report.figures.draw_keys` will draw below.
    """
    across = min(COLUMNS, count)
    down = -(-count // across)
    figure = new_figure(WIDTH * across, height * down + KEY_LINE * keys)
    axes = list(figure.subplots(down, across, squeeze=False).ravel())
    for axis in axes[count:]:
        axis.set_axis_off()
    return figure, axes[:count]
