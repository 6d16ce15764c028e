"""Run time against error: every fast part of the package measured beside its plain counterpart and a float64 oracle.

Here is only what is measured, and how thoroughly: arguments are refused before torch is loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from nsvq_lightning.skips import SKIPS

__all__ = ["SIZES", "Scope", "Size"]


class Size(NamedTuple):
    """Splats, pixels across and down, and the median length of a splat's axes in scene units."""

    splats: int
    width: int
    height: int
    scale: float


SIZES = {
    "A20k": Size(20_000, 400, 300, 0.0175),
    "B100k": Size(100_000, 800, 533, 0.0100),
    "C500k": Size(500_000, 800, 533, 0.0056),
    "D1M": Size(1_000_000, 1600, 1060, 0.0044),
    "E3M": Size(3_000_000, 1600, 1060, 0.0031),
}
"""The synthetic scenes by name: smaller splats where there are more, as training leaves them."""


@dataclass(frozen=True)
class Scope:
    """What the command line says, with its defaults filled in.

    Attributes:
        threads: Thread counts that are measured, each at least 1.
        quick: Small workloads and few repeats, for continuous integration.
        repeats: Timed calls of each case, at least 1.
        seconds: A case is not called again once its calls have taken this long together.
        workloads: Names of synthetic scenes of ``render`` and ``codec``.
        scene: Scene file or COLMAP folder that is measured instead of the synthetic scenes.
        init_from: Scene file whose splats are seen by the cameras of the COLMAP folder ``scene``, instead of its
            points.
        steps: Iterations of each run of ``train``, at least 4: a phase has one at least.
        switches: Names of :data:`nsvq_lightning.skips.SKIPS` that ``train`` inverts one by one.
        config: Config of the runs of ``train``; by default ``fast.yaml``, without photos ``demo.yaml``.
        beside: Files of the same scene by other programs, which ``codec`` measures, too.

    Raises:
        ValueError: A number is out of range, a name is unknown, or there is nothing to measure.
    """

    threads: tuple[int, ...]
    quick: bool = False
    repeats: int = 15
    seconds: float = 5.0
    workloads: tuple[str, ...] = ("A20k", "B100k", "C500k")
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
        chosen: dict[str, Any] = {"threads": tuple(sorted({1, most_threads}))}
        if quick:
            chosen = {"threads": (most_threads,), "repeats": 3, "seconds": 0.5, "workloads": ("A20k",), "steps": 40}
        chosen.update((name, value) for name, value in given.items() if value is not None)
        most = max(chosen["threads"], default=0)
        if most > most_threads:
            raise ValueError(
                f"at most {most_threads} threads can be measured here, got {most}; "
                "NUMBA_NUM_THREADS, which is the number of cores by default, raises the limit"
            )
        return cls(quick=quick, **chosen)
