"""What is measured, and how thoroughly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.benchmark.sizes import SIZES, STANDARD
from nsvq_lightning.skips import SKIPS

__all__ = ["Scope"]

QUICK_WORKLOADS = ("A20k",)


@dataclass(frozen=True)
class Scope:
    """What the command line says, with its defaults filled in.

    Attributes:
        threads: Thread counts that are measured, each at least 1.
        quick: Small workloads and few repeats, for continuous integration.
        repeats: Timed calls of each case, at least 1.
        seconds: A case is not called again once its calls have taken this long together.
        workloads: Names of synthetic scenes, see :mod:`nsvq_lightning.commands.benchmark.workloads`.
        scene: Scene file or COLMAP folder that is measured instead of the synthetic scenes.
        init_from: Scene file whose splats are seen by the cameras of the COLMAP folder ``scene``, instead of its
            points.
        steps: Iterations of each run of ``train``, at least 4: a phase has one at least.
        switches: Names of :data:`nsvq_lightning.skips.SKIPS` that ``train`` inverts one by one.
        config: Config of the runs of ``profile`` and ``train``; by default ``profile`` trains each phase by itself, and
            ``train`` takes ``fast.yaml``, or ``demo.yaml`` without photos.
        beside: Files of the same scene by other programs, which ``compress`` measures, too.

    Raises:
        ValueError: A number is out of range, a name is unknown, or there is nothing to measure.
    """

    threads: tuple[int, ...]
    quick: bool = False
    repeats: int = 15
    seconds: float = 5.0
    workloads: tuple[str, ...] = STANDARD
    scene: Path | None = None
    init_from: Path | None = None
    steps: int = 1000
    switches: tuple[str, ...] = ()
    config: str | None = None
    beside: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if not self.threads or min(self.threads) < 1:
            raise ValueError(f"thread counts must be at least 1, got {list(self.threads)}")
        if self.repeats < 1:
            raise ValueError(f"repeats must be at least 1, got {self.repeats}")
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"seconds must be finite and above 0, got {self.seconds}")
        if self.steps < 4:
            raise ValueError(f"steps must be at least 4, one for each phase, got {self.steps}")
        unknown = [name for name in self.workloads if name not in SIZES]
        if unknown or not self.workloads:
            raise ValueError(f"workloads must be some of {', '.join(SIZES)}, got {', '.join(unknown) or 'none'}")
        unknown = [name for name in self.switches if name not in SKIPS]
        if unknown:
            raise ValueError(f"switches must be some of {', '.join(SKIPS)}, got {', '.join(unknown)}")
        if self.init_from is not None and self.photos is None:
            raise ValueError("init-from needs a COLMAP folder as scene, whose cameras look at its splats")

    @property
    def photos(self) -> Path | None:
        """The COLMAP folder, if the scene is one."""
        return self.scene if self.scene is not None and self.scene.is_dir() else None

    @property
    def codebooks(self) -> str:
        """The paper's codebook setting in the suites that quantize."""
        return "1k" if self.quick else "16k"

    @classmethod
    def of(cls, *, quick: bool, most_threads: int, **given: Any) -> Scope:
        """The scope of a full or a quick run; what is None or not given gets the default of that kind of run.

        Args:
            quick: Which kind.
            most_threads: Threads the kernels can use here.
            given: Values by name of the attribute.

        Raises:
            ValueError: As for the class, or more threads than ``most_threads`` are asked for.
        """
        chosen = {name: value for name, value in given.items() if value is not None}
        most = max(chosen.get("threads", ()), default=0)
        if most > most_threads:
            raise ValueError(
                f"at most {most_threads} threads can be measured here, got {most}; "
                "NUMBA_NUM_THREADS, which is the number of cores by default, raises the limit"
            )
        return cls(quick=quick, **{**_defaults(quick, most_threads), **chosen})


def _defaults(quick: bool, most_threads: int) -> Mapping[str, Any]:
    if quick:
        small = {"repeats": 3, "seconds": 0.5, "workloads": QUICK_WORKLOADS, "steps": 40}
        return {"threads": (most_threads,), **small}
    return {"threads": tuple(sorted({1, most_threads}))}
