"""Which runs a sweep is made of: scenes × seeds × configurations × quantizers × codebook sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from nsvq_lightning.commands.arguments import find_config
from nsvq_lightning.commands.sweep.settings import Settings, digest, resolve
from nsvq_lightning.quantize.attributes import codebook_sizes

__all__ = ["Request", "Run", "plan"]

DEFAULTS = "default"
"""Name of the settings without any configuration file."""


@dataclass(frozen=True)
class Request:
    """What the command line asks for; an empty list leaves the choice to the configurations.

    Attributes:
        scenes: COLMAP folders.
        configs: Configuration files, or names of shipped ones.
        quantizers: Classes of quantizers, for the configurations that have codebooks.
        codebooks: Codebook sizes, for the configurations that have codebooks.
        seeds: Seeds of the draws and of the order of the views.
        max_steps: Iterations of every run.
        options: More options of ``nsvq fit``, for every run.
    """

    scenes: tuple[Path, ...] = ()
    configs: tuple[str, ...] = ()
    quantizers: tuple[str, ...] = ()
    codebooks: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    max_steps: int | None = None
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Run:
    """One run: what tells it from the others, and all its settings.

    Attributes:
        scene: Name of the scene's folder.
        config: Name of the configuration.
        quantizer: Class of the quantizer; empty without codebooks.
        codebooks: The paper's name of the sizes, or codes by attribute; empty without codebooks.
        seed: Seed.
        settings: Everything ``nsvq fit`` needs.
    """

    scene: str
    config: str
    quantizer: str
    codebooks: str
    seed: int
    settings: Settings

    @property
    def title(self) -> str:
        """The names, without spaces: a part of a file name."""
        parts = [self.scene, self.config, self.quantizer, self.codebooks.replace(" ", "_"), f"seed{self.seed}"]
        return "-".join(part for part in parts if part)

    @property
    def steps(self) -> int:
        """Iterations."""
        return int(self.settings["trainer"]["max_steps"])


def plan(request: Request) -> list[Run]:
    """All runs, those that share most next to each other; of two with the same settings the first.

    Raises:
        SystemExit: A configuration or option is wrong; a line on stderr says how.
        ValueError: A codebook size is unknown, a scene is no folder, two scenes or configurations have one name, or the
            data module takes no root or seed.
    """
    for name in request.codebooks:
        codebook_sizes(name)
    for root in request.scenes:
        if not root.is_dir():
            raise ValueError(f"{root} is no folder; --scenes takes COLMAP folders with commas between them")
    _check_names("scenes", [_scene_name(scene) for scene in request.scenes])
    _check_names("configurations", [Path(config).stem for config in request.configs])
    variants = [variant for config in request.configs or (None,) for variant in _variants(request, config)]
    places = product(request.scenes or (None,), request.seeds or (None,), variants)
    runs: dict[str, Run] = {}
    for scene, seed, (config, settings) in places:
        run = _place(config, settings, scene, seed)
        runs.setdefault(digest(run.settings), run)
    return list(runs.values())


def _check_names(what: str, names: Sequence[str]) -> None:
    double = [name for name, count in Counter(names).items() if count > 1]
    if double:
        raise ValueError(f"two {what} are called {double[0]}: results could not be told apart; rename one of them")


def _scene_name(root: Path) -> str:
    return root.resolve().name


def _variants(request: Request, config: str | None) -> Iterator[tuple[str, Settings]]:
    """The settings of a configuration with each quantizer and each size; those without codebooks only once."""
    arguments = [] if config is None else ["--config", find_config(config)]
    if request.scenes:
        arguments.append(f"--data.root={request.scenes[0]}")
    if request.max_steps is not None:
        arguments.append(f"--trainer.max_steps={request.max_steps}")
    arguments += request.options
    name = DEFAULTS if config is None else Path(config).stem
    settings = resolve(arguments)
    if settings["model"]["codebooks"] is None:
        yield name, settings
        return
    quantized = [resolve([*arguments, f"--model.quantizer={quantizer}"]) for quantizer in request.quantizers]
    for variant, size in product(quantized or [settings], request.codebooks or (None,)):
        yield name, variant if size is None else _set(variant, "model", codebooks=size)


def _place(config: str, settings: Settings, scene: Path | None, seed: int | None) -> Run:
    """The run of a variant on a scene with a seed."""
    data = settings["data"]["init_args"]
    if not {"root", "seed"} <= data.keys():
        kind = settings["data"]["class_path"]
        raise ValueError(f"{kind} takes no root or no seed, by which a sweep tells its runs apart; give it both")
    root = Path(data["root"]) if scene is None else scene
    # Absolute, so that the same sweep started from another folder finds its runs.
    data = data | {"root": str(root.resolve())}
    if seed is not None:
        settings = _set(settings, "model", seed=seed)
        data |= {"seed": seed}
    settings = _set(settings, "data", init_args=data)
    model = settings["model"]
    quantized = model["codebooks"] is not None
    return Run(
        scene=_scene_name(root),
        config=config,
        quantizer=model["quantizer"]["class_path"].rpartition(".")[2] if quantized else "",
        codebooks=_sizes(model["codebooks"]),
        seed=model["seed"],
        settings=settings,
    )


def _sizes(codebooks: str | dict[str, int] | None) -> str:
    if isinstance(codebooks, dict):
        return " ".join(f"{name}={codes}" for name, codes in codebooks.items())
    return codebooks or ""


def _set(settings: Settings, part: str, **values: Any) -> Settings:
    """A copy with other values in one part."""
    copy = deepcopy(settings)
    copy[part] |= values
    return copy
