"""The callbacks of ``nsvq fit``, one of each, in order."""

from importlib import import_module
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint, ProgressBar, RichProgressBar, TQDMProgressBar

from nsvq_lightning.top_level import folder_of

from . import checkpoint, growth, outputs, precompile, progress, pruning, quantization, report, schedule

# Callback by name. Density control comes before the canonical form, which may act after the same iteration; codebooks
# are placed before rate and distortion choose among their codes.
STANDARD: dict[str, type[Callback]] = {
    "phases": schedule.PhaseSchedule,
    "sh_degree": schedule.ShDegreeSchedule,
    "rate_decay": schedule.LearningRateDecay,
    "budget": growth.SplatBudget,
    "density": growth.BudgetedGrowth,
    "selection": pruning.OpacitySelection,
    "opacity": pruning.OpacityRegularization,
    "canonical": quantization.CanonicalCovariance,
    "codebook_init": quantization.CodebookInit,
    "codebook_refit": quantization.CodebookRefit,
    "codebook_replacement": quantization.CodebookReplacement,
    "codebook_finite": quantization.FiniteCodes,
    "rate_distortion": quantization.RateDistortion,
    "freeze": quantization.FreezeCodes,
    "report": report.MetricReport,
    "live": outputs.LiveScene,
    "export": outputs.ExportScene,
    "predictions": outputs.RenderWriter,
    "checkpoint": checkpoint.RunCheckpoint,
    "kernels": precompile.CompileAhead,
    "progress": progress.SplatProgressBar,
}

# Those that a run has only if a config or the user asks for them.
OPTIONAL = frozenset({"opacity", "codebook_refit", "rate_distortion"})


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


def standard(config: str | None = None, /, **replaced: Callback | None) -> list[Callback]:
    """The callbacks of ``nsvq fit``, with their defaults or with the settings of a config.

    Progress bar and checkpoints take the place of the trainer's own, unless its flags (``enable_progress_bar``,
    ``enable_checkpointing``, ``barebones``) leave them out. Those that you name are in the list as they are.

    Args:
        config: Name of a config that comes with the package, such as ``small`` or ``paper``.
        replaced: Callbacks that replace those of the same name in :data:`STANDARD`; None leaves one out.

    Raises:
        ValueError: There is no callback of that name.

    Example:
        >>> from nsvq_lightning.callbacks import OPTIONAL, STANDARD, DensityControl, standard
        >>> len(standard()) == len(STANDARD) - len(OPTIONAL)
        True
        >>> few = standard(density=DensityControl(max_splats=200_000), report=None, progress=None)
        >>> [type(callback).__name__ for callback in few[:2]]
        ['PhaseSchedule', 'ShDegreeSchedule']
    """
    unknown = sorted(set(replaced) - set(STANDARD))
    if unknown:
        raise ValueError(f"there is no standard callback {', '.join(unknown)}; there are {', '.join(STANDARD)}")
    settings = {} if config is None else _callbacks_of(config)
    made = []
    for name, kind in STANDARD.items():
        if name in replaced:
            callback = replaced[name]
        elif name in settings:
            callback = settings[name]
        else:
            callback = None if name in OPTIONAL else kind()
        if callback is not None:
            takes_place = name not in replaced and isinstance(callback, Checkpoint | ProgressBar)
            made.append(_IfWanted(callback) if takes_place else callback)
    return made


def _callbacks_of(config: str) -> dict[str, Callback | None]:
    """What a config says of callbacks: null, a class by name or with its settings, or settings of the standard one."""
    import yaml

    text = (folder_of("configs") / f"{config}.yaml").read_text(encoding="utf-8")
    made: dict[str, Callback | None] = {}
    for name, value in yaml.safe_load(text).get("callbacks", {}).items():
        if value is None:
            made[name] = None
            continue
        named: dict[str, Any] = {"class_path": value} if isinstance(value, str) else value
        if "class_path" in named:
            kind = getattr(import_module(__package__), named["class_path"])
            made[name] = kind(**named.get("init_args", {}))
        else:
            made[name] = STANDARD[name](**named)
    return made
