"""Which runs a sweep is made of: scenes × seeds × configurations × quantizers × sizes."""

import hashlib
import json
import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from nsvq_lightning.commands import arguments as given
from nsvq_lightning.commands.fit import SplatCLI
from nsvq_lightning.splats.attributes import codebook_sizes
from nsvq_lightning.version import __version__

# All settings of a ``nsvq fit``: what ``--print_config`` shows, as JSON values.
Settings = dict[str, Any]


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


def plan(
    scenes: Sequence[str | Path] = (),
    configs: Sequence[str] = (),
    quantizers: Sequence[str] = (),
    codebooks: Sequence[str] = (),
    seeds: Sequence[int] = (),
    options: Sequence[str] = (),
) -> list[Run]:
    """All runs, scene by scene; of two with the same settings the first.

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
        reader = _Reader(["fit", *given.expand(arguments)])
        text = reader._parser("fit").dump(reader.config["fit"], skip_none=False, format="json")
    settings: Settings = json.loads(text)
    if settings["ckpt_path"] is not None:
        raise ValueError(f"a sweep has checkpoints of its own; leave ckpt_path={settings['ckpt_path']} out")
    trainer, callbacks = settings["trainer"], settings["callbacks"]
    del trainer["default_root_dir"], trainer["run_folder"], callbacks["progress"]
    trainer["logger"] = False
    return settings
