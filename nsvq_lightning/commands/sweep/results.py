"""The results of a sweep: a row for each run, means over the seeds, and the picture of quality over size and time."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.report import files
from nsvq_lightning.version import __version__

Row = dict[str, Any]


def row_of(names: Row, folder: Path, error: str = "") -> Row:
    """What a run with these names came to that has finished, or failed with an error.

    Returns:
        Scene, config, quantizer, codebooks, seed, steps; PSNR (dB; None where infinite) and SSIM of the decoded file on
        the test views, its bytes and splats; its bytes at level ``paper``, and the PSNR of the scene before it was
        stored, which is that of level ``paper``; the seconds of training; the PSNR of the plain splats at the end of
        the prune phase, None without codebooks; the version of the package that trained it; folder; error. What is not
        known, as in a failed run, is None.
    """
    metrics = {} if error else json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return {
        **names,
        "psnr": metrics.get("psnr"),
        "ssim": metrics.get("ssim"),
        "bytes": metrics.get("file_bytes"),
        "splats": metrics.get("num_splats"),
        "bytes_paper": metrics.get("paper_level", {}).get("file_bytes"),
        "psnr_paper": metrics.get("phases", [{}])[-1].get("psnr"),
        "seconds": metrics.get("train_seconds"),
        "psnr_before": (metrics.get("before_quantization") or {}).get("psnr"),
        "version": None if error else __version__,
        "folder": folder,
        "error": error,
    }


def write_results(output: Path, rows: Sequence[Row]) -> None:
    """Write ``results.csv``, ``results.md`` and ``results.png``; nothing without rows."""
    if rows:
        files.write_csv(output / "results.csv", rows)
        write_text(output / "results.md", as_markdown(rows))
        draw_sweep(output / "results.png", rows)


# Columns that say which runs a line of the table is about: they differ in the seed alone.
NAMES = ("scene", "config", "quantizer", "codebooks")


def grouped(rows: Sequence[Row]) -> list[list[Row]]:
    """The runs that have not failed, with those that differ in the seed alone together, in the order of the first."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        if not row["error"]:
            groups.setdefault(tuple(row[name] for name in NAMES), []).append(row)
    return list(groups.values())


def moments(rows: Sequence[Row], column: str, scale: float = 1.0) -> tuple[float, float]:
    """Mean and standard deviation (n - 1; 0 for a single run) of a column, times ``scale``; NaN where none knows it."""
    values = [scale * row[column] for row in rows if row[column] is not None]
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return float(np.mean(values)) if values else np.nan, spread


def series_of(rows: Sequence[Row]) -> list[str]:
    """Name of each run's curve: its quantizer, and its configuration, too, where more than the sizes differ."""
    names = [row["quantizer"] or "not quantized" for row in rows]
    places = {(name, row["scene"], row["codebooks"], row["seed"]) for name, row in zip(names, rows, strict=True)}
    if len(places) < len(rows):
        names = [f"{row['config']}, {name}" for name, row in zip(names, rows, strict=True)]
    return names


def as_markdown(rows: Sequence[Row]) -> str:
    """A table of the means over the seeds, with their standard deviation, and a list of what has failed."""
    table = {
        "PSNR, dB": ("psnr", 1.0, ".2f"),
        "SSIM": ("ssim", 1.0, ".4f"),
        "MB": ("bytes", 1e-6, ".3f"),
        "splats": ("splats", 1.0, ",.0f"),
        "PSNR before, dB": ("psnr_before", 1.0, ".2f"),
        "seconds": ("seconds", 1.0, ",.0f"),
    }
    lines = []
    for group in grouped(rows):
        line = [*(group[0][name] or "–" for name in NAMES), str(len(group))]
        for column, scale, form in table.values():
            mean, spread = moments(group, column, scale)
            plus_minus = f" ± {spread:{form}}" if len(group) > 1 else ""
            line.append("–" if np.isnan(mean) else f"{mean:{form}}{plus_minus}")
        lines.append(line)
    parts = ["# nsvq sweep"]
    if lines:
        parts.append(files.markdown_table([*NAMES, "runs", *table], lines, words=NAMES))
        parts.append(
            "Mean ± standard deviation over the seeds. PSNR and SSIM are those of the decoded file on the test views; "
            "before: of the plain splats."
        )
    failed = ["* {scene}, {config}, {codebooks}, seed {seed}: {error}".format(**row) for row in rows if row["error"]]
    if failed:
        parts += ["Failed:", "\n".join(failed)]
    return "\n\n".join(parts) + "\n"


def draw_sweep(path: Path, rows: Sequence[Row]) -> None:
    """Draw PSNR over file size, and beside it over training time: a row for each scene.

    The colour tells quantizers or configurations apart. Over the size, a point is the mean over the seeds, its whiskers
    the standard deviation; lines join the codebook sizes. Runs without codebooks, whose files are many times as large,
    are dashed lines that say their size. Over the time, a line is the test PSNR of a run while it trains, and the point
    at its end that of the decoded file.

    Args:
        path: PNG file, replaced atomically.
        rows: Runs; those that failed, or whose PSNR is not finite, are left out. Without any, nothing is drawn.
    """
    rows = [row for row in rows if row["psnr"] is not None and row["bytes"] is not None]
    if not rows:
        return
    from matplotlib.lines import Line2D

    rows = [row | {"series": name} for row, name in zip(rows, series_of(rows), strict=True)]
    colours = {name: f"C{index}" for index, name in enumerate(dict.fromkeys(row["series"] for row in rows))}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = files.new_figure(12.8, 4.6 * len(scenes) + 0.19 * len(colours))  # inches; a line of the legend
    for scene, (over_size, over_time) in zip(scenes, figure.subplots(len(scenes), 2, squeeze=False), strict=True):
        shown = [row for row in rows if row["scene"] == scene]
        _draw_sizes(over_size, shown, colours)
        over_size.set(title=scene, xlabel="size of the file, MB", ylabel="test PSNR of the decoded file, dB")
        _draw_times(over_time, shown, colours)
        over_time.set(xlabel="training, minutes", ylabel="test PSNR, dB")
        for axis in (over_size, over_time):
            axis.grid(alpha=0.3)
    keys = [Line2D([], [], marker="o", linestyle="", color=colour, label=name) for name, colour in colours.items()]
    figure.legend(handles=keys, loc="outside lower left", fontsize=8, frameon=False)
    files.write_figure(path, figure)


def _draw_sizes(axis: Any, rows: Sequence[Row], colours: dict[str, str]) -> None:
    """Test PSNR over the size of the file, a line for each series."""
    are_points = not any(row["codebooks"] for row in rows)
    style = {"fmt": "o-", "linewidth": 1, "elinewidth": 0.8, "capsize": 2, "markersize": 5}
    for name, colour in colours.items():
        note = {"textcoords": "offset points", "fontsize": 7, "color": colour}
        groups = grouped([row for row in rows if row["series"] == name])
        points = [group for group in groups if group[0]["codebooks"] or are_points]
        points.sort(key=lambda group: moments(group, "bytes"))
        x, x_spread = np.reshape([moments(group, "bytes", 1e-6) for group in points], (-1, 2)).T
        y, y_spread = np.reshape([moments(group, "psnr") for group in points], (-1, 2)).T
        axis.errorbar(x, y, xerr=x_spread, yerr=y_spread, color=colour, **style)
        for group, *place in zip(points, x, y, strict=True):
            axis.annotate(group[0]["codebooks"], place, (4, 5), **note)
        for group in groups:
            if group not in points:  # as a point, it would be far outside the picture
                psnr, size = moments(group, "psnr")[0], moments(group, "bytes", 1e-6)[0]
                axis.axhline(psnr, color=colour, linestyle="--", linewidth=1)
                axis.annotate(f"{size:.3g} MB", (0, psnr), (3, 3), xycoords=("axes fraction", "data"), **note)


def _draw_times(axis: Any, rows: Sequence[Row], colours: dict[str, str]) -> None:
    """Test PSNR over the minutes of training, a line for each run."""
    for row in rows:
        if (path := row["folder"] / "curve.csv").is_file():
            curve = np.genfromtxt(path, delimiter=",", names=True, encoding="utf-8")
            axis.plot(curve["seconds"] / 60, curve["psnr"], color=colours[row["series"]], linewidth=1)
        axis.plot([row["seconds"] / 60], [row["psnr"]], "o", color=colours[row["series"]], markersize=5)
    # What comes before that is steep and the same for all.
    axis.set_ylim(bottom=min(row["psnr"] for row in rows) - 2.0)
