"""Synthetic scenes with the statistics of captured ones, always the same for a name; and scenes of the user."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nsvq_lightning.commands.benchmark import SIZES
from nsvq_lightning.commands.benchmark.timing import Scope
from nsvq_lightning.compression.viewpoints import look_at
from nsvq_lightning.data.scene import load_scene
from nsvq_lightning.io.formats import read_scene
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.splats.conventions import Float64s, middle_of
from nsvq_lightning.splats.splats import RawSplats, Splats, detached

SEED = 7


@dataclass(frozen=True, eq=False)
class Workload:
    """A scene, a view of it, and the gradient that a loss would send back.

    Attributes:
        name: Name in the tables.
        splats: Raw attributes, float32, detached.
        camera: The view.
        image_gradient: Gradient of the image ``[H, W, 3]``.
    """

    name: str
    splats: RawSplats
    camera: Camera
    image_gradient: Tensor

    def crop(self, width: int, height: int) -> "Workload":
        """The middle ``width`` x ``height`` pixels of the view, with the splats and the depth they have there.

        The pixels are not quite the same: the projection of splats outside a margin around the view is clamped.
        """
        left = (self.camera.width - width) // 2
        top = (self.camera.height - height) // 2
        K = self.camera.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        gradient = self.image_gradient[top : top + height, left : left + width].contiguous()
        return replace(self, camera=replace(self.camera, K=K, width=width, height=height), image_gradient=gradient)

    def to(self, device: torch.device | str) -> "Workload":
        """The workload with its splats and gradient on a device; the camera stays where it is."""
        return replace(
            self,
            splats=RawSplats(*(tensor.to(device) for tensor in self.splats)),
            image_gradient=self.image_gradient.to(device),
        )

    def __str__(self) -> str:
        return f"{self.name} {self.camera.width}x{self.camera.height}"


def workloads(scope: Scope) -> list[Workload]:
    """The scene that the user gives, or the synthetic scenes that the scope names.

    A scene file is seen from the side, at 800x533, from twice the distance that holds four fifths of its splats; a
    COLMAP folder by the camera of its first train view. Splats of files with a number that is not finite are left out.

    Raises:
        ValueError: A file has an unknown suffix or no finite splat.
        FormatError: It is damaged.
        SceneError: The COLMAP folder cannot be used.
    """
    if scope.scene is None:
        return [synthetic_workload(name) for name in scope.workloads]
    name = scope.scene.resolve().name
    if scope.photos is None:
        splats = read_scene(scope.scene).tensors()
        centre, reach = middle_of(splats.means.numpy())
        return [_seen_by(_camera(800, 533, centre, 2 * (reach or 1.0)), splats, name)]
    scene = load_scene(scope.photos)
    if scope.init_from:
        splats = read_scene(scope.init_from).tensors()
        name += f" {scope.init_from.name}"
    else:
        scene = scene.standard
        splats = detached(Splats.from_points(scene.points, scene.colors))
    return [_seen_by(scene.cameras[scene.train[0]], splats, name)]


def synthetic_workload(name: str) -> Workload:
    """A scene of surfaces, a loose volume and a far shell; sizes, rotations, opacities and colours are random.

    Args:
        name: One of :data:`nsvq_lightning.commands.benchmark.SIZES`.
    """
    n, width, height, scale = SIZES[name]
    # One stream, so the order of the draws is part of the definition.
    rng = np.random.default_rng(SEED)
    means = _positions(n, rng)
    scales = math.log(scale) + rng.normal(size=(n, 1)) * 0.5
    scales = scales + rng.normal(size=(n, 3)) * 0.5
    quats = _directions(rng, n, 4)
    quats *= np.exp(rng.normal(size=(n, 1)) * 0.1)  # as training leaves them: not of unit length
    opacities = rng.normal(size=n) * 1.8 - 0.3
    harmonics = rng.normal(size=(n, 16, 3)) * 0.08
    harmonics[:, 0] = rng.normal(size=(n, 3)) * 0.9
    attributes = (means, quats, scales, opacities, harmonics[:, :1], harmonics[:, 1:])
    return _seen_by(_camera(width, height, np.zeros(3), 4.0), RawSplats(*map(_tensor, attributes)), name)


def _tensor(values: Float64s) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _directions(rng: np.random.Generator, count: int, dim: int) -> Float64s:
    """Uniform unit vectors ``[count, dim]``."""
    vectors = rng.normal(size=(count, dim))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)  # type: ignore[no-any-return]


def _positions(count: int, rng: np.random.Generator) -> Float64s:
    """Positions ``[count, 3]``, shuffled: a sphere, the ground, a box, a loose cloud, a shell of background."""
    quarter, tenth = int(0.25 * count), int(0.10 * count)
    sphere = _directions(rng, quarter, 3) * 0.9 + rng.normal(size=(quarter, 3)) * 0.02
    x = rng.uniform(-2.2, 2.2, quarter)
    ground = np.c_[x, 0.9 + rng.normal(size=quarter) * 0.02, rng.uniform(-2.2, 2.2, quarter)]
    box = rng.uniform(-0.4, 0.4, (tenth, 3))
    axis = rng.integers(0, 3, tenth)
    box[np.arange(tenth), axis] = 0.4 * (rng.integers(0, 2, tenth) * 2 - 1)
    box += [1.3, 0.5, -0.6]
    cloud = rng.normal(size=(quarter, 3)) * 0.8
    rest = count - 3 * quarter - tenth
    shell = _directions(rng, rest, 3) * rng.uniform(2.5, 3.2, (rest, 1))
    return np.concatenate([sphere, ground, box, cloud, shell])[rng.permutation(count)]


def _camera(width: int, height: int, target: Float64s, distance: float) -> Camera:
    """A camera that looks at ``target`` from above and aside, y down."""
    azimuth, elevation = 0.5, 0.35  # radians
    across = math.cos(elevation)
    direction = np.array([across * math.sin(azimuth), -math.sin(elevation), -across * math.cos(azimuth)])
    return look_at(target, target + distance * direction, width, height, math.radians(60.0))


def _seen_by(camera: Camera, splats: RawSplats, name: str) -> Workload:
    shape = camera.height, camera.width, 3
    gradient = _tensor(np.random.default_rng(SEED + 1).normal(size=shape) / math.prod(shape))
    return Workload(name, splats, camera, gradient)
