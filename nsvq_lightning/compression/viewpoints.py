"""A scene's own pictures: from where it shows detail, and how far two pictures are apart."""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, normalize

from nsvq_lightning.data.images import ImageStore, Picture
from nsvq_lightning.data.scene import SOME_SPLATS, Scene, check_photo, seen_by, spread
from nsvq_lightning.io.morton import spatial_order
from nsvq_lightning.quality.metrics import eight_bit
from nsvq_lightning.rendering.camera import Camera, camera_of
from nsvq_lightning.rendering.constants import NEAR
from nsvq_lightning.rendering.frame import EXTENT, Frame
from nsvq_lightning.rendering.poses import poses, view_towards
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.rendering.sh import sh_basis
from nsvq_lightning.splats.conventions import Float32s, Float64s, middle_of
from nsvq_lightning.splats.splats import RawSplats, SplatTensors, detached, sh_degree_of
from nsvq_lightning.training.importance import Renderer

# Near plane of a guessed camera, as a share of the distance to what it looks at.
NEARNESS = 0.02


def look_at(target: Float64s, eye: Float64s, width: int, height: int, angle: float) -> Camera:
    """A camera at ``eye [3]`` that has ``target [3]`` in its centre, y down.

    Args:
        target: World position.
        eye: World position, not straight above or below the target.
        width: Pixels.
        height: Pixels.
        angle: Horizontal field of view, radians.
    """
    view = view_towards(target, eye, np.array([0.0, -1.0, 0.0]))
    focal = 0.5 * width / math.tan(angle / 2)
    near = NEARNESS * float(np.linalg.norm(target - eye)) or NEAR
    return camera_of(view, (focal, focal, width / 2, height / 2), width, height, near)


@torch.no_grad()
def pictures(splats: SplatTensors, cameras: Sequence[Camera], look: Renderer = render) -> Iterator[Tensor]:
    """What each camera sees, ``[H, W, 3]`` in [0, 1]."""
    for camera in cameras:
        yield look(splats, camera).image.clamp(0, 1)


# Largest number of views in which errors are measured.
MEASURED = 24


class Measure:
    """How far pictures of a scene are from those of the original.

    Attributes:
        cameras: Where pictures are compared, at most :data:`MEASURED`.

    Args:
        original: Raw attributes.
        cameras: Views, some of which are taken.
        look: How they are rendered.
        masks: Which pixels ``[H, W]`` of each count; None, or no masks at all, where all do.

    Raises:
        ValueError: No camera shows any splat.
    """

    def __init__(
        self,
        original: SplatTensors,
        cameras: Sequence[Camera],
        look: Renderer = render,
        masks: Sequence[Tensor | None] = (),
    ) -> None:
        self.cameras = spread(cameras, MEASURED)
        self._masks = spread(masks, MEASURED) or [None] * len(self.cameras)
        self._look = look
        self._expected = list(pictures(original, self.cameras, look))
        if all(torch.equal(picture, picture[:1, :1].expand_as(picture)) for picture in self._expected):
            raise ValueError(
                f"all {len(self.cameras)} pictures of the scene are empty, so no error can be measured: its splats are "
                "transparent, or photos (--data.root) are of another scene or in other coordinates"
            )

    def error(self, splats: SplatTensors) -> float:
        """Root mean square difference for channels in [0, 1]."""
        pairs = zip(pictures(splats, self.cameras, self._look), self._expected, self._masks, strict=True)
        squares = [float((a - b)[... if mask is None else mask].double().square().mean()) for a, b, mask in pairs]
        return math.sqrt(np.mean(squares))

    def told(self, error: float, original: str) -> str:
        """An error in words, with what it is measured against."""
        return f"error {error:.4g} ({decibels(error):.2f} dB against {original} in {len(self.cameras)} pictures)"


# Views of a scene that has no photos.
VIEWS = 96
# The split of a scene whose photos are its own pictures.
OWN = "own pictures"


def own_scene(
    splats: SplatTensors, cameras: Sequence[Camera], look: Renderer = render, photos: Sequence[Tensor] = ()
) -> Scene:
    """A scene of given photos, or of pictures of its splats, one of which in eight is not to train on.

    Args:
        splats: Raw attributes.
        cameras: Where from, at least one.
        look: How the splats are rendered.
        photos: Of each camera ``[H, W, 3]`` RGB, uint8, or float in [0, 1]; none for the scene's own pictures.

    Raises:
        ValueError: There is not one photo of the camera's size for each camera, or its numbers are of another kind.
    """
    if photos and [photo.shape for photo in photos] != [(camera.height, camera.width, 3) for camera in cameras]:
        raise ValueError(f"expected a photo [H, W, 3] of its size for each of {len(cameras)} cameras")
    for number, photo in enumerate(photos):
        check_photo(f"photo {number}", photo)
    split = "1 in 8" if photos else OWN
    seen = [(255 * eight_bit(each.cpu())).round().to(torch.uint8) for each in photos or pictures(splats, cameras, look)]
    centres = poses(cameras)[0]
    frame = Frame.around(centres)
    if not np.ptp(centres, axis=0).any():
        _, reach = middle_of(splats.means.numpy())
        frame = Frame((reach or 1.0) / EXTENT)
    return Scene(
        root=Path("memory"),
        names=tuple(f"{number:03d}" for number in range(len(cameras))),
        cameras=tuple(cameras),
        images=ImageStore((), held=[Picture(photo, None) for photo in seen]),
        points=splats.means.detach(),
        colors=torch.zeros_like(splats.means),
        train=tuple(index for index in range(len(cameras)) if index % 8 != 4),
        test=tuple(range(4, len(cameras), 8)) or (0,),
        extent=EXTENT * frame.unit,
        frame=frame,
        split=split,
    )


# Share of the splats of a part of a scene that one of its views has in the picture at least.
MIN_OF_PART = 0.1


def showing(cameras: Sequence[Camera], means: Float32s, most: int) -> list[Camera]:
    """At most so many cameras that show most of the positions ``[N, 3]``, N > 0; those that show few are no use."""
    shares = seen_by(cameras, means).mean(1) if cameras else np.zeros(0)
    return [cameras[index] for index in np.argsort(-shares, kind="stable")[:most] if shares[index] >= MIN_OF_PART]


def decibels(error: float) -> float:
    """A root mean square error as PSNR in dB."""
    return math.inf if error == 0 else -20 * math.log10(error)


# Splats that candidates are judged by, at most.
SOME_DETAIL = 250_000
# Where they stand, in spreads of the detail from its middle, around a scene; inside it, between these shares of it.
AROUND = 0.9, 3.0
INSIDE = 0.05, 0.95
# Splats farther from the middle of all, in distances that four fifths do not exceed, say nothing about it.
STRAY = 10
# Power of how much colours follow the line of sight to a place. With 4, bonsai lost 0.04 dB more.
SHARPNESS = 8
# Nepers that one unit of variance of the logarithm of sizes in pixels takes from it.
EVENNESS = 3
# Cells of space that are asked on their own where they were seen from. 1 and 4 find fewer cameras, 1024 as many.
CELLS = 256
# Horizontal field of view: in narrower pictures, edges of photos are not seen; wider ones show too much of what is far.
ANGLE = math.radians(65)


def likely_cameras(splats: SplatTensors, count: int, width: int = 560, height: int = 392) -> list[Camera]:
    """Cameras from which a scene shows much detail, as it does where photos were taken, the best one first.

    A trained scene is sharp from where its photos were taken and blurred or empty from elsewhere. From there, its
    splats have about one size in pixels, and its colours follow the line of sight (:func:`_following`). Candidates are
    even in space and direction, as random ones decided 0.1 to 0.3 dB. Only where colours follow the line of sight to
    the middle more than that to any place around, as in a room, candidates stand inside, and look at the detail.

    Args:
        splats: Raw attributes of N > 0 splats.
        count: Number of cameras.
        width: Pixels.
        height: Pixels.
    """
    raw = RawSplats(*(tensor.cpu() for tensor in detached(splats)))
    means = raw.means.double().numpy()
    # Small, opaque splats are where the detail is: opacity / size, of a sum of 1 even where all are transparent.
    sizes = raw.scales.double().mean(1)
    sizes = sizes.clamp_min(sizes.median() - 5)  # one of no length would be all of the weight
    weights = torch.softmax(logsigmoid(raw.opacities.double()) - sizes, 0).numpy()
    centre, usual = middle_of(means)
    weights[np.linalg.norm(means - centre, axis=1) > STRAY * usual] = 0
    weights /= weights.sum()
    middle = weights @ means
    reach = max(math.sqrt(weights @ ((means - middle) ** 2).sum(1)), math.exp(weights @ sizes.numpy()))
    even = torch.quasirandom.SobolEngine(7, scramble=True, seed=0).draw(5 * count)  # type: ignore[no-untyped-call]
    normal = torch.special.ndtri(even.double().clamp(1e-3, 1 - 1e-3))
    directions = normalize(normal[:, :3]).numpy()
    some = RawSplats(*(spread(tensor, SOME_DETAIL).contiguous() for tensor in raw))
    following = _following(some)
    # On four scenes of objects, the middle has 0.3 to 0.7 times as much as the best of the farthest places, in a room
    # 1.75 times.
    if usual and following(middle[None]) > following(middle + reach * AROUND[1] * directions).max():
        targets = means[np.searchsorted(weights.cumsum(), even[:, 0].numpy()).clip(max=len(means) - 1)]
        low, high = np.quantile(targets, INSIDE, axis=0)
        eyes = low + (high - low) * even[:, 4:].numpy()
    else:
        eyes = middle + reach * (AROUND[0] + (AROUND[1] - AROUND[0]) * even[:, 6:].numpy()) * directions
        targets = middle + reach * 0.4 * normal[:, 3:6].numpy()
    low = round(96 * height / width)
    details = np.array([_detail(some, look_at(*at, 96, low, ANGLE)) for at in zip(targets, eyes, strict=True)])
    scores = details * following(eyes) ** SHARPNESS * np.exp(-EVENNESS * _size_variances(some, eyes))
    return [look_at(targets[k], eyes[k], width, height, ANGLE) for k in np.argsort(-scores, kind="stable")[:count]]


def square_views(splats: SplatTensors, most: int) -> list[Camera]:
    """Likely cameras with the pixels of a photo, square: what a wide picture shows at its edges, photos seldom do."""
    return likely_cameras(splats, most, 640, 640)


def _following(splats: RawSplats) -> Callable[[Float64s], Float64s]:
    """How much colours follow the lines of sight to each of places ``[P, 3]``: ``[P]``, most where photos were taken.

    Spherical harmonics c start at 0, and are fitted along the lines of sight of training alone. So in a cell of space,
    their mean C of c cᵀ over splats, each of length 1 and weighted by opacity, is large along Y(d) for those directions
    d: 1 / Y(d)ᵀ C⁻¹ Y(d) (Capon 1969), in the mean over :data:`CELLS`. It is 1 without harmonics.
    """
    if not splats.shN.any():
        return lambda places: np.ones(len(places))
    degree, cells = sh_degree_of(splats.shN), []
    for cell in np.array_split(spatial_order(splats.means.numpy()), CELLS):
        weights, shN = torch.softmax(logsigmoid(splats.opacities[cell].double()), 0), splats.shN[cell].double()
        shN = shN / shN.square().sum((1, 2), keepdim=True).sqrt().clamp_min(1e-12)
        mean = torch.einsum("n,nic,njc->ij", weights, shN, shN)
        # Not singular, and the less sharp the more noise there is.
        mean += (0.02 * mean.diagonal().mean() + 1e-9) * torch.eye(len(mean))
        cells.append((weights @ splats.means[cell].double(), mean))

    def at(places: Float64s) -> Float64s:
        found = np.zeros(len(places))
        for middle, mean in cells:
            basis = sh_basis(normalize(middle - torch.from_numpy(places)), degree)[:, 1:].T
            # Infinite is only that of a place in the middle of the cell.
            found += (basis * torch.linalg.solve(mean, basis)).sum(0).reciprocal().nan_to_num(posinf=0).numpy()
        return found / CELLS

    return at


def _size_variances(splats: RawSplats, places: Float64s) -> Float64s:
    """Variance of the logarithm of the splats' sizes in pixels as seen from each place ``[P]``, weighted by opacity."""
    few = RawSplats(*(spread(tensor, SOME_SPLATS).double() for tensor in splats))
    weights = torch.softmax(logsigmoid(few.opacities), 0)
    sizes = few.scales.mean(1) - torch.cdist(torch.from_numpy(places), few.means).clamp_min(1e-12).log()
    return ((sizes - (sizes @ weights)[:, None]).square() @ weights).numpy()


@torch.no_grad()
def _detail(splats: SplatTensors, camera: Camera) -> float:
    """Mean difference between neighbouring pixels, times the share of the picture that is covered."""
    view = render(splats, camera)
    image = view.image.clamp(0, 1)
    return float(sum(image.diff(dim=dim).abs().mean() for dim in (0, 1)) * view.alpha.mean())
