"""Run time against error: every fast part of the package measured beside its plain counterpart and a float64 oracle.

Here is only what is measured, and how thoroughly: arguments are refused before torch is loaded.
"""

from dataclasses import dataclass
from pathlib import Path

# Modules of this package; each has a function ``run(scope)``, which returns measurements.
SUITES = ("render", "quantize", "codec", "train")


@dataclass(frozen=True)
class Scope:
    """What is measured, and how thoroughly: what the command line says, with its defaults filled in.

    Attributes:
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
    """

    quick: bool = False
    repeats: int = 15
    seconds: float = 5.0
    workloads: tuple[str, ...] = ("A20k", "B100k", "C500k")
    scene: Path | None = None
    init_from: Path | None = None
    steps: int = 1000
    switches: tuple[str, ...] = ()
    config: str | None = None

    @property
    def photos(self) -> Path | None:
        """The COLMAP folder, if the scene is one."""
        return self.scene if self.scene is not None and self.scene.is_dir() else None

    @property
    def codebooks(self) -> str:
        """The paper's codebook setting in the suites that quantize."""
        return "1k" if self.quick else "16k"


# The synthetic scenes by name: splats, pixels across and down, and the median length of a splat's axes in scene units.
# Splats are smaller where there are more, as training leaves them.
SIZES = {
    "A20k": (20_000, 400, 300, 0.0175),
    "B100k": (100_000, 800, 533, 0.0100),
    "C500k": (500_000, 800, 533, 0.0056),
    "D1M": (1_000_000, 1600, 1060, 0.0044),
    "E3M": (3_000_000, 1600, 1060, 0.0031),
}

# What --quick changes of a scope.
QUICK = {"repeats": 3, "seconds": 0.5, "workloads": ("A20k",), "steps": 40}
