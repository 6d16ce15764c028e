"""Compress a scene that is already trained: the last phases of a run, on its own pictures or on photos."""

import logging
import math
import timeit
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from torch import Tensor

from nsvq_lightning.callbacks import LearningRateDecay, PhaseSchedule, SplatBudget, standard
from nsvq_lightning.compression.importance import (
    below_cap,
    contributions,
    likely_effects,
    most_contributing,
    row_weights,
    sensitivity,
)
from nsvq_lightning.compression.setting import STEPS, Setting, setting_for
from nsvq_lightning.compression.stored import components
from nsvq_lightning.compression.viewpoints import Measure
from nsvq_lightning.compute.devices import best_device
from nsvq_lightning.compute.memory import trim
from nsvq_lightning.data.datamodule import SceneDataModule
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.file import decode, encode
from nsvq_lightning.io.nsvq.header import frame, unframe
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.attributes import SIZES, codebook_sizes
from nsvq_lightning.splats.splats import Splats, detached
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.trainer import SplatTrainer


@dataclass(frozen=True, eq=False)
class Candidate:
    """A setting, and the bytes of the file that it makes."""

    setting: Setting
    data: bytes

    @cached_property
    def scene(self) -> CompressedScene:
        """What the file holds."""
        return decode(*unframe(self.data))


# Shares of the trained splats that are stored: those that are missed least go where a file is too large.
KEPT = 1.0, 0.97
# Most views in which contributions are measured.
MOST_VIEWS = 96
# A file may be this much smaller than it is to be; so many estimates of what to store in it are tried.
SLACK, ESTIMATES = 0.01, 5
# Steps of a training, and how many times as many where fewer splats than this share take time to cover what all did.
FEWEST_STEPS, USUAL_STEPS, THINNING, THINNED = 20, 500, 3, 0.97


def _turned(setting: Setting, turn: float) -> Setting:
    """The setting with its step, or else its share of splats, from the most exact at 0 to the smallest at 1."""
    name, (low, high) = ("step", STEPS) if setting.step else ("kept", KEPT)
    return replace(setting, **{name: low * (high / low) ** turn})


class Compressor:
    """Compresses one scene at any setting; each pair of codebooks and number of splats is trained at most once.

    Small files have codebooks; in larger ones, spherical harmonics, which lose most by that, are on a basis.

    Attributes:
        stopped: Whether Ctrl-C has ended a training before its end.

    Args:
        scene: The scene, finite.
        data: Views to train on.
        measure: Measures errors.
        storage: Level and precision.
        seed: Seed of all draws.
        minutes: What one training may take, about.
        steps: Steps of a training, at least 4; None as many as the minutes allow, at most :data:`USUAL_STEPS`, or
            :data:`THINNING` times as many.
    """

    def __init__(
        self,
        scene: CompressedScene,
        data: SceneDataModule,
        measure: Measure,
        storage: Storage,
        seed: int = 0,
        minutes: float = math.inf,
        steps: int | None = None,
    ) -> None:
        self._scene, self._data, self._measure, self._storage, self._seed = scene, data, measure, storage, seed
        self._splats = detached(scene.decode())
        self._render = partial(render, antialiased=scene.antialiased)
        self._steps, self._minutes = steps, minutes
        self._trained: dict[Setting, tuple[CompressedScene, Tensor]] = {}
        self._effects: dict[Setting, Tensor] = {}
        self.stopped = False

    def at(self, setting: Setting) -> Candidate:
        """The scene at a setting."""
        key = replace(setting, step=0.0, kept=1.0)
        if key not in self._trained:
            scene = self._train(setting)
            cameras = [self._data.scene.cameras[index] for index in self._data.scene.some_train(MOST_VIEWS)]
            weights = row_weights(contributions(scene.decode(), cameras, self._render)).sqrt()
            self._trained[key] = scene, weights
        scene, weights = self._trained[key]
        if setting.step:
            rows, basis = components(torch.from_numpy(scene.raw["shN"]), weights, setting.step)
            scene = replace(scene, raw={**scene.raw, "shN": rows}, bases={"shN": basis})
        if setting.kept < 1:
            if key not in self._effects:
                self._effects[key] = self._likely_effects(scene)
            kept = most_contributing(self._effects[key], math.ceil(setting.kept * len(scene)))
            scene = scene.take(kept.numpy()).in_use()
        return Candidate(setting, b"".join(frame(*encode(scene, self._storage))))

    def _likely_effects(self, scene: CompressedScene) -> Tensor:
        """How much pictures are likely to change without each splat ``[N]``."""
        splats, views = below_cap(scene.decode()), self._data.scene
        squares = torch.zeros_like(splats.opacities)
        for index in views.some_train(MOST_VIEWS):
            signs = generator(self._seed, 0, "signs", index)
            squares += sensitivity(splats, views.cameras[index], self._render, signs)[0].opacities
        return likely_effects(splats, squares)

    def error(self, candidate: Candidate) -> float:
        """Root mean square difference between its pictures and those of the original, for channels in [0, 1]."""
        return self._measure.error(candidate.scene.decode())

    def finest_within(self, target: int, splats: int) -> Candidate:
        """The best file of at most ``target`` bytes and this many splats.

        Raises:
            ValueError: None was found.
        """
        best: Candidate | None = None
        asked, near = float(target), (1 - SLACK) * target
        for _ in range(ESTIMATES):
            setting = setting_for(int(asked), splats, self._scene.sh_degree)
            if setting.codebooks == "none" and len((exact := self.at(replace(setting, step=0.0))).data) <= target:
                return exact
            found = self._between(setting, True, lambda each: len(each.data) <= target, lambda size: size >= near)
            if found and (best is None or len(found.data) > len(best.data)):
                best = found
            if self.stopped or (found and (setting.step or len(found.data) >= (1 - 2 * SLACK) * target)):
                break
            # What the estimate made of its bytes.
            asked *= (1 - SLACK / 2) * target / len((found or self.at(_turned(setting, 1.0))).data)
        if best is None:
            raise ValueError(f"found no file of {target} bytes: allow more {'time' if self.stopped else 'bytes'}")
        return best

    def smallest_within(self, error: float, splats: int) -> Candidate:
        """The smallest file with this many splats and an error of at most ``error``.

        Raises:
            ValueError: Even the most exact one has a larger one.
        """

        def fits(candidate: Candidate) -> bool:
            return self.error(candidate) <= error

        plain, settings = self.at(Setting(splats, "none")), [Setting(splats, name) for name in SIZES]
        if self._scene.sh_degree:
            settings.insert(0, Setting(splats, "none", STEPS[0]))
        found, first, end = [plain] if fits(plain) else [], -1, len(settings)
        while end - first > 1 and not self.stopped:
            middle = (first + end) // 2
            candidate = self._between(settings[middle], False, fits, lambda _: False)
            first, end = (first, middle) if candidate is None else (middle, end)
            found += [] if candidate is None else [candidate]
        if not found:
            raise ValueError(
                f"no setting has an error of at most {error:g}: the most exact one has {self.error(plain):.3g} in "
                f"{len(plain.data)} bytes; allow more, or use level 'paper' without codebooks, which loses nothing"
            )
        return min(found, key=lambda each: len(each.data))

    def _between(
        self, setting: Setting, small: bool, fits: Callable[[Candidate], bool], is_close: Callable[[int], bool]
    ) -> Candidate | None:
        """The candidate nearest to the most exact one, or with ``small`` False to the smallest, that fits; or None."""
        good, bad = (1.0, 0.0) if small else (0.0, 1.0)
        for turn in (bad, good):
            best = self.at(_turned(setting, turn))
            if fits(best):
                break
        else:
            return None
        while turn != bad and abs(good - bad) > 0.02 and not is_close(len(best.data)):
            middle = (good + bad) / 2
            candidate = self.at(_turned(setting, middle))
            if fits(candidate):
                best, good = candidate, middle
            else:
                bad = middle
        return best

    def _train(self, setting: Setting) -> CompressedScene:
        """Select and quantize splats, and train what is left."""
        sizes = {} if setting.codebooks == "none" else dict(codebook_sizes(setting.codebooks))
        if "shN" in sizes:
            sizes["shN"] += setting.more
        steps = max(4, self._steps or self.usual_steps(setting.splats))
        prune = steps // 4 if setting.splats < len(self._scene) else 0
        quantize = prune + 2 * (steps - prune) // 3 if sizes else steps
        phases = {"warmup_end": 0, "prune_end": prune, "quantize_end": quantize, "position_decay": max(1, prune)}
        module = SplatModule(
            splats=Splats.from_tensors(*(tensor.clone() for tensor in self._splats)),
            codebooks=sizes or None,
            # A trained scene is in its place; what is left of some splats moves into that of the others.
            rates=LearningRates(means=4e-5 if prune else LearningRates.means_final),
            antialiased=self._scene.antialiased,
            seed=self._seed,
            storage=self._storage,
        )
        if sizes or prune:
            names = "density", "sh_degree", "codebook_replacement", "report", "live", "export", "predictions"
            callbacks = standard(
                phases=PhaseSchedule(total=steps, reference_total=None, min_finetune=1, **phases),
                budget=SplatBudget(splats=setting.splats),
                rate_decay=LearningRateDecay(start=prune),
                **dict.fromkeys((*names, "checkpoint")),
            )
            chatter = logging.getLogger("lightning.pytorch")
            level = chatter.level
            chatter.setLevel(logging.WARNING)
            trainer = SplatTrainer(max_steps=steps, callbacks=callbacks, enable_checkpointing=False)
            try:
                trainer.fit(module, self._data)
            except (KeyboardInterrupt, SystemExit):  # Lightning turns the one into the other
                if module.phase < Phase.QUANTIZE:
                    raise
                self.stopped = True
            finally:
                chatter.setLevel(level)
        found = replace(module.compressed().finite(), origin=self._scene.origin)
        del module
        trim()
        return found

    def usual_steps(self, splats: int) -> int:
        """How many steps a training of this many of the splats takes."""
        usual = USUAL_STEPS * (THINNING if splats < THINNED * len(self._scene) else 1)
        return max(FEWEST_STEPS, min(self._affordable, usual))

    @cached_property
    def _affordable(self) -> int:
        """How many steps the minutes are enough for."""
        device = best_device()
        leaves = type(self._splats)(*(tensor.to(device).clone().requires_grad_() for tensor in self._splats))

        def step() -> None:
            self._render(leaves, self._measure.cameras[0]).image.sum().backward()  # type: ignore[no-untyped-call]
            torch.get_device_module(device).synchronize()

        return int(min(60 * self._minutes / (2 * min(timeit.repeat(step, number=1, repeat=3))), 1e9))
