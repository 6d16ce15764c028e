"""``report.html``: what a run has come to, on one page that needs no other file."""

import math
import platform
from collections.abc import Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import torch

from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.report.numbers import Rows, Values
from nsvq_lightning.report.viewer import data_address, fill, script_json
from nsvq_lightning.splats.conventions import Uint8s
from nsvq_lightning.training.schedule import Phase, Schedule
from nsvq_lightning.version import __version__

# The file of the page.
NAME = "report.html"


def write_page(
    folder: Path, history: Rows, schedule: Schedule, metrics: Values | None = None, views: Rows = ()
) -> Path:
    """Write the page of a run, atomically; without ``metrics``, browsers read it again every few seconds.

    Args:
        folder: Folder of the run, where the page goes; ``config.yaml``, ``preview.png`` and ``renders/`` in it are
            shown where they are.
        history: The evaluations so far.
        schedule: Phases of the run.
        metrics: The content of ``metrics.json``, see :func:`nsvq_lightning.report.numbers.summarize`; None before it
            is known.
        views: One row for each test view, as in ``views.csv``, with ``picture``, the name of its file in ``renders/``.

    Returns:
        The file.
    """
    title = escape(f"{folder.resolve().parent.name} / {folder.resolve().name}")
    preview = folder / "preview.png"
    config = folder / "config.yaml"
    viewer = folder / "viewer.html"
    sections = {"Test views": _views(folder, views)}
    if not metrics and preview.exists():
        sections["Photo and render"] = f'<img class="wide" alt="photo and render" src="{_jpeg(_read(preview))}">'
    sections["While it trained"] = _curve(history, schedule) if history else ""
    if metrics:
        sections |= {"Bytes": _streams(metrics), "Codes": _codes(metrics)}
    sections["Time"] = _times(history)
    if config.exists():
        text = escape(config.read_text(encoding="utf-8"))
        sections["Settings"] = f"<details><summary>config.yaml</summary><pre>{text}</pre></details>"
    shown = [f"<section><h2>{heading}</h2>{content}</section>" for heading, content in sections.items() if content]
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "lightning", "numba"))
    machine = f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
    versions = f"nsvq-lightning {__version__}, Python {platform.python_version()}, {packages}; {machine}"
    facts = _facts(history, schedule, metrics).items()
    parts = {
        "figures": "".join(f"<div>{name}<b>{value}</b></div>" for name, value in facts),
        "how": "measured on the decoded file" if metrics else "as a file written at that moment would decode to",
        "refresh": "" if metrics else '<noscript><meta http-equiv="refresh" content="5"></noscript>',
        "viewer": '<a class="button" href="viewer.html">Open viewer.html</a>' if viewer.exists() else "",
    }
    text = fill("report", title=title, sections="\n".join(shown), versions=escape(versions), **parts)
    write_text(folder / NAME, text)
    return folder / NAME


def _facts(history: Rows, schedule: Schedule, metrics: Values | None) -> dict[str, str]:
    """What a run has come to or, without ``metrics``, how far it has come."""
    last = metrics or history[-1]
    quality = {"test PSNR": _decibels(last["psnr"]), "SSIM": f"{last['ssim']:.4f}"}
    if metrics is None:
        place = {"iteration": f"{last['iteration']:,} of {schedule.ends[-1]:,}", "phase": last["phase"]}
        return {**place, **quality, "splats": f"{last['splats']:,}", "trained for": _duration(last["seconds"])}
    if metrics["lpips"] is not None:
        quality["LPIPS"] = f"{metrics['lpips']:.4f}"
    return {
        **quality,
        "at half size": _decibels(metrics["psnr_half"]),
        "at a quarter": _decibels(metrics["psnr_quarter"]),
        "file": f"{metrics['file_bytes'] / 1e6:.3f} MB",
        "smaller than .ply": f"{metrics['ratio']:.1f} x",
        "splats": f"{metrics['num_splats']:,}",
        "trained for": _duration(metrics["train_seconds"]),
    }


# Test views on the page, at most: each takes about 0.3 MB. All are in the folder.
SHOWN = 50


def _views(folder: Path, views: Rows) -> str:
    """Photo, render and error of the worst views, side by side in a picture; ``report.js`` adds the slider."""
    lowest = sorted(row["psnr"] for row in views)[:SHOWN]
    figures = []
    for row in views:
        path = folder / "renders" / row["picture"]
        if row["psnr"] not in lowest or not path.exists():
            continue
        remark = ", the lowest" if row["psnr"] == lowest[0] and len(views) > 1 else ""
        caption = f"{escape(row['name'])}: {_decibels(row['psnr'])}, SSIM {row['ssim']:.4f}{remark}"
        parts = zip(("photo", "render", "error"), np.array_split(_read(path), 3, axis=1), strict=True)
        pictures = "".join(f'<img alt="{part}" src="{_jpeg(picture)}">' for part, picture in parts)
        figures.append(f"<figure>{pictures}<figcaption>{caption}</figcaption></figure>")
    more = f"<p>The {SHOWN} lowest of {len(views)}; the folder renders has all.</p>" if len(views) > SHOWN else ""
    return f'{more}<div class="views">{"".join(figures)}</div>' if figures else ""


def _curve(history: Rows, schedule: Schedule) -> str:
    """What ``report.js`` draws."""
    rows = [[row["iteration"], row["psnr"] if math.isfinite(row["psnr"]) else None, row["splats"]] for row in history]
    phases = [[phase.name.lower(), end] for phase, end in zip(Phase, schedule.ends, strict=False)]
    data = script_json({"history": rows, "phases": phases})
    return f'<div id="curve" class="card"></div><script>const trained = {data};</script>'


def _streams(metrics: Values) -> str:
    """The table of what is in the file."""
    rows = []
    for name, size in {**metrics["streams"], "whole file": metrics["file_bytes"]}.items():
        if size:
            bits = 8 * size / max(1, metrics["num_splats"])
            bar = f'<i style="--share:{size / metrics["file_bytes"]:.4f}"></i>'
            rows.append((name, f"{size:,}", f"{bits:.2f}", bar))
    return _table(("stream", "bytes", "bits a splat", ""), rows)


def _codes(metrics: Values) -> str:
    """The table of the codebooks."""
    rows = [
        (name, f"{book['codebook']:,}", f"{book['used']:,}", f"{book['entropy']:.2f}")
        for name, book in metrics["codes"].items()
    ]
    return _table(("attribute", "codebook", "in use", "entropy, bits"), rows)


def _times(history: Rows) -> str:
    """The table of times."""
    rows = []
    before, since = 0, 0.0
    for last in {entry["phase"]: entry for entry in history}.values():
        steps = last["iteration"] - before
        taken = last["seconds"] - since
        rows.append((last["phase"], f"{steps:,}", _duration(taken), f"{1000 * taken / steps:.1f}"))
        before, since = last["iteration"], last["seconds"]
    return _table(("part", "iterations", "time", "ms each"), rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; nothing without rows."""
    if not rows:
        return ""
    table = "<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>"
    for row in rows:
        table += "<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>"
    return f'<div class="scroll"><table>{table}</table></div>'


def _read(path: Path) -> Uint8s:
    picture: Uint8s | None = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise OSError(f"{path} is not a picture any more; run 'nsvq test' again")
    return picture


def _jpeg(picture: Uint8s) -> str:
    """A picture as an address that holds it."""
    factor = min(1.0, 1000 / max(picture.shape[:2]))
    picture = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return data_address("jpeg", cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes())


def _decibels(psnr: float | None) -> str:
    return "no error" if psnr is None else f"{psnr:.2f} dB"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
