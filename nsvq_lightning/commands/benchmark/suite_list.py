"""The suites by name. A new suite is one file in ``suites`` and one line here; nothing is imported until it runs."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, cast

from nsvq_lightning.commands.benchmark.measurement import Measurement
from nsvq_lightning.commands.benchmark.scope import Scope

__all__ = ["ALL", "SUITES", "Suite", "Unavailable", "load_suite", "suite_names"]


class Unavailable(Exception):
    """This machine has not got what a suite measures; the message says what, and the other suites go on."""


class Suite(NamedTuple):
    """What a suite measures, and how it is drawn.

    Attributes:
        about: One line for the help.
        picture: ``errors`` draws values against milliseconds, ``shares`` a bar for each part, ``growth`` milliseconds
            and memory against what grows, ``curves`` the first value against the bytes.
        drawn: Values that ``errors`` draws, a line of panels each; by default the first one of the rows.
    """

    about: str
    picture: Literal["errors", "shares", "growth", "curves"] = "errors"
    drawn: tuple[str, ...] = ()


SUITES = {
    "render": Suite(
        "rasterizer back-ends and their accuracy settings, forward and backward", drawn=("max error", "gradient error")
    ),
    "gpu": Suite(
        "back-ends of a GPU side by side, and a training step of each phase on it",
        drawn=("max error", "gradient error"),
    ),
    "stability": Suite(
        "extreme scenes and quantizers: finite, refused or wrong?", drawn=("max error", "gradient error")
    ),
    "nearest": Suite("nearest-code searches", drawn=("added distance", "wrong codes")),
    "loss": Suite("L1 + D-SSIM, fused and in plain torch"),
    "optimizer": Suite("implementations of Adam"),
    "quantize": Suite("a whole NSVQ step on all four attributes"),
    "kmeans": Suite("the k-means that starts the codebooks", drawn=("distortion",)),
    "codec": Suite("writing and reading scene files", drawn=("bytes a splat", "image error")),
    "compress": Suite("a trained scene made small: bytes against quality, beside other formats", picture="curves"),
    "train": Suite("whole runs, with switches on and off, and a step beside its own render", drawn=("PSNR dB",)),
    "size": Suite("how time and memory of a step grow with splats and pixels", picture="growth"),
    "profile": Suite("where the time of a training step goes, phase by phase", picture="shares"),
}
"""The suites by name, which is that of their module in :mod:`nsvq_lightning.commands.benchmark.suites`."""

ALL = "all"


def suite_names(choice: str) -> tuple[str, ...]:
    """The suites that a word of the command line stands for: one, some with commas between them, or ``all``.

    Raises:
        ValueError: There is no such suite.
    """
    if choice == ALL:
        return tuple(SUITES)
    names = tuple(dict.fromkeys(choice.split(",")))
    unknown = [name for name in names if name not in SUITES]
    if unknown:
        raise ValueError(f"unknown benchmark suite {unknown[0]!r}; choose from {', '.join(SUITES)}, or {ALL}")
    return names


def load_suite(name: str) -> Callable[[Scope], Sequence[Measurement]]:
    """The function ``run(scope)`` of a suite."""
    module = importlib.import_module(f"nsvq_lightning.commands.benchmark.suites.{name}")
    return cast(Callable[[Scope], Sequence[Measurement]], module.run)
