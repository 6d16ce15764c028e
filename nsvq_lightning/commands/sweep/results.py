"""The results of a sweep: one row for each run, and means over the seeds."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsvq_lightning.report.figures import markdown_table

__all__ = ["Group", "RunResult", "as_markdown", "grouped", "series_of"]


@dataclass(frozen=True)
class RunResult:
    """What one run came to; what is not known, as in a failed one, is None.

    Attributes:
        scene: Name of the scene.
        config: Name of the configuration.
        quantizer: Class of the quantizer; empty without codebooks.
        codebooks: Sizes of the codebooks; empty without.
        seed: Seed.
        steps: Iterations that were asked for; a run may end earlier.
        psnr: Of the decoded file on the test views, dB; None also where it is infinite.
        ssim: Of the decoded file on the test views.
        bytes: Size of the file.
        splats: Their number.
        bytes_paper: Size that the file has at level ``paper``.
        psnr_paper: PSNR of the scene before it was stored, which is that of level ``paper``, dB.
        seconds: Training time from the first iteration on, as if nothing had been shared.
        trunk_seconds: The part of ``seconds`` that was trained once for all runs with this trunk; 0 without one.
        psnr_before: PSNR of the plain splats at the end of the prune phase, dB; None without codebooks.
        version: Version of the package that trained it.
        folder: Folder of the run.
        error: Why it has failed; empty otherwise.
    """

    scene: str
    config: str
    quantizer: str
    codebooks: str
    seed: int
    steps: int
    psnr: float | None = None
    ssim: float | None = None
    bytes: int | None = None
    splats: int | None = None
    bytes_paper: int | None = None
    psnr_paper: float | None = None
    seconds: float | None = None
    trunk_seconds: float | None = None
    psnr_before: float | None = None
    version: str = ""
    folder: Path = Path()
    error: str = ""

    def as_csv(self) -> dict[str, Any]:
        """The row as cells."""
        return dict(vars(self))


@dataclass(frozen=True)
class Group:
    """Finished runs that differ in the seed alone."""

    rows: Sequence[RunResult]

    def mean(self, name: str, scale: float = 1.0) -> float | None:
        """Mean of an attribute over the seeds, times ``scale``; None where no run knows it."""
        values = self._values(name)
        return scale * statistics.fmean(values) if values else None

    def spread(self, name: str, scale: float = 1.0) -> float:
        """Standard deviation of an attribute over the seeds (n - 1), times ``scale``; 0 for a single run."""
        values = self._values(name)
        return scale * statistics.stdev(values) if len(values) > 1 else 0.0

    def _values(self, name: str) -> list[float]:
        return [value for row in self.rows if (value := getattr(row, name)) is not None]


def grouped(rows: Sequence[RunResult]) -> list[Group]:
    """The runs that have not failed, with those that differ in the seed alone together, in the order of the first."""
    groups: dict[tuple[str, ...], list[RunResult]] = {}
    for row in rows:
        if not row.error:
            groups.setdefault((row.scene, row.config, row.quantizer, row.codebooks), []).append(row)
    return [Group(members) for members in groups.values()]


def series_of(rows: Sequence[RunResult]) -> Callable[[RunResult], str]:
    """Name of the curve a run belongs to: its quantizer, if that and the sizes tell the runs apart, else more of it."""
    names: list[Callable[[RunResult], str]] = [
        lambda row: row.quantizer or "not quantized",
        lambda row: row.config,
        lambda row: f"{row.config}, {row.quantizer or 'not quantized'}",
    ]
    for name in names:
        if len({(name(row), row.scene, row.codebooks, row.seed) for row in rows}) == len(rows):
            return name
    return names[-1]


NAMES = ("scene", "config", "quantizer", "codebooks")
"""Columns of the table that say which runs a line is about."""

NUMBERS = {
    "PSNR, dB": ("psnr", 1.0, ".2f"),
    "SSIM": ("ssim", 1.0, ".4f"),
    "MB": ("bytes", 1e-6, ".3f"),
    "splats": ("splats", 1.0, ",.0f"),
    "PSNR before, dB": ("psnr_before", 1.0, ".2f"),
    "seconds": ("seconds", 1.0, ",.0f"),
}
"""Attribute of a row, its factor and its format by the head of the column."""

LEGEND = (
    "Mean ± standard deviation over the runs, which differ in the seed. PSNR and SSIM are those of the decoded file on "
    "the test views; before: of the plain splats at the end of the prune phase. Seconds are those of a whole training, "
    "though runs may have shared its first part (`trunk_seconds` in the CSV)."
)


def as_markdown(rows: Sequence[RunResult]) -> str:
    """A table of the means over the seeds, with their standard deviation, and a list of what has failed."""
    cells = []
    for group in grouped(rows):
        names = [getattr(group.rows[0], name) or "–" for name in NAMES]
        cells.append([*names, str(len(group.rows)), *(_plus_minus(group, *number) for number in NUMBERS.values())])
    parts = ["# nsvq sweep"]
    if cells:
        parts += [markdown_table([*NAMES, "runs", *NUMBERS], cells, words=NAMES), LEGEND]
    failed = [
        f"* {row.scene}, {row.config}, {row.codebooks}, seed {row.seed}: {row.error}" for row in rows if row.error
    ]
    if failed:
        parts.append("\n".join(["Failed:", "", *failed]))
    return "\n\n".join(parts) + "\n"


def _plus_minus(group: Group, name: str, scale: float, form: str) -> str:
    mean = group.mean(name, scale)
    if mean is None:
        return "–"
    single = len(group.rows) == 1
    return format(mean, form) if single else f"{mean:{form}} ± {group.spread(name, scale):{form}}"
