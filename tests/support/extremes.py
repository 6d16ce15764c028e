"""What happens at the limits of float32: small scenes of extreme numbers, and quantizers with nothing to do.

Where image or gradient have a number that is not finite, the training step must refuse the update; and in any case the
splats that brought it must be named, and no other be lost.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import torch
from nsvq_step import Attribute, step_errors
from nsvq_step import step as quantize_step
from splat_scenes import front_camera, random_splats
from torch import Tensor

from nsvq_lightning.commands import markdown_table
from nsvq_lightning.commands.benchmark.render import Painter, errors_of, painted, trace
from nsvq_lightning.commands.benchmark.timing import number
from nsvq_lightning.commands.benchmark.workloads import Workload
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.optim import LearningRates, build_adam, param_groups
from nsvq_lightning.training.row_ops import trainable_rows

BACKENDS = ("cpu", "reference")
BROKEN_ROWS = 7
"""Splats of a broken scene with a number that is not finite."""
WIDTH, HEIGHT = 72, 48
DISTANCE = 4.0
SCALES = (1e-12, 1e-6, 1.0, 1e6, 1e12)
FAR = 1e6
"""Scene units."""


@dataclass(frozen=True, eq=False)
class Extreme:
    """A scene at a limit.

    Attributes:
        workload: The view, and its splats with finite numbers.
        planted: Splats beside them with one non-finite number each, ``[B]``.
        culprit: The attribute that has these numbers; empty where all are finite.
    """

    workload: Workload
    planted: RawSplats
    culprit: str = ""


def extremes(count: int = 60, crowd: int = 1000) -> dict[str, Extreme]:
    """All scenes by name, of ``count`` splats, or ``crowd`` where all are on one pixel; the same at every call."""
    splats = random_splats(count)
    nothing = RawSplats(*(tensor[:0] for tensor in splats))
    scenes = (*_shapes(splats), *_places(splats), *_numbers(splats, nothing, crowd), *_cameras(splats))
    every = [*(Extreme(_workload(*scene), nothing) for scene in scenes), *_broken(splats)]
    return {scene.workload.name: scene for scene in every}


def beside(backend: str, planted: RawSplats) -> Painter:
    """What renders splats and, beside them, others that nobody differentiates."""

    def paint(splats: RawSplats, workload: Workload) -> Tensor:
        every = (torch.cat([added.to(own.dtype), own]) for added, own in zip(planted, splats, strict=True))
        return painted(backend, RawSplats(*every), workload)

    return paint


def stress_errors(scene: Extreme, backend: str) -> dict[str, float]:
    """Errors of image and gradient in float32, or how many numbers of them are not finite, and how a step ends."""
    paint = beside(backend, scene.planted)
    traced = trace(scene.workload, paint, torch.float32)
    gradients = torch.autograd.grad(*traced, scene.workload.image_gradient)
    broken = _not_finite((traced[0], *gradients))
    values: dict[str, float] = {}
    if not broken:
        truth = trace(scene.workload, beside("reference", scene.planted), torch.float64)
        for errors in errors_of(scene.workload, paint, truth).values():
            values.update(errors)
        values["largest value"] = float(traced[0].detach().abs().max())
    refused, named, lost = step(scene, backend)
    rows = max(named.values(), default=0)
    return values | {"not finite": broken, "step refused": refused, "rows named": rows, "other rows lost": lost}


def step(scene: Extreme, backend: str) -> tuple[bool, Mapping[str, int], int]:
    """One training step on a random photo: forward, backward and Adam, or a refusal where the loss is not finite.

    Returns whether it was refused, rows with a number that is not finite by attribute, as density control names them,
    and how many of them were finite before.
    """
    splats = Splats.from_tensors(*map(torch.cat, zip(scene.planted, scene.workload.splats, strict=True)))
    optimizer = build_adam(param_groups(splats, {}, LearningRates(), extent=1.0))
    before, _ = trainable_rows(splats)
    photo = torch.rand(scene.workload.image_gradient.shape, generator=generator(0, 0, "photo"))
    loss = photometric_loss(painted(backend, splats.raw(), scene.workload), photo)
    refused = not bool(loss.isfinite())
    if not refused:
        loss.backward()
        optimizer.step()
    after, named = trainable_rows(splats)
    return refused, named, int((before & ~after).sum())


def quantizers() -> dict[str, Attribute]:
    """Quantizers that have nothing to do, or nothing to choose from, by what is special about them."""
    draw = generator(0, 0, "rows")
    different, few = torch.randn(200, 3, generator=draw), torch.randn(5, 3, generator=draw)
    return {
        "every row on a code": _attribute(few[torch.arange(200) % 5], 5),
        "more codes than rows": _attribute(different, 1000),
        "all rows equal": _attribute(different[:1].repeat(200, 1), 16),
        "one code": _attribute(different, 1),
        "rows of 1e-20": _attribute(1e-20 * different, 16),
        "rows of 1e15": _attribute(1e15 * different, 16),
    }


def _attribute(x: Tensor, codes: int) -> Attribute:
    quantizer = NSVQ(codes, x.shape[1])
    quantizer.fit(x, generator=generator(0, 0, "fit"))
    upstream = 1e-6 * torch.randn(x.shape, generator=generator(0, 0, "upstream"))
    return Attribute(quantizer.train(), x.clone().requires_grad_(), torch.arange(len(x)), upstream)


def quantizer_errors(attribute: Attribute) -> dict[str, float]:
    """Errors of a step of a quantizer, and how many of its numbers are not finite."""
    results = quantize_step({"": attribute}, 0)
    broken = _not_finite(results[""][:2])
    return {**({} if broken else step_errors({"": attribute}, results)), "not finite": float(broken)}


def _not_finite(tensors: Iterable[Tensor]) -> int:
    return sum(int((~tensor.isfinite()).sum()) for tensor in tensors)


def stress_table(scenes: Mapping[str, Extreme]) -> str:
    """A Markdown table of :func:`stress_errors` for every scene, by the kernels of the CPU and by plain torch."""
    rows = {(name, backend): stress_errors(scene, backend) for name, scene in scenes.items() for backend in BACKENDS}
    columns = list(dict.fromkeys(column for values in rows.values() for column in values))
    cells = [[*key, *(number(values[c]) if c in values else "" for c in columns)] for key, values in rows.items()]
    return markdown_table(["scene", "back-end", *columns], cells, words=("scene", "back-end")) + "\n"


def _camera(width: int = WIDTH, height: int = HEIGHT, origin: float = 0.0) -> Camera:
    """A camera in front of the ball of splats; ``origin`` is how far this is from that of the world."""
    side = max(width, height)
    camera = front_camera(side, side, width / 2, height / 2)
    view = camera.viewmat.double()
    view[:3, 3] -= view[:3, :3] @ torch.full((3,), origin, dtype=torch.float64)
    return Camera(camera.K, view.float(), width, height)


def _workload(name: str, splats: RawSplats, camera: Camera | None = None) -> Workload:
    camera = _camera() if camera is None else camera
    shape = camera.height, camera.width, 3
    gradient = torch.randn(shape, generator=generator(0, 0, "image gradient")) / math.prod(shape)
    return Workload(name, splats, camera, gradient)


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
    many, camera = random_splats(crowd), _camera()
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
        for value in (math.nan, math.inf, -math.inf):
            planted = {key: rows[:BROKEN_ROWS].clone() for key, rows in splats._asdict().items()}
            # One number a splat, another one from splat to splat.
            flat = planted[name].view(BROKEN_ROWS, -1)
            flat[torch.arange(BROKEN_ROWS), torch.arange(BROKEN_ROWS) % flat.shape[1]] = value
            healthy = RawSplats(*(rows[BROKEN_ROWS:] for rows in splats))
            yield Extreme(_workload(f"{name} {value}", healthy), RawSplats(**planted), name)
