"""Which runs a sweep is made of (scenes × seeds × configurations × quantizers × sizes), and what two of them share."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from nsvq_lightning.callbacks import PhaseSchedule
from nsvq_lightning.commands.arguments import expand, resolve_configs
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.quantize.attributes import codebook_sizes
from nsvq_lightning.training.resume import QUANTIZE_RULES
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.version import __version__

# All settings of a ``nsvq fit``: what ``--print_config`` shows, as JSON values.
Settings = dict[str, Any]

# Callbacks that do nothing before the iterations of the prune phase are done.
BRANCH_CALLBACKS = ("canonical", "codebook_init", "codebook_refit", "codebook_replacement", "codebook_finite", "freeze")


@dataclass(frozen=True)
class Run:
    """One run: what tells it from the others, and all its settings.

    Attributes:
        names: ``scene`` (name of the folder), ``config`` (name), ``quantizer`` (class) and ``codebooks`` (the paper's
            name of the sizes, or codes by attribute), both empty without codebooks, ``seed``, ``steps``.
        settings: Everything ``nsvq fit`` needs.
    """

    names: dict[str, Any]
    settings: Settings

    @property
    def title(self) -> str:
        """The names, without spaces: a part of a file name."""
        parts = [self.names[name].replace(" ", "_") for name in ("scene", "config", "quantizer", "codebooks")]
        return "-".join(part for part in (*parts, f"seed{self.names['seed']}") if part)

    @property
    def digest(self) -> str:
        """Name of the settings in this version of the package: 12 hexadecimal digits, other ones for any difference."""
        text = json.dumps({"version": __version__, "settings": self.settings}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def trunk(self) -> Run | None:
        """The run up to the end of the prune phase, where quantizer and codebooks do not matter yet.

        Runs with the same trunk are the same, bit for bit, until the quantize phase starts. Left out of the trunk are
        the quantizer, the codebooks, the callbacks that drive them, and where the quantize phase ends; everything else
        counts.

        Returns:
            None where that is not certain, or there is nothing to share: no phase before or after that point, callbacks
            that are not this package's, or a trainer that may stop elsewhere.
        """
        trainer, callbacks = self.settings["trainer"], self.settings["callbacks"]
        drivers = [callbacks[name] for name in ("phases", *BRANCH_CALLBACKS) if callbacks[name] is not None]
        known = all(driver["class_path"].startswith("nsvq_lightning.") for driver in drivers)
        # With these, unless null or 0, it may end elsewhere when it is cut in two.
        stops = ("callbacks", "fast_dev_run", "max_time", "min_epochs", "min_steps", "overfit_batches")
        endless = trainer["max_epochs"] in (None, -1) and trainer["limit_train_batches"] in (None, 1.0)
        if any(trainer[name] for name in stops) or not endless or not known or callbacks["phases"] is None:
            return None
        phases = PhaseSchedule(**callbacks["phases"]["init_args"])
        total = phases.total or trainer["max_steps"]
        if total < 1 or (phases.total is None and phases.iterations_per_photo is not None):
            return None  # it has no end, or one that follows from the photos
        schedule = phases.schedule(total)
        end = schedule.ends[Phase.PRUNE]
        if not 0 < end < trainer["max_steps"]:
            return None
        trunk = deepcopy(self.settings)
        trunk["trainer"]["max_steps"] = end
        trunk_phases = trunk["callbacks"]["phases"]["init_args"]
        for name in QUANTIZE_RULES:
            trunk_phases.pop(name, None)
        trunk_phases |= {"total": total, "quantize_end": schedule.reference_total}
        trunk["callbacks"] |= dict.fromkeys((*BRANCH_CALLBACKS, "export"))
        # What all branches start from, whatever they keep of themselves.
        del trunk["callbacks"]["checkpoint"], trunk["model"]["quantizer"]
        trunk["model"]["codebooks"] = None
        return Run(self.names | dict.fromkeys(("config", "quantizer", "codebooks"), ""), trunk)


def plan(
    scenes: Sequence[str | Path] = (),
    configs: Sequence[str] = (),
    quantizers: Sequence[str] = (),
    codebooks: Sequence[str] = (),
    seeds: Sequence[int] = (),
    options: Sequence[str] = (),
) -> list[Run]:
    """All runs, those that share most next to each other; of two with the same settings the first.

    An empty list leaves the choice to the configurations.

    Args:
        scenes: COLMAP folders.
        configs: Configuration files, or names of shipped ones.
        quantizers: Classes of quantizers, for the configurations that have codebooks.
        codebooks: Codebook sizes, for the configurations that have codebooks.
        seeds: Seeds of the draws and of the order of the views.
        options: More options of ``nsvq fit``, for every run.

    Raises:
        SystemExit: A configuration or option is wrong; a line on stderr says how.
        ValueError: A codebook size is unknown, a scene is no folder, two runs have one title, or the data module takes
            no root or seed.
    """
    for size in codebooks:
        codebook_sizes(size)
    for scene in scenes:
        if not Path(scene).is_dir():
            raise ValueError(f"{scene} is no folder; --scenes takes COLMAP folders with commas between them")
    common = [*(f"--data.root={scene}" for scene in scenes[:1]), *options]
    variants: list[tuple[str, Settings]] = []
    for config in configs or ("",):
        name = Path(config).stem or "default"
        arguments = ["--config", config, *common] if config else common
        settings = resolve(arguments)
        if settings["model"]["codebooks"] is None:  # once, whatever sizes and quantizers are asked for
            variants.append((name, settings))
            continue
        quantized = [resolve([*arguments, f"--model.quantizer={quantizer}"]) for quantizer in quantizers]
        for variant, size in product(quantized or [settings], codebooks or (settings["model"]["codebooks"],)):
            variants.append((name, variant | {"model": variant["model"] | {"codebooks": size}}))
    runs: list[Run] = []
    for place, seed, (name, variant) in product(scenes or (None,), seeds or (None,), variants):
        settings = deepcopy(variant)
        model, data = settings["model"], settings["data"]["init_args"]
        if not {"root", "seed"} <= data.keys():
            kind = settings["data"]["class_path"]
            raise ValueError(f"{kind} takes no root or no seed, by which a sweep tells its runs apart; give it both")
        # Absolute, so that the same sweep started from another folder finds its runs.
        data["root"] = str(Path(place or data["root"]).resolve())
        if seed is not None:
            model["seed"] = data["seed"] = seed
        sizes = model["codebooks"] or ""
        names = {
            "scene": Path(data["root"]).name,
            "config": name,
            "quantizer": model["quantizer"]["class_path"].rpartition(".")[2] if sizes else "",
            "codebooks": " ".join(f"{k}={codes}" for k, codes in sizes.items()) if isinstance(sizes, dict) else sizes,
            "seed": model["seed"],
            "steps": settings["trainer"]["max_steps"],
        }
        run = Run(names, settings)
        if any(run.settings == other.settings for other in runs):
            continue
        if any(run.title == other.title for other in runs):
            raise ValueError(f"two runs are called {run.title}: rename a scene or configuration to tell them apart")
        runs.append(run)
    return runs


class _Reader(SplatCLI):
    """Reads the arguments as ``nsvq fit`` does, and builds and runs nothing."""

    def instantiate_classes(self) -> None:
        """Nothing."""

    def _parse_ckpt_path(self) -> None:
        """Nothing."""

    def _run_subcommand(self, subcommand: str) -> None:
        """Nothing."""


def resolve(arguments: Sequence[str]) -> Settings:
    """Settings of ``nsvq fit ARGUMENTS``, without what says where the output goes and how progress is shown.

    Raises:
        SystemExit: The arguments are wrong; a line on stderr says how.
        ValueError: They name a checkpoint to go on from, or two sizes of the scene.
    """
    with warnings.catch_warnings():
        # Lightning warns of arguments that are not the process's, jsonargparse of the name `skip_none`.
        warnings.simplefilter("ignore")
        reader = _Reader(["fit", *expand(resolve_configs(arguments))])
        text = reader._parser("fit").dump(reader.config["fit"], skip_none=False, format="json")
    settings: Settings = json.loads(text)
    if settings["ckpt_path"] is not None:
        raise ValueError(f"a sweep has checkpoints of its own; leave ckpt_path={settings['ckpt_path']} out")
    trainer, callbacks = settings["trainer"], settings["callbacks"]
    del trainer["default_root_dir"], trainer["run_folder"], callbacks["progress"], callbacks["kernels"]
    trainer["logger"] = False
    return settings
