"""Lightning callbacks: everything of a run that happens at certain steps.

Each takes its decisions from the module's schedule and the trainer's step alone, through
:class:`nsvq_lightning.training.host.SplatHost`; none knows another. The order of their list matters in two places only:
:class:`DensityControl` belongs before :class:`CanonicalCovariance`, which may come after the same iteration, and
:class:`ContributionPruning` before :class:`MetricReport`, whose figures are then those of the splats that are left.
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
from .opacity import OpacityRegularization
from .phases import PhaseSchedule
from .predictions import RenderWriter
from .refit import CodebookRefit
from .report import MetricReport
from .sh_degree import ShDegreeSchedule

__all__ = [
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
]
