"""Compress a scene that is already trained: the last phases of a run, on its own pictures or on photos."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple
from warnings import catch_warnings

import numpy as np
import torch
from lightning.pytorch import Callback
from torch import Tensor

from nsvq_lightning import callbacks as cb
from nsvq_lightning.callbacks.forecast import iteration_seconds
from nsvq_lightning.callbacks.pruning import VIEWS
from nsvq_lightning.compression import viewpoints
from nsvq_lightning.compression.basis import components
from nsvq_lightning.compute.devices import best_device
from nsvq_lightning.compute.memory import trim
from nsvq_lightning.data.datamodule import SceneDataModule
from nsvq_lightning.data.scene import Scene, check_cameras, check_colors, spread, usable
from nsvq_lightning.io.compressed import AnySplats, CompressedScene, on_white, renderer
from nsvq_lightning.io.morton import spatial_order
from nsvq_lightning.io.nsvq.file import decode, encode
from nsvq_lightning.io.nsvq.header import frame, unframe
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.random import generator, top_rows
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.sampling import trained_by
from nsvq_lightning.report.numbers import evaluate
from nsvq_lightning.splats import attributes
from nsvq_lightning.splats.splats import SplatTensors
from nsvq_lightning.top_level import log
from nsvq_lightning.training import importance
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates
from nsvq_lightning.training.run_scene import telling_views
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.trainer import SplatTrainer


class Setting(NamedTuple):
    """How a scene is compressed.

    Attributes:
        splats: How many are left.
        codebooks: The paper's name of their sizes, or "none".
        on_basis: Whether, without codebooks, spherical harmonics are on a basis
            (:func:`nsvq_lightning.compression.basis.components`).
        turn: From the most exact file, 0, to the smallest one, 1, of the same splats.
        more: Codes of spherical harmonics beyond those of the size.
    """

    splats: int
    codebooks: str
    on_basis: bool = False
    turn: float = 0.0
    more: int = 0


# Steps of spherical harmonics on a basis, in the most exact and in the smallest file.
STEPS = (0.2, 1.6)
# In the smallest file, what has no codebooks is so many times coarser: with codebooks positions and opacities, ...
COARSER = 2.0
# ... without any scales, rotations and colours: of equal slope with the steps on plain fox, where twice as coarse saves
# 10 bits a splat for 0.012 dB.
COARSER_ROWS = 4.0
# Bits a splat from which on a file without any codebooks may be better, and spherical harmonics are then on a basis.
ON_BASIS = 90
# Bits of a splat's position and opacity, about.
PLACE = 22.0
# Rather than keep fewer splats than this share, a file takes smaller codebooks.
SHARE = 0.9
# It has at least so many splats, if there are as many.
MIN_SPLATS = 100


def setting_for(size: int, most: int, sh_degree: int, parts: int = 1) -> Setting:
    """The setting with codebooks that ``size`` bytes have room for, about, with at most ``most`` splats.

    Each of the parts that a scene is trained in has codebooks of its own.

    Raises:
        ValueError: There is none.
    """
    dims = attributes.attribute_dims(sh_degree)
    for name in attributes.SIZES:
        sizes = {each: (codes, dims[each]) for each, codes in attributes.codebook_sizes(name).items() if dims[each]}
        fixed, bits = attributes.codebook_bits(sizes)
        fixed *= parts
        room = int((8 * size - fixed) / (PLACE + bits))
        if room >= SHARE * most:
            break
    if room < min(MIN_SPLATS, most):
        raise ValueError(f"{size} bytes leave room for {max(room, 0)} of {most} splats beside codebooks: allow more")
    codes, dim = sizes.get("shN", (0, 1))
    spare = max(0.0, 8 * size - fixed - most * (PLACE + bits))
    more = min(spare / (parts * dim * attributes.ATTRIBUTES["shN"].code_bits), codes, most / (8 * parts))
    return Setting(min(most, room), name, more=int(more))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A setting, and the bytes of the file that it makes."""

    setting: Setting
    data: bytes

    @cached_property
    def scene(self) -> CompressedScene:
        """What the file holds."""
        return decode(*unframe(self.data))


# A file may be smaller by this share than it is to be.
SLACK = 0.01
# How many estimates of what to store in a file are tried.
ESTIMATES = 5
# By so many dB must pictures of harmonics on a basis be nearer to the scene's own, from known cameras, than those of
# codes. Of photos, as much is lost where they are nearer by 2.7 dB (fox), at least 1.5 (plush), -0.2 (bonsai).
LEAD = 1.5
# PSNR of a scene in photos, dB, below which these are not its own: six scenes have 19 or more, in photos of others 11.
MIN_PSNR = 12.0
# Splats that are trained at once, at most: with them, a process has 2 GB. Photos are of the whole, so with photos as
# many times as many are.
AT_ONCE = 750_000
WITH_PHOTOS = 4
# Nepers from the longest axis of a splat to the shortest that shows. Needles and discs of others have axes of almost no
# length, which make their places, and codes of all, finer for nothing: 15 % of a file of such splats, and 2.9 dB.
THINNEST = 7
# Steps of a training.
MIN_STEPS = 20
USUAL_STEPS = 500
# Where fewer splats than this share are left, and so many times as many steps: they have to cover what all did.
THINNED = 0.97
THINNING = 3


@dataclass(eq=False)
class Trainings:
    """How far the trainings of a scene are, and of its parts, which share this.

    Attributes:
        stopped: Whether Ctrl-C has ended one before its end.
        begun: Whether one is done, so that Ctrl-C need not lose all.
    """

    stopped: bool = False
    begun: bool = False


@dataclass(eq=False)
class Compressor:
    """Compresses one scene at any setting; each pair of codebooks and number of splats is trained at most once.

    Small files have codebooks; in larger ones, spherical harmonics, which lose most by that, may be on a basis instead.

    Attributes:
        scene: The scene, finite.
        cameras: Views in which errors are measured; by default some of the photos', or else guessed ones.
        photos: Views to train on; by default, what the cameras see of the scene itself.
        storage: Level and precision.
        seed: Seed of all draws.
        minutes: What one training may take, about.
        steps: Steps of a training, at least 4; None as many as the minutes allow, at most :data:`USUAL_STEPS`, or
            :data:`THINNING` times as many.
        trainings: How far they are.
    """

    scene: CompressedScene
    cameras: Sequence[Camera] = ()
    photos: Scene | None = None
    storage: Storage = field(default_factory=Storage)
    seed: int = 0
    minutes: float = math.inf
    steps: int | None = None
    trainings: Trainings = field(default_factory=Trainings)

    def __post_init__(self) -> None:
        self._splats = self.scene.tensors()
        if self.storage.level != "paper":  # which loses nothing
            shortest = self._splats.scales.amax(1, keepdim=True) - THINNEST
            self._splats = self._splats._replace(scales=self._splats.scales.maximum(shortest))
        self._render = renderer(self.scene)
        if self.photos:
            self.photos = usable(self.photos)
        # Those of the photos, where the cameras are theirs.
        views = self.photos.train if self.photos and not self.cameras else ()
        self._known = self.photos.train_cameras if self.photos else self.cameras
        cameras = self.cameras or self._known or viewpoints.square_views(self._splats, viewpoints.VIEWS)
        # Of a walk, few show each place. All pictures are held.
        most = min(max(viewpoints.VIEWS, len(cameras) // 4), 4 * viewpoints.VIEWS)
        self.cameras, self._views = spread(cameras, most), spread(views, most)
        self._is_own = self.photos is None or self.photos.split == viewpoints.OWN
        if not self._is_own and (likeness := self.quality(self._splats)) < MIN_PSNR:
            raise ValueError(
                f"photos of {self.data.scene.root} are not of this scene: it has {likeness:.1f} dB there; are they RGB?"
            )
        # Of settings that are not turned, which needs no training.
        self._trained = cache(self._train)
        self._weights = cache(self._row_weights)

    @property
    def stopped(self) -> bool:
        """Whether Ctrl-C has ended a training before its end; further ones take a few steps."""
        return self.trainings.stopped

    @cached_property
    def measure(self) -> viewpoints.Measure:
        """Measures errors, of photos where these count."""
        masks = [self.data.scene.images[view].mask for view in spread(self._views, viewpoints.MEASURED)]
        return viewpoints.Measure(self._splats, self.cameras, self._render, masks)

    @cached_property
    def data(self) -> SceneDataModule:
        """The views to train on."""
        return SceneDataModule(self.photos or viewpoints.own_scene(self._splats, self.cameras, self._render), self.seed)

    def best(self, splats: int, codebooks: str | None, target_bytes: int | None, max_error: float | None) -> Candidate:
        """The smallest file with an error, the best one of a size, or that with these codebooks; the first asked for.

        Raises:
            ValueError: The limit cannot be met.
        """
        if max_error is not None:
            return self.smallest_within(max_error, splats)
        if target_bytes is not None:
            return self.finest_within(target_bytes, splats)
        coded = self.at(Setting(splats, codebooks or attributes.DEFAULT_SIZE))
        if codebooks or self.scene.sh_degree or splats < len(self.scene):
            return coded
        # Few splats without harmonics are smaller without codebooks, which take no training.
        return min(coded, self.at(Setting(splats, "none")), key=lambda each: len(each.data))

    def at(self, setting: Setting) -> Candidate:
        """The scene at a setting."""
        whole = setting._replace(on_basis=False, turn=0.0)
        scene = self._trained(whole)
        if setting.on_basis:
            exact, small = STEPS
            step = exact * (small / exact) ** setting.turn
            rows, basis = components(torch.from_numpy(scene.raw["shN"]), self._weights(whole), step)
            scene = replace(scene, raw={**scene.raw, "shN": rows}, bases={"shN": basis})
        plain = [name for name in ("scales", "quats", "sh0") if name in scene.raw]
        times = (COARSER_ROWS if plain else COARSER) ** setting.turn
        precision = self.storage.precision
        if times > 1:
            names = plain or ["position", "opacity"]
            precision = replace(precision, **{name: float(f"{times * getattr(precision, name):.3g}") for name in names})
        return Candidate(setting, b"".join(frame(*encode(scene, replace(self.storage, precision=precision)))))

    def _row_weights(self, setting: Setting) -> Tensor:
        """How much each splat counts where harmonics are put on a basis ``[N]``."""
        splats = self._trained(setting).tensors()
        return importance.row_weights(importance.contributions(splats, self.cameras, self._render)).sqrt()

    def error(self, candidate: Candidate) -> float:
        """Root mean square difference between its pictures and those of the original, for channels in [0, 1]."""
        trim()
        return self.measure.error(candidate.scene.tensors())

    def quality(self, splats: SplatTensors) -> float:
        """PSNR of splats in views that were not trained on, in dB: against their photos, if there are any."""
        views = self.data.scene
        return evaluate(self._render, splats, map(views.view, spread(views.test, viewpoints.MEASURED)))[0]

    def finest_within(self, target: int, splats: int) -> Candidate:
        """The best file of at most ``target`` bytes and this many splats: with or without codebooks, by its quality.

        Raises:
            ValueError: None was found.
        """
        fits = None
        if 8 * target >= ON_BASIS * splats or not self.scene.sh_degree:
            plain = Setting(splats, "none", self.scene.sh_degree > 0)
            exact = self.at(plain._replace(on_basis=False))
            is_exact = len(exact.data) <= target
            fits = exact if is_exact else self._fitting(plain, target)
            if is_exact and plain.on_basis and not self.stopped and (other := self._fitting(plain, target)):
                # Faint harmonics have finer steps on a basis.
                fits = other if self.error(other) < (1 - SLACK) * self.error(exact) else exact
            if fits and (self.stopped or (is_exact and self._is_own)):
                return fits
        coded = self._finest_coded(target, splats, not fits)
        if fits and coded:
            lead = LEAD if self._is_own and self._known else 0
            return max(fits, coded, key=lambda each: self.quality(each.scene.tensors()) - lead * each.setting.on_basis)
        if found := fits or coded:
            return found
        raise ValueError(f"found no file of {target} bytes: allow more bytes or time")

    def _fitting(self, setting: Setting, target: int) -> Candidate | None:
        """The candidate nearest to the most exact one of at most ``target`` bytes."""
        return self._between(setting, lambda each: len(each.data) <= target, (1 - SLACK) * target)

    def _finest_coded(self, target: int, splats: int, needed: bool) -> Candidate | None:
        """The best file with codebooks of at most ``target`` bytes; too few are refused only where it is needed."""
        tried: list[Candidate | None] = []
        before, asked = None, float(target)
        for _ in range(ESTIMATES):
            try:
                setting = setting_for(int(asked), splats, self.scene.sh_degree, self.parts)
            except ValueError:
                if needed and before is None:  # later ones are of estimates
                    raise
                break
            found = self._fitting(setting, target)
            if not found and setting.more:
                found = self._fitting(setting._replace(more=0), target)
            tried.append(found)
            # There may be more room than the largest codebooks take.
            if self.stopped or (found and (len(found.data) >= (1 - 2 * SLACK) * target or setting == before)):
                break
            before = setting
            # What the estimate made of its bytes.
            asked *= (1 - SLACK / 2) * target / len((found or self.at(setting._replace(turn=1.0))).data)
        if any(tried) and setting.splats < splats and not self.stopped:
            # All splats with the next smaller codebooks take fewer bytes, and may be better.
            smaller = dict(pairwise(attributes.SIZES)).get(setting.codebooks, setting.codebooks)
            tried.append(self._fitting(Setting(splats, smaller), target))
        return min(filter(None, tried), key=self.error, default=None)

    def smallest_within(self, error: float, splats: int) -> Candidate:
        """The smallest file with this many splats and an error of at most ``error``.

        Raises:
            ValueError: Even the most exact one has a larger one.
        """

        def fits(candidate: Candidate) -> bool:
            return self.error(candidate) <= error

        plain = self.at(Setting(splats, "none"))
        found = [plain] if fits(plain) else []
        settings = [Setting(splats, name) for name in attributes.SIZES]
        if self.scene.sh_degree:
            settings.insert(0, Setting(splats, "none", True))
        first, end = -1, len(settings)  # the last one with a file that fits, and the first one without
        while end - first > 1 and not self.stopped:
            middle = (first + end) // 2
            candidate = self._between(settings[middle], fits, small=False)
            if candidate is None:
                end = middle
            else:
                first = middle
                found.append(candidate)
        if not found:
            finest = self.at(settings[0]) if settings[0].on_basis else plain
            least = min((plain, finest), key=self.error)
            raise ValueError(
                f"no setting has an error of at most {error:g}: the most exact one has {self.error(least):.3g} in "
                f"{len(least.data)} bytes; allow more, or use level 'paper' without codebooks, which loses nothing"
            )
        return min(found, key=lambda each: len(each.data))

    def _between(
        self, setting: Setting, fits: Callable[[Candidate], bool], close: float = math.inf, small: bool = True
    ) -> Candidate | None:
        """The candidate nearest to the most exact one, or with ``small`` False to the smallest, that fits; or None.

        One of ``close`` bytes is near enough.
        """
        good, bad = (1.0, 0.0) if small else (0.0, 1.0)
        best = self.at(setting._replace(turn=bad))
        if fits(best):
            return best
        best = self.at(setting._replace(turn=good))
        if not fits(best):
            return None
        while abs(good - bad) > 0.02 and len(best.data) < close:
            middle = (good + bad) / 2
            candidate = self.at(setting._replace(turn=middle))
            if fits(candidate):
                best, good = candidate, middle
            else:
                bad = middle
        return best

    def _train(self, setting: Setting) -> CompressedScene:
        """Select and quantize splats, and train what is left; in a few steps if Ctrl-C comes after other trainings."""
        try:
            return self._train_once(setting)
        except KeyboardInterrupt:
            if self.stopped or not self.trainings.begun:
                raise
            self.trainings.stopped = True
        trim()  # now that the error does not hold what has failed
        return self._train_once(setting)

    def _train_once(self, setting: Setting) -> CompressedScene:
        """Select and quantize splats, and train what is left."""
        sizes = {} if setting.codebooks == "none" else attributes.codebook_sizes(setting.codebooks)
        if "shN" in sizes:
            sizes["shN"] += setting.more
        if self.parts > 1 and (sizes or setting.splats < len(self.scene)):
            return self._train_parts(setting)
        steps = self.usual_steps(setting.splats) if self.steps is None else self.steps
        steps = 4 if self.stopped else max(4, steps)
        prune = steps // 4 if setting.splats < len(self.scene) else 0
        module = SplatModule(
            splats=self._splats,
            codebooks=sizes or None,
            # A trained scene is in its place; what is left of some splats moves into that of the others.
            rates=LearningRates(means=4e-5 if prune else LearningRates.means_final),
            background="white" if any(self.scene.background) else "black",
            antialiased=self.scene.antialiased,
            seed=self.seed,
            storage=self.storage,
        )
        # Where none go, harmonics of the splats themselves need no training beside their codes: ±0.006 dB on fox and
        # bonsai, and without their moments a million splats take 1 GB less. Where some go, it is worth 0.06 dB.
        if "shN" in sizes and not prune:
            module.splats.shN = torch.nn.Parameter(self._splats.shN, requires_grad=False)
        if sizes or prune or not self._is_own:  # its own pictures teach nothing new
            self._fit(module, steps, _callbacks(setting.splats, steps, prune, bool(sizes)))
        found = replace(module.compressed().finite(), origin=self.scene.origin, cameras=self.scene.cameras)
        del module
        trim()
        self.trainings.begun = True
        return found

    @cached_property
    def parts(self) -> int:
        """In how many parts it is trained, each on its own pictures: as many halves of halves as are small enough."""
        most = AT_ONCE * (1 if self._is_own else WITH_PHOTOS)
        return 1 << math.ceil(math.log2(len(self.scene) / AT_ONCE)) if len(self.scene) > most else 1

    @cached_property
    def _effects(self) -> Tensor:
        """How much pictures of the whole are likely to change without each splat ``[N]``.

        In those of a part alone, what shows through its splats is missing, so all of them seem to be needed.
        """
        splats, signs = importance.below_cap(self._splats), generator(self.seed, 0, "signs")
        views = map(self.data.scene.view, telling_views(self.data.scene, VIEWS))
        found = (importance.sensitivity(splats, each.camera, self._render, signs, each.mask)[0] for each in views)
        return importance.likely_effects(splats, sum((each.opacities for each in found), torch.zeros(())))

    def _train_parts(self, setting: Setting) -> CompressedScene:
        """Train the parts of a large scene, one after another, each with codebooks of its own.

        It is trained on pictures of it alone: from cameras of the scene that show it, or from guessed ones. The minutes
        are for a million splats.
        """
        found: list[CompressedScene] = []
        for number, rows in enumerate(np.array_split(spatial_order(self.scene.means), self.parts)):
            log.info(f"part {number + 1} of {self.parts}")
            part = self.scene.take(rows)
            cameras = viewpoints.showing(self._known, part.means, viewpoints.VIEWS)
            own = replace(self, scene=part, cameras=cameras, photos=None, minutes=self.minutes * len(part) / 1e6)
            left = max(1, setting.splats * len(part) // len(self.scene))
            if left < len(part):  # in its pictures are those that go, too
                _, own._splats = own.data, own._splats.take(top_rows(self._effects[rows], left))
            found.append(own._train(setting._replace(splats=left)))
            del own, part
            trim()
        return replace(CompressedScene.joined(found), cameras=self.scene.cameras)

    def _fit(self, module: SplatModule, steps: int, callbacks: list[Callback]) -> None:
        """Train without Lightning's messages; Ctrl-C ends it early once there are codes."""
        chatter = logging.getLogger("lightning.pytorch.utilities.rank_zero")
        level = chatter.level
        chatter.setLevel(logging.WARNING)
        trim()
        try:
            with catch_warnings(action="ignore"):
                SplatTrainer(max_steps=steps, callbacks=callbacks, enable_checkpointing=False).fit(module, self.data)
        except (KeyboardInterrupt, SystemExit):  # Lightning turns the one into the other
            if module.phase < Phase.QUANTIZE or not all(getattr(q, "fitted", True) for q in module.quantizers.values()):
                raise KeyboardInterrupt from None
            self.trainings.stopped = True
        finally:
            chatter.setLevel(level)

    def usual_steps(self, splats: int) -> int:
        """How many steps a training of this many of the splats takes."""
        usual = USUAL_STEPS * (THINNING if splats < THINNED * len(self.scene) else 1)
        return max(MIN_STEPS, min(self._affordable, usual))

    @cached_property
    def _affordable(self) -> int:
        """How many steps the minutes are enough for."""
        seconds = iteration_seconds(self.data.scene, [(1.0, len(self.scene))], best_device())
        return int(min(60 * self.minutes / seconds, 1e9))


def _callbacks(splats: int, steps: int, prune: int, coded: bool) -> list[Callback]:
    """What selects splats before the first of the steps, and places and freezes codes after those of pruning."""
    phases = cb.PhaseSchedule(
        total=steps,
        reference_total=None,
        min_finetune=1,
        warmup_end=0,
        prune_end=prune,
        quantize_end=prune + 2 * (steps - prune) // 3 if coded else steps,
        position_decay=max(1, prune),
    )
    selection = [cb.SplatBudget(splats=splats), phases, cb.LearningRateDecay(start=prune), cb.SplatSelection()]
    codes = [cb.CanonicalCovariance(), cb.CodebookInit(), cb.FiniteCodes(), cb.FreezeCodes()]
    return [*selection, *codes, cb.SplatProgressBar()]


@torch.inference_mode(False)
def compress(
    splats: AnySplats,
    cameras: Sequence[Camera] = (),
    photos: Sequence[Tensor] = (),
    *,
    target_bytes: int | None = None,
    max_error: float | None = None,
    codebooks: str | None = attributes.DEFAULT_SIZE,
    left: int | None = None,
    antialiased: bool = False,
    background: Literal["black", "white"] = "black",
    **settings: Any,
) -> CompressedScene:
    """A scene that was trained elsewhere, made small as ``nsvq compress`` does; :func:`nsvq_lightning.save` writes it.

    Args:
        splats: Raw attributes, such as those of gsplat or nerfstudio by name: ``means [N, 3]``, ``quats [N, 4]`` wxyz,
            log-``scales [N, 3]``, logits ``opacities [N]``, ``sh0 [N, 1, 3]`` and ``shN [N, K, 3]``.
        cameras: Those that the scene was trained by; without any, they are guessed.
        photos: Of each camera ``[H, W, 3]`` RGB, uint8, or float in [0, 1]; without any, splats and codebooks are
            fitted to what the cameras see of the scene itself.
        target_bytes: Most bytes of a ``.nsvq`` file.
        max_error: Instead, largest root mean square difference of pictures, for channels in [0, 1].
        codebooks: Instead, the paper's name of their sizes; ``"none"`` or None for none.
        left: How many splats are left; None leaves all.
        antialiased: Whether the splats are rendered with anti-aliasing.
        background: What they are shown in front of, in ``photos``, too.
        settings: ``seed`` (0), ``minutes`` (no limit; 2 in ``nsvq compress``) and ``steps`` (500, or 1500 with fewer
            splats) of :class:`Compressor`.

    Raises:
        ValueError: The splats are empty or not finite, cameras do not show them, photos do not fit the cameras, or a
            limit cannot be met, or there are two; another background.
    """
    if None not in (target_bytes, max_error):
        raise ValueError("give target_bytes or max_error, not both")
    scene = CompressedScene.from_splats(splats).finite()
    if antialiased:
        scene = replace(scene, config={**scene.config, "antialiased": True})
    if background == "white":
        scene = on_white(scene)
    elif background != "black":
        raise ValueError(f"background must be black or white, got {background!r}")
    if cameras:
        check_cameras(cameras, scene.means)
        scene = replace(scene, cameras=trained_by(cameras))
    shown = [torch.as_tensor(photo) for photo in photos]
    views = viewpoints.own_scene(scene.tensors(), cameras, photos=shown) if shown else None
    if views:
        check_colors(views, scene.means, scene.values("sh0"))
    compressor = Compressor(scene, cameras, views, **settings)
    left = len(scene) if left is None else min(left, len(scene))
    return compressor.best(left, codebooks or "none", target_bytes, max_error).scene
