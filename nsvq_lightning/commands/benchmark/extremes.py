"""Small scenes that go to the limits of float32, or have numbers that are not finite."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark.workloads import Workload
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.splats.splats import ATTRIBUTES, RawSplats

__all__ = ["BROKEN", "BROKEN_ROWS", "CAMERAS", "SPLATS", "Extreme", "extremes"]

SPLATS, CAMERAS, BROKEN = "extreme splats", "extreme cameras", "non-finite numbers"
"""Kinds of scenes."""
BROKEN_ROWS = 7
"""Splats of a broken scene with a number that is not finite."""
WIDTH, HEIGHT = 72, 48
DISTANCE = 4.0
BACKGROUND = (0.2, 0.3, 0.4)
SCALES = (1e-12, 1e-6, 1.0, 1e6, 1e12)
FAR = 1e6
"""Scene units."""


@dataclass(frozen=True, eq=False)
class Extreme:
    """A scene at a limit.

    Attributes:
        kind: :data:`SPLATS`, :data:`CAMERAS` or :data:`BROKEN`.
        workload: The view, and its splats with finite numbers.
        planted: Splats beside them with one non-finite number each, ``[B]``.
        culprit: The attribute that has these numbers; empty where all are finite.
    """

    kind: str
    workload: Workload
    planted: RawSplats
    culprit: str = ""

    @property
    def name(self) -> str:
        """Name in the tables."""
        return self.workload.name


def extremes(count: int, crowd: int) -> list[Extreme]:
    """All scenes, the same numbers at every call.

    Args:
        count: Splats of a scene.
        crowd: Splats of the scene that has all of them on one pixel.
    """
    splats = _splats(count)
    nothing = RawSplats(*(tensor[:0] for tensor in splats))
    scenes = [(SPLATS, _workload(*scene)) for scene in (*_shapes(splats), *_places(splats))]
    scenes += [(SPLATS, _workload(*scene)) for scene in _numbers(splats, nothing, crowd)]
    scenes += [(CAMERAS, _workload(*scene)) for scene in _cameras(splats)]
    return [*(Extreme(kind, workload, nothing) for kind, workload in scenes), *_broken(splats)]


def _splats(count: int) -> RawSplats:
    """Splats in a ball around the origin, which the camera has in its middle."""
    draw = generator(0, 0, "extremes")

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=draw)

    return RawSplats(
        0.8 * normal(3), normal(4), 0.6 * normal(3) - 2.5, 1.5 * normal(), normal(1, 3), 0.2 * normal(15, 3)
    )


def _camera(width: int = WIDTH, height: int = HEIGHT, origin: float = 0.0) -> Camera:
    """A camera in front of the ball, slightly rotated; ``origin`` is how far the ball is from that of the world."""
    focal, angle = 0.9 * max(width, height), torch.tensor(0.3, dtype=torch.float64)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, 1.1 * focal, height / 2], [0.0, 0.0, 1.0]])
    view = torch.eye(4, dtype=torch.float64)
    view[0, 0] = view[2, 2] = angle.cos()
    view[0, 2], view[2, 0] = angle.sin(), -angle.sin()
    view[:3, 3] = torch.tensor([0.1, -0.05, DISTANCE]) - view[:3, :3] @ torch.full((3,), origin, dtype=torch.float64)
    return Camera(K, view.float(), width, height)


def _workload(name: str, splats: RawSplats, camera: Camera | None = None) -> Workload:
    camera = _camera() if camera is None else camera
    shape = camera.height, camera.width, 3
    gradient = torch.randn(shape, generator=generator(0, 0, "image gradient")) / math.prod(shape)
    return Workload(name, splats, camera, torch.tensor(BACKGROUND), gradient)


def _shapes(splats: RawSplats) -> Iterator[tuple[str, RawSplats]]:
    """Sizes, needles and discs, rotations."""
    spread = 0.6 * torch.randn(splats.scales.shape, generator=generator(0, 0, "spread"))
    for scale in SCALES:
        yield f"scales {scale:.0e}", splats._replace(scales=spread + math.log(scale))
    mixed = torch.linspace(math.log(SCALES[0]), math.log(SCALES[-1]), len(spread))
    yield "scales 1e-12 to 1e+12", splats._replace(scales=spread + mixed[:, None])
    for length in (0.01, 1.0, 100.0):
        for name, wide in (("needles", 1), ("discs", 2)):
            thin = torch.full_like(spread, math.log(1e-6 * length))
            thin[:, :wide] = math.log(length)
            # Half of them: where all are long, the first ones hide the others.
            some = torch.where(torch.arange(len(spread))[:, None] % 2 == 0, thin, splats.scales)
            yield f"{name} 1e6:1, {length:g} long", splats._replace(scales=some)
    yield "quaternions 0", splats._replace(quats=torch.zeros_like(splats.quats))
    for norm in (1e-10, 1e10, 1e30):
        yield f"quaternions {norm:.0e}", splats._replace(quats=norm * splats.quats)


def _places(splats: RawSplats) -> Iterator[tuple[str, RawSplats]]:
    """Splats where the camera is, and very far."""
    camera = _camera()
    forward, rows = camera.viewmat[2, :3], torch.arange(len(splats.means)) % 5
    for name, depth in (("at the camera's centre", 0.0), ("behind the camera", -1.0), ("on the near plane", NEAR)):
        means = torch.where(rows[:, None] == 0, camera.position + depth * forward, splats.means)
        yield name, splats._replace(means=means)
    close = camera.position + (NEAR + 1e-3) * forward + 0.02 * splats.means
    yield "just behind the near plane", splats._replace(means=torch.where(rows[:, None] == 0, close, splats.means))
    far = splats.means + (rows[:, None] == 0) * FAR * forward
    yield f"{FAR:.0e} away", splats._replace(means=far)
    yield "all at one point", splats._replace(means=torch.zeros_like(splats.means) + splats.means[:1])


def _numbers(splats: RawSplats, nothing: RawSplats, crowd: int) -> Iterator[tuple[str, RawSplats]]:
    """Opacities, colours, and how many splats there are."""
    sign = torch.arange(len(splats.means)) % 3 - 1.0
    yield "opacity logits -100, 0 and 100", splats._replace(opacities=100.0 * sign)
    yield "SH coefficients 1e4", splats._replace(sh0=1e4 * splats.sh0, shN=1e4 * splats.shN)
    yield "no splat", nothing
    yield "one splat", RawSplats(*(tensor[:1] for tensor in splats))
    many, camera = _splats(crowd), _camera()
    # On one ray, at depths that float32 can tell apart; faint, so that the last ones still count.
    target = torch.tensor([0.3, 0.2, DISTANCE]) * torch.linspace(0.25, 2.0, crowd)[:, None]
    means = (target - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    faint = math.log(10.0 / crowd) + 0.5 * many.opacities
    yield f"{crowd:,} on one pixel", many._replace(means=means, opacities=faint, scales=many.scales - 2)


def _cameras(splats: RawSplats) -> Iterator[tuple[str, RawSplats, Camera]]:
    for width, height in ((1, 1), (1, 4096), (4096, 1)):
        yield f"image of {width}x{height}", splats, _camera(width, height)
    for origin in (1e3, FAR):
        yield f"scene at {origin:.0e}", splats._replace(means=splats.means + origin), _camera(origin=origin)


def _broken(splats: RawSplats) -> Iterator[Extreme]:
    """NaN and both infinities in a few splats beside the others, attribute by attribute."""
    for name in ATTRIBUTES:
        for number in (math.nan, math.inf, -math.inf):
            planted = {key: value[:BROKEN_ROWS].clone() for key, value in splats._asdict().items()}
            # One number a splat, another one from splat to splat.
            flat = planted[name].view(BROKEN_ROWS, -1)
            flat[torch.arange(BROKEN_ROWS), torch.arange(BROKEN_ROWS) % flat.shape[1]] = number
            healthy = RawSplats(*(value[BROKEN_ROWS:] for value in splats))
            yield Extreme(BROKEN, _workload(f"{name} {number}", healthy), RawSplats(**planted), name)
