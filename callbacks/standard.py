"""The callbacks of ``nsvq fit``, one of each, in order."""

from __future__ import annotations

from lightning.pytorch import Callback

from .checkpoint import RunCheckpoint
from .density import DensityControl
from .export import ExportScene
from .finite import FiniteCodes
from .growth import SplatBudget
from .kernels import CompileAhead
from .live import LiveScene
from .metric_report import MetricReport
from .predictions import RenderWriter
from .progress import SplatProgressBar
from .pruning import ContributionPruning, OpacityRegularization, OpacitySelection
from .quantization import (
    CanonicalCovariance,
    CodebookInit,
    CodebookRefit,
    CodebookReplacement,
    FreezeCodes,
    RateDistortion,
)
from .schedule import PhaseSchedule, RateDecay, ShDegreeSchedule

__all__ = ["STANDARD", "standard"]

STANDARD: dict[str, type[Callback]] = {
    "phases": PhaseSchedule,
    "sh_degree": ShDegreeSchedule,
    "rate_decay": RateDecay,
    "budget": SplatBudget,
    "density": DensityControl,
    "selection": OpacitySelection,
    "opacity": OpacityRegularization,
    "contribution": ContributionPruning,
    "canonical": CanonicalCovariance,
    "codebook_init": CodebookInit,
    "codebook_refit": CodebookRefit,
    "codebook_replacement": CodebookReplacement,
    "codebook_finite": FiniteCodes,
    "rate_distortion": RateDistortion,
    "freeze": FreezeCodes,
    "report": MetricReport,
    "live": LiveScene,
    "export": ExportScene,
    "predictions": RenderWriter,
    "checkpoint": RunCheckpoint,
    "kernels": CompileAhead,
    "progress": SplatProgressBar,
}
"""Callback by name. The order matters in three places: density control comes before the canonical form, which may act
after the same iteration; the canonical form, whose floor raises scales, before the replacement of codes, which may copy
them; contribution pruning before the report, whose figures are then those of the remaining splats.
"""


def standard(**replaced: Callback | None) -> list[Callback]:
    """The callbacks of ``nsvq fit``, with their defaults.

    Args:
        replaced: Callbacks that replace those of the same name in :data:`STANDARD`; None leaves one out.

    Raises:
        ValueError: There is no callback of that name.

    Example:
        >>> from nsvq_lightning.callbacks import STANDARD, DensityControl, standard
        >>> len(standard()) == len(STANDARD)
        True
        >>> few = standard(density=DensityControl(max_splats=200_000), report=None, progress=None)
        >>> [type(callback).__name__ for callback in few[:2]]
        ['PhaseSchedule', 'ShDegreeSchedule']
    """
    unknown = sorted(set(replaced) - set(STANDARD))
    if unknown:
        raise ValueError(f"there is no standard callback {', '.join(unknown)}; there are {', '.join(STANDARD)}")
    made = (replaced[name] if name in replaced else kind() for name, kind in STANDARD.items())
    return [callback for callback in made if callback is not None]
