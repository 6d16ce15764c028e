"""The suites by name. A new suite is one file in ``suites`` and one line here; nothing is imported until it runs."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import cast

from nsvq_lightning.benchmark.row import Row
from nsvq_lightning.benchmark.settings import Settings

__all__ = ["SUITES", "load_suite", "suite_names"]

SUITES = {
    "render": "rasterizer back-ends, forward and backward",
    "nearest": "nearest-code searches",
    "loss": "L1 + D-SSIM, fused and in plain torch",
    "optimizer": "implementations of Adam",
    "quantize": "a whole NSVQ step, and the k-means that starts the codebooks",
    "codec": "writing and reading scene files",
}
"""Name of a suite, which is that of its module in :mod:`nsvq_lightning.benchmark.suites`, and what it measures."""

ALL = "all"


def suite_names(choice: str) -> tuple[str, ...]:
    """The suites that a word of the command line stands for: one, or every one for ``all``.

    Raises:
        ValueError: There is no such suite.
    """
    if choice == ALL:
        return tuple(SUITES)
    if choice not in SUITES:
        raise ValueError(f"unknown benchmark suite {choice!r}; choose one of {', '.join(SUITES)} or {ALL}")
    return (choice,)


def load_suite(name: str) -> Callable[[Settings], Sequence[Row]]:
    """The function ``run(settings)`` of a suite."""
    module = importlib.import_module(f"nsvq_lightning.benchmark.suites.{name}")
    return cast(Callable[[Settings], Sequence[Row]], module.run)
