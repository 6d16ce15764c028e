"""How much is measured."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from nsvq_lightning.benchmark.sizes import SIZES

__all__ = ["Settings", "usable_cores"]

QUICK_WORKLOADS = ("A20k",)


def usable_cores() -> int:
    """Cores this process may run on, which containers and ``taskset`` make fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Settings:
    """What the command line says, with its defaults filled in.

    Attributes:
        threads: Thread counts that are measured, each at least 1.
        quick: Small workloads and few repeats, for continuous integration.
        repeats: Timed calls of each case, at least 1.
        seconds: A case is not called again once its calls have taken this long together.
        workloads: Names of synthetic scenes, see :mod:`nsvq_lightning.benchmark.workloads`.
        scene: Scene file that is measured instead of the synthetic scenes.

    Raises:
        ValueError: A number is out of range, a workload is unknown, or there is nothing to measure.
    """

    threads: tuple[int, ...]
    quick: bool = False
    repeats: int = 15
    seconds: float = 10.0
    workloads: tuple[str, ...] = tuple(SIZES)
    scene: Path | None = None

    def __post_init__(self) -> None:
        if not self.threads or min(self.threads) < 1:
            raise ValueError(f"thread counts must be at least 1, got {list(self.threads)}")
        if self.repeats < 1:
            raise ValueError(f"repeats must be at least 1, got {self.repeats}")
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"seconds must be finite and above 0, got {self.seconds}")
        unknown = [name for name in self.workloads if name not in SIZES]
        if unknown or not self.workloads:
            raise ValueError(f"workloads must be some of {', '.join(SIZES)}, got {', '.join(unknown) or 'none'}")

    @classmethod
    def of(
        cls,
        *,
        quick: bool,
        most_threads: int,
        threads: tuple[int, ...] | None = None,
        repeats: int | None = None,
        workloads: tuple[str, ...] | None = None,
        scene: Path | None = None,
    ) -> Settings:
        """Settings of a full or a quick run; what is None gets the default of that kind of run.

        Args:
            quick: Which kind.
            most_threads: Threads the kernels can use here.
            threads: Thread counts; by default 1 and all of them, in a quick run all only.
            repeats: Timed calls; 15, quick 3.
            workloads: Synthetic scenes; all, quick the smallest.
            scene: Scene file instead of those.

        Raises:
            ValueError: As for the class, or more threads than ``most_threads`` are asked for.
        """
        if threads is not None and max(threads, default=0) > most_threads:
            raise ValueError(
                f"at most {most_threads} threads can be measured here, got {max(threads)}; "
                "NUMBA_NUM_THREADS, which is the number of cores by default, raises the limit"
            )
        default_threads = (most_threads,) if quick else tuple(sorted({1, most_threads}))
        return cls(
            threads=default_threads if threads is None else threads,
            quick=quick,
            repeats=(3 if quick else 15) if repeats is None else repeats,
            seconds=0.5 if quick else 10.0,
            workloads=(QUICK_WORKLOADS if quick else tuple(SIZES)) if workloads is None else workloads,
            scene=scene,
        )
