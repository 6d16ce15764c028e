"""Lightning callbacks: everything in a run that happens at certain steps.

Each decides from the schedule of a :class:`nsvq_lightning.SplatModule` and the trainer's step alone, and none needs
another. What one sets when a fit is set up is seen by those after it: :class:`SplatBudget` stands before the
:class:`PhaseSchedule` whose ``minutes`` are to be of its splats. :func:`standard` makes those of ``nsvq fit``.
"""

from .checkpoint import RunCheckpoint
from .density import DensityControl
from .exposure import ExposureCompensation
from .growth import BudgetedGrowth, SplatBudget
from .outputs import ExportScene, LiveScene, RenderWriter
from .progress import SplatProgressBar
from .pruning import OpacityRegularization, SplatSelection
from .quantization import (
    CanonicalCovariance,
    CodebookInit,
    CodebookRefit,
    CodebookReplacement,
    FiniteCodes,
    FreezeCodes,
    RateDistortion,
)
from .report import MetricReport
from .schedule import LearningRateDecay, PhaseSchedule, ShDegreeSchedule
from .standard import OPTIONAL, STANDARD, standard

__all__ = [
    "OPTIONAL",
    "STANDARD",
    "BudgetedGrowth",
    "CanonicalCovariance",
    "CodebookInit",
    "CodebookRefit",
    "CodebookReplacement",
    "DensityControl",
    "ExportScene",
    "ExposureCompensation",
    "FiniteCodes",
    "FreezeCodes",
    "LearningRateDecay",
    "LiveScene",
    "MetricReport",
    "OpacityRegularization",
    "PhaseSchedule",
    "RateDistortion",
    "RenderWriter",
    "RunCheckpoint",
    "ShDegreeSchedule",
    "SplatBudget",
    "SplatProgressBar",
    "SplatSelection",
    "standard",
]
