"""Continue from a checkpoint, even with other codebooks: before the quantize phase they have learned nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from torch import Tensor, nn
from torch.optim import Optimizer

from nsvq_lightning.splats.splats import ATTRIBUTES, sh_degree_of
from nsvq_lightning.training.schedule import Phase, Schedule

__all__ = [
    "QUANTIZER_SETTINGS",
    "QUANTIZE_RULES",
    "branch_checkpoint",
    "branch_optimizer_state",
    "can_branch",
    "changed_schedule",
    "check_continuation",
    "continued_schedule",
]

QUANTIZE_RULES = ("quantize_end", "min_finetune", "min_replacement_interval")
"""Settings of a schedule that have no effect before the quantize phase."""

CODEBOOKS = "codebooks."
"""Prefix of the codebooks in a module's state."""

SPLATS = "splats."
"""Prefix of the splats in a module's state."""

QUANTIZER_SETTINGS = "quantizer_settings"
"""Key under which a checkpoint holds the class and number of codes that each quantizer was made with."""

PHASE = "state._phase"
"""Key of the last trained iteration's phase in a module's state."""


def can_branch(checkpoint: Mapping[str, Any], codebooks: nn.ModuleDict) -> bool:
    """Whether a checkpoint is from before the quantize phase and has other codebooks, in number or size, than these."""
    if not _is_unquantized(checkpoint):
        return False
    state = checkpoint["state_dict"]
    stored = {name: value.shape for name, value in state.items() if name.startswith(CODEBOOKS)}
    return stored != {name: value.shape for name, value in _prefixed(codebooks).items()}


def branch_checkpoint(checkpoint: dict[str, Any], codebooks: nn.ModuleDict, optimizer: Optimizer) -> None:
    """Replace the codebooks of a checkpoint with fresh ones, in place.

    Splats, side tables, their moments in the optimiser, the loops and the callbacks' states stay; so the continued run
    is, bit for bit, the run that would have had these codebooks from the start.

    Args:
        checkpoint: Checkpoint of a run that has not quantized yet (:func:`can_branch`).
        codebooks: Untrained quantizers of the continuing module, by attribute.
        optimizer: A new optimiser of that module, whose groups are named.
    """
    state = checkpoint["state_dict"]
    kept = {name: value for name, value in state.items() if not name.startswith(CODEBOOKS)}
    checkpoint["state_dict"] = kept | _prefixed(codebooks)
    if checkpoint.get("optimizer_states"):
        (stored,) = checkpoint["optimizer_states"]
        checkpoint["optimizer_states"] = [branch_optimizer_state(stored, optimizer.state_dict())]


def branch_optimizer_state(stored: Mapping[str, Any], fresh: Mapping[str, Any]) -> dict[str, Any]:
    """State of an optimiser with the groups of ``fresh``: splat attributes as stored, codebooks untrained.

    Args:
        stored: ``state_dict()`` of the trained optimiser; its groups are named.
        fresh: ``state_dict()`` of a new optimiser, with the desired groups.
    """
    groups = {group["name"]: group for group in stored["param_groups"]}
    merged: dict[str, Any] = {"state": {}, "param_groups": []}
    for group in fresh["param_groups"]:
        if group["name"] not in ATTRIBUTES:
            merged["param_groups"].append(dict(group))
            continue
        old = groups[group["name"]]
        merged["param_groups"].append({**old, "params": list(group["params"])})
        # A state dict refers to parameters by index in the list of all; codebooks before them would shift it.
        for place, old_place in zip(group["params"], old["params"], strict=True):
            if old_place in stored["state"]:
                merged["state"][place] = stored["state"][old_place]
    return merged


def continued_schedule(checkpoint: Mapping[str, Any], schedule: Schedule) -> Schedule:
    """The schedule with the iterations that the checkpoint's run has saved in the same warm-up phase."""
    stored = Schedule(**checkpoint["schedule"])
    same = all(getattr(stored, name) == getattr(schedule, name) for name in ("total", "reference_total", "warmup_end"))
    return replace(schedule, saved=stored.saved) if same else schedule


def changed_schedule(checkpoint: Mapping[str, Any], schedule: Schedule) -> str | None:
    """What to report on a run that continues from a checkpoint with this schedule; None if nothing changes."""
    stored = Schedule(**checkpoint["schedule"])
    if stored.total != schedule.total:
        return (
            f"the checkpoint is of a run of {stored.total} iterations, this one has {schedule.total}: phases, density "
            "control and learning rates follow the new length; pass "
            f"--trainer.max_steps={stored.total} to continue that run as it was"
        )
    own, without_effect = asdict(schedule), ("saved", *(QUANTIZE_RULES if _is_unquantized(checkpoint) else ()))
    changed = {name: v for name, v in asdict(stored).items() if v != own[name] and name not in without_effect}
    if not changed:
        return None
    return (
        f"the checkpoint is of a run with {', '.join(f'{name} = {value}' for name, value in changed.items())}, this "
        f"one continues with {', '.join(f'{name} = {own[name]}' for name in changed)}; pass "
        f"{' '.join(f'--callbacks.phases.{name}={value}' for name, value in changed.items())} to continue that run as "
        "it was"
    )


def check_continuation(
    checkpoint: Mapping[str, Any], own: Mapping[str, Tensor], quantizers: Mapping[str, Mapping[str, Any]]
) -> None:
    """Check that training of a module can continue from a checkpoint.

    Args:
        checkpoint: The checkpoint, with codebooks replaced where allowed (:func:`branch_checkpoint`).
        own: Its ``state_dict()``; numbers of splats may differ, and those of codes if k-means found fewer rows.
        quantizers: Class and number of codes of the module's quantizers by attribute, as requested.

    Raises:
        ValueError: It holds only weights, or is of a module with other settings.
    """
    if not checkpoint.get("optimizer_states"):
        raise ValueError(
            "the checkpoint holds weights without the state of the optimiser, so training cannot continue from it; "
            "export its scene and start from that (--model.init_from=scene.ply)"
        )
    state = checkpoint["state_dict"]
    degrees = [sh_degree_of(values[f"{SPLATS}shN"]) for values in (state, own)]
    if degrees[0] != degrees[1]:
        raise ValueError(
            f"the checkpoint is of a run with SH degree {degrees[0]}, this one has {degrees[1]}; pass "
            f"--model.sh_degree={degrees[0]}"
        )
    trained = checkpoint.get(QUANTIZER_SETTINGS)
    if trained is not None and trained != quantizers and not _is_unquantized(checkpoint):
        raise ValueError(
            f"the checkpoint has quantized with {_described(trained)}, and this run would with "
            f"{_described(quantizers)}; that can change only before the quantize phase: pass "
            f"{_options(trained)}, or a checkpoint from before it"
        )
    # The splats' side tables may differ.
    stored, wanted = ({name for name in values if not name.startswith(SPLATS)} for values in (state, own))
    if stored != wanted:
        raise ValueError(
            f"the checkpoint is of a run with other codebooks or another quantizer: it has {_some(stored - wanted)} "
            f"that this run lacks, and lacks {_some(wanted - stored)}; pass the --model.codebooks and "
            "--model.quantizer that it was trained with"
        )


def _described(settings: Mapping[str, Mapping[str, Any]]) -> str:
    """The quantizers of a run, for a message."""
    return f"{_kinds(settings)} ({_sizes(settings)})" if settings else "no codebooks"


def _options(settings: Mapping[str, Mapping[str, Any]]) -> str:
    """The command-line options that select these quantizers."""
    if not settings:
        return "--model.codebooks=null"
    return f"--model.quantizer={_kinds(settings)} --model.codebooks='{{{_sizes(settings)}}}'"


def _kinds(settings: Mapping[str, Mapping[str, Any]]) -> str:
    return ", ".join(sorted({str(one["quantizer"]) for one in settings.values()}))


def _sizes(settings: Mapping[str, Mapping[str, Any]]) -> str:
    return ", ".join(f"{name}: {one['codes']}" for name, one in settings.items())


def _is_unquantized(checkpoint: Mapping[str, Any]) -> bool:
    """Whether a checkpoint is from before the quantize phase."""
    state = checkpoint["state_dict"]
    return PHASE in state and Phase(int(state[PHASE])) < Phase.QUANTIZE


def _some(names: set[str]) -> str:
    return ", ".join(sorted(names)[:3]) + ", …" * (len(names) > 3) or "nothing"


def _prefixed(codebooks: nn.ModuleDict) -> dict[str, Tensor]:
    return {f"{CODEBOOKS}{name}": value for name, value in codebooks.state_dict().items()}
