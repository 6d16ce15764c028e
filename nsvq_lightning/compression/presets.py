"""Compress a scene that is already trained: k-means, and the smallest of several settings that is good enough."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.compression.importance import contributions, row_weights, scale_floor
from nsvq_lightning.compression.stored import to_compressed
from nsvq_lightning.compression.viewpoints import decibels, picture_error, pictures
from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.nsvq.file import decode, encode
from nsvq_lightning.io.nsvq.header import frame, unframe
from nsvq_lightning.io.nsvq.precision import OPACITY_ERRORS, Precision, Storage
from nsvq_lightning.quantize import NSVQ, QUANTIZED, Quantizer
from nsvq_lightning.quantize.attributes import attribute_rows
from nsvq_lightning.quantize.kmeans import lookup
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import RawSplats, canonical, detached

log = logging.getLogger(__name__)

# Largest number of views in which errors are measured.
MEASURED = 24


def finetune_codebooks(
    scene: CompressedScene, original: RawSplats, cameras: Sequence[Camera], steps: int, seed: int
) -> CompressedScene:
    """The scene with codebooks, opacities and positions adapted so that its pictures resemble those of the original.

    Codes stay. Each step renders one view of both and moves along the gradient of the mean squared difference (Adam),
    so errors of neighbouring splats come to cancel each other, of which k-means knows nothing. With 16k codebooks,
    100 steps recovered two thirds of the dB that quantization had cost fox in its test views.

    Args:
        scene: The quantized scene, splats in the order of ``original``.
        original: The raw attributes that it stands for.
        cameras: Views, used in random order.
        steps: Number of steps; 0 changes nothing.
        seed: Seed of that order.
    """
    if steps == 0:
        return scene
    codes = {name: torch.from_numpy(rows.astype(np.int64)) for name, rows in scene.codes.items()}
    free = {name: torch.from_numpy(rows.copy()).requires_grad_() for name, rows in scene.codebooks.items()}
    free["opacities"] = original.opacities.clone().requires_grad_()
    free["means"] = original.means.clone().requires_grad_()
    rates = {name: ATTRIBUTES[name].rate for name in free}
    rates["means"] = 3e-5 * float(original.means.std(0).norm())  # nothing is far from its place
    groups = [{"params": [tensor], "lr": rates[name]} for name, tensor in free.items()]
    adam = torch.optim.Adam(groups, eps=1e-15)
    decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.05 ** (1 / steps))  # to a twentieth at the end
    fixed = detached(scene.decode())
    draws, order = generator(seed, 0, "views"), list[int]()
    for _ in range(steps):
        if not order:
            order = torch.randperm(len(cameras), generator=draws).tolist()
        camera = cameras[order.pop()]
        with torch.no_grad():
            target = render(original, camera).image.clamp(0, 1)
        splats = fixed._replace(means=free["means"], opacities=free["opacities"])
        shaped = {name: lookup(free[name], rows).reshape(getattr(fixed, name).shape) for name, rows in codes.items()}
        loss = (render(splats._replace(**shaped), camera).image - target).square().mean()
        adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        decay.step()
    found = {name: tensor.detach().numpy() for name, tensor in free.items()}
    means, opacities = found.pop("means"), found.pop("opacities")
    return replace(scene, means=means, opacities=opacities, codebooks=found)


@dataclass(frozen=True)
class Preset:
    """One compression setting, between large and exact, and small.

    Attributes:
        name: What messages call it.
        codebooks: Number of codes by attribute; empty for no codebooks.
        coarseness: Factor on the errors of :class:`~nsvq_lightning.io.nsvq.precision.Precision`.
    """

    name: str
    codebooks: Mapping[str, int]
    coarseness: float = 1.0


def _sizes(thousands: float) -> dict[str, int]:
    return {name: int(1024 * thousands * share) for name, share in QUANTIZED.items()}


PLAIN = Preset("no codebooks", {})
# Settings without codebooks. They need no k-means, and give smaller files where splats are few.
PLAINS: tuple[Preset, ...] = (Preset("no codebooks, a quarter of the errors", {}, 0.25), PLAIN)

# Settings with codebooks, from the most exact to the smallest.
PRESETS: tuple[Preset, ...] = (
    *(Preset(f"{size:g}k", _sizes(size), 0.5) for size in (128, 64, 32)),
    *(Preset(f"{size:g}k", _sizes(size)) for size in (16, 8, 4, 2, 1, 0.5)),
    Preset("0.5k, twice the errors", _sizes(0.5), 2.0),
    Preset("0.25k, four times the errors", _sizes(0.25), 4.0),
)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A scene compressed at one preset.

    Attributes:
        preset: The setting.
        scene: What is stored.
        storage: How it is stored.
        data: The file's bytes.
        error: Root mean square difference between its pictures and those of the original, for channels in [0, 1].
    """

    preset: Preset
    scene: CompressedScene
    storage: Storage
    data: bytes
    error: float


class Compressor:
    """Compresses one scene at any preset, each at most once.

    Before k-means, scales too small to be visible are raised, and scales and rotations take their canonical form;
    k-means weights rotations and colours by how much each splat contributes to the pictures. After
    it, the scene is tuned until its pictures resemble those of the original.

    Attributes:
        cameras: Views in which errors are measured.

    Args:
        scene: The scene, finite.
        cameras: Views in which the scene is tuned; in some of them errors and contributions are measured.
        storage: Level, and the precision, which presets make coarser or finer.
        seed: Seed of k-means.
        tuning: Steps of tuning, 0 for none.

    Raises:
        ValueError: There are no splats, or no camera shows any of them.
    """

    def __init__(
        self,
        scene: CompressedScene,
        cameras: Sequence[Camera],
        storage: Storage,
        seed: int = 0,
        tuning: int = 0,
    ) -> None:
        if len(scene) == 0 or not cameras:
            raise ValueError(f"cannot compress {len(scene)} splats seen by {len(cameras)} cameras")
        self._splats, self._origin, self._antialiased = detached(scene.decode()), scene.origin, scene.antialiased
        self._views, self.cameras = cameras, cameras[:: -(-len(cameras) // MEASURED)]
        self._storage, self._seed, self._tuning = storage, seed, tuning
        self._pictures = pictures(self._splats, self.cameras, self._antialiased)
        if not any(bool(picture.any()) for picture in self._pictures):
            raise ValueError(
                f"all {len(self.cameras)} pictures of the scene are black, so no error can be measured: photos "
                "(--data.root) must be of this scene, in its coordinates"
            )
        self._done: dict[str, Candidate] = {}

    @cached_property
    def _for_codebooks(self) -> tuple[RawSplats, Tensor]:
        """The splats in the form that codebooks are made for, and the weight of each ``[N]`` in k-means."""
        floor = scale_floor(self._splats.means, self.cameras)
        visible = self._splats.scales if floor is None else self._splats.scales.clamp(min=floor)
        scales, quats, *_ = canonical(visible, self._splats.quats)
        weights = row_weights(contributions(self._splats, self.cameras, render))
        return self._splats._replace(scales=scales, quats=quats), weights

    def at(self, preset: Preset) -> Candidate:
        """The scene at a preset."""
        if preset.name in self._done:
            return self._done[preset.name]
        scene = self._quantized(preset.codebooks)
        errors = {name: preset.coarseness * value for name, value in vars(self._storage.precision).items()}
        least, most = OPACITY_ERRORS
        errors["opacity"] = min(max(errors["opacity"], least), most)
        storage = replace(self._storage, precision=Precision(**errors))
        data = b"".join(frame(*encode(scene, storage)))
        error = self.error(data)
        log.info("%s: %s bytes, error %.4g (%.2f dB)", preset.name, f"{len(data):,}", error, decibels(error))
        return self._done.setdefault(preset.name, Candidate(preset, scene, storage, data, error))

    def error(self, data: bytes) -> float:
        """Root mean square difference between the pictures of a ``.nsvq`` file and those of the scene."""
        return picture_error(decode(*unframe(data)).decode(), self.cameras, self._pictures, self._antialiased)

    def _quantized(self, codebooks: Mapping[str, int]) -> CompressedScene:
        splats, weights = self._for_codebooks if codebooks else (self._splats, None)
        quantizers: dict[str, Quantizer] = {}
        for name, codes in codebooks.items():
            rows = attribute_rows(splats, name)
            if rows.shape[1] == 0:
                continue
            # Scales cover many sizes, all of which count; weights would leave no codes for the small ones.
            scales = name == "scales"
            quantizer = NSVQ(codes, rows.shape[1], start="spread" if scales else "sample")
            quantizer.fit(rows, None if scales else weights, generator(self._seed, 0, "kmeans", name))
            quantizers[name] = cast(Quantizer, quantizer)
        config: dict[str, object] = {"codebooks": {name: len(q.codebook) for name, q in quantizers.items()}}
        if self._antialiased:
            config["antialiased"] = True
        scene = replace(to_compressed(splats, quantizers), config=config, origin=self._origin)
        return finetune_codebooks(scene, splats, self._views, self._tuning, self._seed) if quantizers else scene


def smallest_within(compressor: Compressor, error: float) -> Candidate:
    """The smallest file whose error is at most ``error``.

    Raises:
        ValueError: Even the most exact one has a larger one.
    """
    last = _last(lambda preset: compressor.at(preset).error <= error)
    candidates = [compressor.at(preset) for preset in (*PLAINS, last or PRESETS[0])]
    within = [candidate for candidate in candidates if candidate.error <= error]
    if not within:
        best = min(candidates, key=_error_first)
        raise ValueError(
            f"no setting has an error of at most {error:g}: the most exact one has {best.error:.3g} in "
            f"{len(best.data)} bytes; allow more, or use level 'paper' without codebooks, which loses nothing"
        )
    return min(within, key=lambda candidate: len(candidate.data))


def finest_within(compressor: Compressor, target: int) -> Candidate:
    """The most exact file of at most ``target`` bytes.

    Raises:
        ValueError: Even the smallest one has more.
    """
    last = _last(lambda preset: len(compressor.at(preset).data) > target)
    first = 0 if last is None else PRESETS.index(last) + 1
    candidates = [compressor.at(preset) for preset in (*PLAINS, *PRESETS[first:][:1])]
    within = [candidate for candidate in candidates if len(candidate.data) <= target]
    if not within:
        least = min(len(candidate.data) for candidate in (*candidates, compressor.at(PRESETS[-1])))
        raise ValueError(
            f"the smallest file of this scene has {least} bytes, more than {target}; most of them are positions: "
            "train with fewer splats (--splats)"
        )
    return min(within, key=_error_first)


def _error_first(candidate: Candidate) -> tuple[float, int]:
    return candidate.error, len(candidate.data)


def _last(holds: Callable[[Preset], bool]) -> Preset | None:
    """The last preset for which a condition holds, or None; it must hold up to some preset and not after it."""
    low, high = -1, len(PRESETS)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(PRESETS[middle]) else (low, middle)
    return PRESETS[low] if low >= 0 else None
