"""The callbacks of ``nsvq fit``, one of each, in order."""

from importlib import import_module
from typing import Any

import yaml
from lightning.pytorch import Callback

from nsvq_lightning.top_level import folder_of

from . import checkpoint, growth, outputs, progress, pruning, quantization, report, schedule

# Callback by name. The length of a run in minutes depends on the budget. Density control comes before the canonical
# form, which may act after the same iteration; codebooks are placed, and codes replaced, before rate and distortion
# choose among them.
STANDARD: dict[str, type[Callback]] = {
    "budget": growth.SplatBudget,
    "phases": schedule.PhaseSchedule,
    "sh_degree": schedule.ShDegreeSchedule,
    "rate_decay": schedule.LearningRateDecay,
    "density": growth.BudgetedGrowth,
    "selection": pruning.SplatSelection,
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
    "progress": progress.SplatProgressBar,
}


def _made(name: str, value: Any) -> Callback | None:
    """What a config says of a callback: null, a class by name or with its settings, or settings of the standard one."""
    if value is None:
        return None
    named: dict[str, Any] = {"class_path": value} if isinstance(value, str) else value
    if "class_path" not in named:
        return STANDARD[name](**named)
    kind: type[Callback] = getattr(import_module(__package__), named["class_path"])
    return kind(**named.get("init_args", {}))


# Those that a run has only if a config or the user asks for them.
OPTIONAL = frozenset({"opacity", "codebook_refit", "rate_distortion"})


def standard(config: str | None = None, /, **replaced: Callback | None) -> list[Callback]:
    """The callbacks of ``nsvq fit``, with their defaults or with the settings of a config.

    A trainer with ``enable_progress_bar=False`` or ``enable_checkpointing=False`` refuses those of them that it is not
    to have: leave them out with ``progress=None`` or ``checkpoint=None``.

    Args:
        config: Name of a config that comes with the package, such as ``small`` or ``paper``.
        replaced: Callbacks that replace those of the same name in :data:`STANDARD`; None leaves one out.

    Raises:
        ValueError: There is no callback, or config, of that name.

    Example:
        >>> from nsvq_lightning.callbacks import OPTIONAL, STANDARD, DensityControl, standard
        >>> len(standard()) == len(STANDARD) - len(OPTIONAL)
        True
        >>> few = standard(density=DensityControl(max_splats=200_000), report=None, progress=None)
        >>> [type(callback).__name__ for callback in few[:2]]
        ['SplatBudget', 'PhaseSchedule']
    """
    if unknown := sorted(set(replaced) - set(STANDARD)):
        raise ValueError(f"there is no standard callback {', '.join(unknown)}; there are {', '.join(STANDARD)}")
    configs = {path.stem: path for path in folder_of("configs").glob("*.yaml")}
    if config not in (None, *configs):
        raise ValueError(f"there is no config {config}; there are {', '.join(sorted(configs))}")
    text = "{}" if config is None else configs[config].read_text(encoding="utf-8")
    settings = {name: _made(name, value) for name, value in yaml.safe_load(text).get("callbacks", {}).items()}
    given = dict.fromkeys(OPTIONAL) | settings | replaced
    chosen = (given[name] if name in given else kind() for name, kind in STANDARD.items())
    return [callback for callback in chosen if callback is not None]
