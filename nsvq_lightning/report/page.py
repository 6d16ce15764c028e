"""``report.html``: what a run has come to, on one page that needs no other file."""

import base64
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import cv2
import torch
from cv2.typing import MatLike

from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.training.schedule import Phase, Schedule
from nsvq_lightning.version import __version__

from .files import PHASE_COLOURS


def curve_svg(history: Sequence[Mapping[str, Any]], schedule: Schedule) -> str:
    """PSNR and number of splats over the iterations, with phases shaded.

    Args:
        history: The evaluations, at least one.
        schedule: Phases of the run.
    """
    width, height = 800, 340
    left, right, top, bottom = 48, 84, 28, 52  # pixels around the axes
    last = max(schedule.total, int(history[-1]["iteration"]))
    finite = [entry["psnr"] for entry in history if math.isfinite(entry["psnr"])] or [0.0]
    low, high = math.floor(min(finite)), math.ceil(max(finite) + 0.1)
    most = 1.05 * max(entry["splats"] for entry in history)

    def x(iteration: float) -> float:
        return left + (width - left - right) * iteration / last

    def y(share: float) -> float:
        return height - bottom - (height - top - bottom) * share

    def line(points: Sequence[tuple[float, float]], colour: str) -> str:
        listed = " ".join(f"{x(iteration):.1f},{y(share):.1f}" for iteration, share in points)
        return f'<polyline points="{listed}" fill="none" stroke="var(--{colour})" stroke-width="2"/>'

    def label(at: tuple[float, float], text: str, anchor: str, colour: str = "") -> str:
        style = f' style="fill:var(--{colour})"' if colour else ""
        return f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}"{style}>{text}</text>'

    parts, start = [], 0
    for phase, end in zip(Phase, schedule.ends, strict=True):
        if end > start:
            box = f'x="{x(start):.1f}" y="{top}" width="{x(end) - x(start):.1f}" height="{height - top - bottom}"'
            parts.append(f'<rect {box} fill="{PHASE_COLOURS[phase]}" fill-opacity="0.6"/>')
            parts.append(label(((x(start) + x(end)) / 2, top - 8), phase.name.lower(), "middle"))
        start = end
    for value in _ticks(0, last):
        parts.append(label((x(value), height - bottom + 20), f"{value:,.0f}", "middle"))
    for value in _ticks(low, high):
        at = y((value - low) / (high - low))
        parts.append(f'<line x1="{left}" x2="{width - right}" y1="{at:.1f}" y2="{at:.1f}" stroke="#8884"/>')
        parts.append(label((left - 6, at + 4), f"{value:g}", "end", "blue"))
    for value in _ticks(0, most):
        parts.append(label((width - right + 6, y(value / most) + 4), f"{value:,.0f}", "start", "brown"))
    parts.append(label((left, height - 4), "test PSNR, dB", "start", "blue"))
    parts.append(label((width / 2, height - 4), "iteration", "middle"))
    parts.append(label((width - right, height - 4), "splats", "end", "brown"))
    parts.append(line([(entry["iteration"], entry["splats"] / most) for entry in history], "brown"))
    quality = [(entry["iteration"], (entry["psnr"] - low) / (high - low)) for entry in history]
    quality = [(iteration, share) for iteration, share in quality if math.isfinite(share)]
    parts.append(line(quality, "blue"))
    parts += [f'<circle cx="{x(at):.1f}" cy="{y(share):.1f}" r="3" fill="var(--blue)"/>' for at, share in quality]
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(parts)}</svg>'


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from ``low`` to ``high``, a step of 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough)
    return [index * step for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


@dataclass(frozen=True)
class RunPage:
    """The page of a run.

    Attributes:
        folder: Folder of the run, where the page goes; ``config.yaml``, ``preview.png`` and ``renders/`` in it are
            shown where they are.
        history: The evaluations so far.
        schedule: Phases of the run.
        seconds: Seconds that went into anything but training steps, by what it was.
        metrics: The content of ``metrics.json``, see :func:`nsvq_lightning.report.files.summarize`; None before it
            is known.
        views: One row for each test view, as in ``views.csv``, with ``picture``, the name of its file in ``renders/``.
    """

    folder: Path
    history: Sequence[Mapping[str, Any]]
    schedule: Schedule
    seconds: Mapping[str, float] = field(default_factory=dict)
    metrics: Mapping[str, Any] | None = None
    views: Sequence[Mapping[str, Any]] = ()

    def write(self) -> Path:
        """Write ``report.html``, atomically; without ``metrics``, browsers read it again every few seconds.

        Returns:
            The file.
        """
        title = escape(f"{self.folder.resolve().parent.name} / {self.folder.resolve().name}")
        refresh = "" if self.metrics else '<meta http-equiv="refresh" content="5">'
        template = Template(files("nsvq_lightning.report").joinpath("web", "report.html").read_text(encoding="utf-8"))
        preview, config = self.folder / "preview.png", self.folder / "config.yaml"
        sections: dict[str, str] = {}
        if self.metrics is None and preview.exists():
            sections["Photo and render"] = f'<img class="preview" alt="photo and render" src="{_jpeg(_read(preview))}">'
        if self.history:
            sections["While it trained"] = curve_svg(self.history, self.schedule)
        sections["Test views"] = self._views()
        sections |= {heading: _table(*table) for heading, table in self._tables().items()}
        if config.exists():
            text = escape(config.read_text(encoding="utf-8"))
            sections["Settings"] = f"<details><summary>config.yaml</summary><pre>{text}</pre></details>"
        shown = [f"<h2>{heading}</h2>{content}" for heading, content in sections.items() if content]
        packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "lightning", "numba"))
        machine = f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
        versions = f"nsvq-lightning {__version__}, Python {platform.python_version()}, {packages}; {machine}"
        body = "\n".join([f"<h1>{title}</h1>", self._summary(), *shown, f"<footer>{escape(versions)}</footer>"])
        path = self.folder / "report.html"
        write_text(path, template.substitute(title=title, refresh=refresh, body=body))
        return path

    def _summary(self) -> str:
        if self.metrics is None:
            last = self.history[-1]
            facts = [
                ("iteration", f"{last['iteration']:,} of {self.schedule.total:,}"),
                ("phase", last["phase"]),
                ("test PSNR", _decibels(last["psnr"])),
                ("SSIM", f"{last['ssim']:.4f}"),
                ("splats", f"{last['splats']:,}"),
                ("trained for", _duration(last["seconds"])),
            ]
        else:
            facts = [
                ("test PSNR", _decibels(self.metrics["psnr"])),
                ("SSIM", f"{self.metrics['ssim']:.4f}"),
                ("file", f"{self.metrics['file_bytes'] / 1e6:.3f} MB"),
                ("smaller than .ply", f"{self.metrics['ratio']:.1f} x"),
                ("splats", f"{self.metrics['num_splats']:,}"),
                ("trained for", _duration(self.metrics["train_seconds"])),
            ]
            if self.metrics["lpips"] is not None:
                facts.insert(2, ("LPIPS", f"{self.metrics['lpips']:.4f}"))
        shown = "".join(f"<div>{name}<b>{value}</b></div>" for name, value in facts)
        how = "measured on the decoded file" if self.metrics else "as a file written at that moment would decode to"
        viewer = (self.folder / "viewer.html").exists()
        scene = ' <a href="viewer.html">viewer.html</a> beside this page shows the scene.' if viewer else ""
        return f'<div class="figures">{shown}</div><p>Quality on test views, {how}.{scene}</p>'

    def _views(self) -> str:
        worst = min((row["psnr"] for row in self.views), default=0.0)
        figures = []
        for row in self.views:
            path = self.folder / "renders" / row["picture"]
            if path.exists():
                remark = ", the lowest" if row["psnr"] == worst and len(self.views) > 1 else ""
                caption = f"{escape(row['name'])}: {_decibels(row['psnr'])}, SSIM {row['ssim']:.4f}{remark}"
                figures.append(_figure(_read(path), caption))
        return f'<div class="views">{"".join(figures)}</div>' if figures else ""

    def _tables(self) -> dict[str, tuple[Sequence[str], list[Sequence[str]]]]:
        """Head and rows of each table by its heading."""
        streams: list[Sequence[str]] = []
        codes: list[Sequence[str]] = []
        if self.metrics is not None:
            splats, whole = max(1, self.metrics["num_splats"]), self.metrics["file_bytes"]
            for name, size in self.metrics["streams"].items():
                bar = f'<i style="width:{12 * size / whole:.2f}rem"></i>'
                streams += [(name, f"{size:,}", f"{8 * size / splats:.2f}", bar)] if size else []
            streams.append(("whole file", f"{whole:,}", f"{8 * whole / splats:.2f}", ""))
            for name, book in self.metrics["codes"].items():
                codes.append((name, f"{book['codebook']:,}", f"{book['used']:,}", f"{book['entropy']:.2f}"))
        times: list[Sequence[str]] = []
        before, since = 0, 0.0
        for phase in Phase:
            entries = [entry for entry in self.history if entry["phase"] == phase.name.lower()]
            if entries:
                steps, seconds = entries[-1]["iteration"] - before, entries[-1]["seconds"] - since
                times.append((phase.name.lower(), f"{steps:,}", _duration(seconds), f"{1000 * seconds / steps:.1f}"))
                before, since = entries[-1]["iteration"], entries[-1]["seconds"]
        times += [(name, "", _duration(seconds), "") for name, seconds in self.seconds.items() if seconds]
        return {
            "Bytes": (("stream", "bytes", "bits a splat", ""), streams),
            "Codes": (("attribute", "codebook", "in use", "entropy, bits"), codes),
            "Time": (("part", "iterations", "time", "ms an iteration"), times),
        }


def _figure(comparison: MatLike, caption: str) -> str:
    """Photo and render under a slider, and their error, of the three side by side."""
    width = comparison.shape[1] // 3
    photo, render, error = (_jpeg(comparison[:, start : start + width]) for start in (0, width, 2 * width))
    return (
        f'<figure><div class="pair"><img alt="photo" src="{photo}"><img alt="render" src="{render}">'
        '<span>photo</span><span>render</span></div><input type="range" aria-label="photo or render" value="50">'
        f'<figcaption>{caption}<details><summary>error x 4</summary><img class="preview" alt="error" src="{error}">'
        "</details></figcaption></figure>"
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; nothing without rows."""
    if not rows:
        return ""
    lines = ["".join(f"<th>{cell}</th>" for cell in head)]
    lines += ["".join(f"<td>{cell}</td>" for cell in row) for row in rows]
    return f'<div class="scroll"><table>{"".join(f"<tr>{line}</tr>" for line in lines)}</table></div>'


def _read(path: Path) -> MatLike:
    picture = cv2.imdecode(torch.frombuffer(bytearray(path.read_bytes()), dtype=torch.uint8).numpy(), cv2.IMREAD_COLOR)
    if picture is None:
        raise OSError(f"{path} is not a picture any more; run 'nsvq test' again")
    return picture


def _jpeg(picture: MatLike) -> str:
    """A picture as an address that holds it."""
    factor = min(1.0, 1000 / max(picture.shape[:2]))
    if factor < 1.0:
        picture = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def _decibels(psnr: float | None) -> str:
    return "no error" if psnr is None else f"{psnr:.2f} dB"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
