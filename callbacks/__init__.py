"""Lightning callbacks: everything in a run that happens at certain steps.

Each decides from the module's schedule and the trainer's step alone, through
:class:`nsvq_lightning.training.host.SplatHost`; none depends on another. :func:`standard` makes those of ``nsvq fit``.
"""

from .budget import SplatBudget
from .canonical import CanonicalCovariance
from .checkpoint import RunCheckpoint
from .codebooks import CodebookInit, CodebookReplacement
from .contribution import ContributionPruning
from .density import DensityControl
from .density_rules import DensityRules
from .dropout import SplatDropout
from .export import ExportScene
from .exposure import ExposureCompensation
from .finite import FiniteCodes
from .freeze import FreezeCodes
from .frequency import FrequencyLimit
from .growth import BudgetedGrowth
from .growth_rules import GrowthRules
from .kernels import CompileAhead
from .live import LiveScene
from .metric_report import MetricReport
from .opacity import OpacityRegularization
from .phases import PhaseSchedule
from .predictions import RenderWriter
from .progress import SplatProgressBar
from .rate_distortion import RateDistortion
from .rates import RateDecay
from .refit import CodebookRefit
from .selection import OpacitySelection
from .sh_degree import ShDegreeSchedule
from .sh_penalty import ShPenalty
from .standard import STANDARD, standard
from .views import ViewsPerStep

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
    "ShPenalty",
    "SplatBudget",
    "SplatDropout",
    "SplatProgressBar",
    "ViewsPerStep",
    "standard",
]
