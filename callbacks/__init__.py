"""Lightning callbacks: everything in a run that happens at certain steps.

Each decides from the module's schedule and the trainer's step alone, through
:class:`nsvq_lightning.training.host.SplatHost`; none depends on another. :func:`standard` makes those of ``nsvq fit``.
"""

from .checkpoint import RunCheckpoint
from .density import DensityControl, DensityRules
from .growth import BudgetedGrowth, GrowthRules, SplatBudget
from .options import ExposureCompensation, FrequencyLimit
from .outputs import ExportScene, LiveScene, RenderWriter
from .precompile import CompileAhead
from .progress import SplatProgressBar
from .pruning import ContributionPruning, OpacityRegularization, OpacitySelection
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
from .schedule import PhaseSchedule, RateDecay, ShDegreeSchedule
from .standard import STANDARD, standard

__all__ = [
    "STANDARD",
    "BudgetedGrowth",
    "CanonicalCovariance",
    "CodebookInit",
    "CodebookRefit",
    "CodebookReplacement",
    "CompileAhead",
    "ContributionPruning",
    "DensityControl",
    "DensityRules",
    "ExportScene",
    "ExposureCompensation",
    "FiniteCodes",
    "FreezeCodes",
    "FrequencyLimit",
    "GrowthRules",
    "LiveScene",
    "MetricReport",
    "OpacityRegularization",
    "OpacitySelection",
    "PhaseSchedule",
    "RateDecay",
    "RateDistortion",
    "RenderWriter",
    "RunCheckpoint",
    "ShDegreeSchedule",
    "SplatBudget",
    "SplatProgressBar",
    "standard",
]
