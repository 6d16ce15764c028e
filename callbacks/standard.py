"""The callbacks of ``nsvq fit``, one of each, in order."""

from __future__ import annotations

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint, ProgressBar, RichProgressBar, TQDMProgressBar

from .checkpoint import RunCheckpoint
from .density import DensityControl
from .growth import SplatBudget
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
from .schedule import LearningRateDecay, PhaseSchedule, ShDegreeSchedule

__all__ = ["STANDARD", "standard"]

STANDARD: dict[str, type[Callback]] = {
    "phases": PhaseSchedule,
    "sh_degree": ShDegreeSchedule,
    "rate_decay": LearningRateDecay,
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


class _IfWanted(Callback):
    """Stands for our progress bar or checkpoints until the trainer has read its flags, which may refuse either.

    The trainer has then made a plain one of its own, whose place ours takes, or none. Checkpoints also come beside a
    checkpoint callback of the user's; a progress bar of the user's is the only one.
    """

    def __init__(self, callback: Callback) -> None:
        self._callback = callback
        self._kind = Checkpoint if isinstance(callback, Checkpoint) else ProgressBar

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Take the place, once."""
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]  # Lightning does not type it
        if not any(isinstance(each, self._kind) for each in callbacks):
            return
        place = callbacks.index(self)
        # In place, and only behind this one: Lightning is going through the list.
        plain = [each for each in callbacks[place:] if _is_plain(each, self._kind)]
        for each in plain:
            callbacks.remove(each)
        if plain or self._kind is Checkpoint:
            callbacks[place] = self._callback
            self._callback.setup(trainer, pl_module, stage)


def _is_plain(callback: Callback, kind: type[Callback]) -> bool:
    """Whether the callback is like those that a trainer makes for itself."""
    if kind is ProgressBar:
        return type(callback) in (TQDMProgressBar, RichProgressBar)
    if type(callback) is not ModelCheckpoint:
        return False
    return all(vars(callback)[name] == value for name, value in vars(ModelCheckpoint()).items())


def standard(**replaced: Callback | None) -> list[Callback]:
    """The callbacks of ``nsvq fit``, with their defaults.

    Progress bar and checkpoints take the place of the trainer's own, unless its flags (``enable_progress_bar``,
    ``enable_checkpointing``, ``barebones``) leave them out. Those that you name are in the list as they are.

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
    made = (replaced[name] if name in replaced else _made(kind) for name, kind in STANDARD.items())
    return [callback for callback in made if callback is not None]


def _made(kind: type[Callback]) -> Callback:
    return _IfWanted(kind()) if issubclass(kind, Checkpoint | ProgressBar) else kind()
