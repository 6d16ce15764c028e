"""All settings of a ``nsvq fit`` as plain data: read, told apart, and cut into what two runs share."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

from nsvq_lightning.callbacks import PhaseSchedule
from nsvq_lightning.commands.arguments import expand, resolve_configs
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.training.resume import QUANTIZE_RULES
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.version import __version__

__all__ = ["BRANCH_CALLBACKS", "Settings", "digest", "resolve", "trunk_of"]

Settings = dict[str, Any]
"""What ``--print_config`` shows, as JSON values."""

BRANCH_CALLBACKS = (
    "canonical",
    "codebook_init",
    "codebook_refit",
    "codebook_replacement",
    "codebook_finite",
    "freeze",
)
"""Callbacks that do nothing before the iterations of the prune phase are done."""

IN_ONE_PIECE: dict[str, Any] = {
    "callbacks": (None, []),
    "fast_dev_run": (False,),
    "limit_train_batches": (None, 1.0),
    "max_epochs": (None, -1),
    "max_time": (None,),
    "min_epochs": (None,),
    "min_steps": (None,),
    "overfit_batches": (0.0,),
}
"""Options of the trainer, and the values with which a run is surely the same whether or not it is cut in two."""


class _Reader(SplatCLI):
    """Reads the arguments as ``nsvq fit`` does, and builds and runs nothing."""

    def instantiate_classes(self) -> None:
        """Nothing."""

    def _parse_ckpt_path(self) -> None:
        """Nothing."""

    def _run_subcommand(self, subcommand: str) -> None:
        """Nothing."""

    @property
    def settings(self) -> Settings:
        """Settings of ``fit``, defaults included."""
        settings: Settings = json.loads(self._parser("fit").dump(self.config["fit"], skip_none=False, format="json"))
        return settings


def resolve(arguments: Sequence[str]) -> Settings:
    """Settings of ``nsvq fit ARGUMENTS``, without what says where the output goes and how progress is shown.

    Raises:
        SystemExit: The arguments are wrong; a line on stderr says how.
        ValueError: They name a checkpoint to go on from, or two sizes of the scene.
    """
    with warnings.catch_warnings():
        # Lightning warns of arguments that are not the process's, jsonargparse of the name `skip_none`.
        warnings.simplefilter("ignore")
        settings = _Reader(["fit", *expand(resolve_configs(arguments))]).settings
    if settings["ckpt_path"] is not None:
        raise ValueError(f"a sweep has checkpoints of its own; leave ckpt_path={settings['ckpt_path']} out")
    for name in ("default_root_dir", "run_folder"):
        del settings["trainer"][name]
    settings["trainer"]["logger"] = False
    del settings["callbacks"]["progress"], settings["callbacks"]["kernels"]
    return settings


def digest(settings: Settings) -> str:
    """Name of these settings in this version of the package: 12 hexadecimal digits, other ones for any difference."""
    text = json.dumps({"version": __version__, "settings": settings}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def trunk_of(settings: Settings) -> Settings | None:
    """Settings of the run up to the end of the prune phase, where quantizer and codebooks do not matter yet.

    Runs with the same trunk are the same, bit for bit, until the quantize phase starts. Left out of the trunk are the
    quantizer, the codebooks, the callbacks that drive them, and where the quantize phase ends; everything else counts.

    Returns:
        None where that is not certain, or there is nothing to share: no phase before or after that point, callbacks
        that are not this package's, or a trainer that may stop elsewhere.
    """
    trainer, callbacks = settings["trainer"], settings["callbacks"]
    drivers = [callbacks[name] for name in ("phases", *BRANCH_CALLBACKS)]
    in_one_piece = any(trainer[name] not in values for name, values in IN_ONE_PIECE.items())
    if in_one_piece or callbacks["phases"] is None or not all(map(_is_known, drivers)):
        return None
    phases = PhaseSchedule(**callbacks["phases"]["init_args"])
    if phases.total is None and phases.iterations_per_photo is not None:
        return None  # its length follows from the photos
    total = phases.total or trainer["max_steps"]
    if total < 1:
        return None
    schedule = phases.schedule(total)
    end = schedule.ends[Phase.PRUNE]
    if not 0 < end < trainer["max_steps"]:
        return None
    trunk = deepcopy(settings)
    trunk["trainer"]["max_steps"] = end
    trunk_phases = trunk["callbacks"]["phases"]["init_args"]
    for name in QUANTIZE_RULES:
        trunk_phases.pop(name, None)
    trunk_phases |= {"total": total, "quantize_end": schedule.reference_total}
    trunk["callbacks"] |= dict.fromkeys((*BRANCH_CALLBACKS, "export"))
    # What all branches start from, whatever they keep of themselves.
    del trunk["callbacks"]["checkpoint"]
    del trunk["model"]["quantizer"]
    trunk["model"]["codebooks"] = None
    return trunk


def _is_known(callback: Mapping[str, Any] | None) -> bool:
    """Whether the callback is one of this package, or left out."""
    return callback is None or callback["class_path"].startswith("nsvq_lightning.")
