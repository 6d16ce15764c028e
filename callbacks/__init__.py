"""Lightning callbacks: everything in a run that happens at certain steps.

Each decides from the module's schedule and the trainer's step alone, through
:class:`nsvq_lightning.training.host.SplatHost`; none depends on another. :func:`standard` makes those of ``nsvq fit``.
"""

from .canonical import CanonicalCovariance
from .checkpoint import RunCheckpoint
from .codebooks import CodebookInit, CodebookReplacement
from .contribution import ContributionPruning
from .density import DensityControl
from .density_rules import DensityRules
from .export import ExportScene
from .finite import FiniteCodes
from .freeze import FreezeCodes
from .metric_report import MetricReport
from .opacity import OpacityRegularization
from .phases import PhaseSchedule
from .predictions import RenderWriter
from .progress import SplatProgressBar
from .refit import CodebookRefit
from .sh_degree import ShDegreeSchedule
from .standard import STANDARD, standard

__all__ = [
    "STANDARD",
    "CanonicalCovariance",
    "CodebookInit",
    "CodebookRefit",
    "CodebookReplacement",
    "ContributionPruning",
    "DensityControl",
    "DensityRules",
    "ExportScene",
    "FiniteCodes",
    "FreezeCodes",
    "MetricReport",
    "OpacityRegularization",
    "PhaseSchedule",
    "RenderWriter",
    "RunCheckpoint",
    "ShDegreeSchedule",
    "SplatProgressBar",
    "standard",
]
